"""A robot known by its logs alone: how its numbers transform, and no simulator."""

from __future__ import annotations

from typing import Any

import jax

from genidm.errors import BadInput
from genidm.robots.base import Robot, State


class Logged(Robot):
    """What turns logs into a controller without a simulator.

    A subclass names itself and its `dt` and `standing_height`, and says how the
    numbers of s and of a transform (`observation`, `action`). Its logs can be turned
    (`Generalize(mode="rotate")`) and fitted; what would step it is refused.
    """

    target_distance = (2.0, 5.0)
    healthy_reward = 0.0
    paper_interactions = 0

    def reset(self, keys: jax.Array, yaw: jax.Array) -> State:
        raise self._refusal()

    def step(self, state: State, action: jax.Array) -> State:
        raise self._refusal()

    def set_state(self, physics: Any, yaw: jax.Array) -> State:
        raise self._refusal()

    def cost(self, state: State, action: jax.Array) -> jax.Array:
        raise self._refusal()

    def _refusal(self) -> BadInput:
        return BadInput(f"the {self.name} is known by its logs alone: there is nothing to step")
