"""The step loop: `act` chooses the actions, and `watch` reads each step.

Collection, 𝒢, the test and waypoints use this loop, each with its own `act` and `watch`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from genidm.robots.base import Robot, State


class Move(NamedTuple):
    """One environment step of B robots.

    Attributes:
      before: State `[B]` before the step.
      action: `[B, A]`.
      after: State `[B]` after the step.
      notes: anything else that `act` passes to `watch`.
    """

    before: State
    action: jax.Array
    after: State
    notes: Any


def narrow(tree: Any) -> Any:
    """Convert float64 arrays of a tree to float32.

    With `jax_enable_x64`, some robots have float64 states; records stay float32.
    """

    def leaf(x: Any) -> Any:
        return x.astype(jnp.float32) if x.dtype == jnp.float64 else x

    return jax.tree.map(leaf, tree)


# (carry, row) → State before the step, a [B, A], and notes.
Act = Callable[[Any, Any], tuple[State, jax.Array, Any]]
# (carry, move) → the carry after the step, and the output for the step.
Watch = Callable[[Any, Move], tuple[Any, Any]]


def rollout(
    robot: Robot, act: Act, watch: Watch, carry: Any, rows: Any = None, steps: int | None = None
) -> tuple[Any, Any]:
    """Step B robots T times, inside a jitted program.

    Args:
      robot: the robot.
      act: returns the State to step from (it may differ from the last one) and the actions.
      watch: returns the next carry and the output for each step.
      carry: the loop state, a tree of arrays.
      rows: tree `[T, ...]` with one row per step for `act`; None if `act` needs no rows.
      steps: T, if there are no rows.

    Returns:
      the carry after T steps, and the outputs of `watch`, stacked `[T, ...]`.
    """

    def step(carry: Any, row: Any) -> tuple[Any, Any]:
        before, action, notes = act(carry, row)
        return watch(carry, Move(before, action, robot.step(before, action), notes))

    return jax.lax.scan(step, carry, rows, length=steps)
