"""A robot with logs and without a simulator."""

from __future__ import annotations

from typing import Any

import jax

from genidm.errors import BadInput
from genidm.robots.base import Robot, State


class Logged(Robot):
    """A robot with logs and without a simulator.

    A subclass defines `name`, `dt`, `standing_height` and the layouts of s and a (`observation`,
    `action`). Its logs can be rotated (`Generalize(mode="rotate")`) and fitted. Methods that need
    a simulator raise BadInput.
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
        return BadInput(f"the {self.name} cannot be stepped: it has logs, but no simulator")
