"""The one step loop: robots step under whatever acts, and whatever watches sees each step.

Collecting, 𝒢, the test and waypoints are this loop with an `act` and a `watch` of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from genidm.robots.base import Robot, State


class Move(NamedTuple):
    """One control step of B robots.

    Attributes:
      before: State `[B]` that the action was chosen in.
      action: `[B, A]`.
      after: State `[B]` that it led to.
      notes: what `act` wants `watch` to know beside.
    """

    before: State
    action: jax.Array
    after: State
    notes: Any


def narrow(tree: Any) -> Any:
    """A tree whose float64 is float32: where jax is told to compute with 64 bits, records are not.

    Robots that name no dtypes have states of float64 then.
    """

    def leaf(x: Any) -> Any:
        return x.astype(jnp.float32) if x.dtype == jnp.float64 else x

    return jax.tree.map(leaf, tree)


# (carry, row) → where the robots are, a [B, A], and notes.
Act = Callable[[Any, Any], tuple[State, jax.Array, Any]]
# (carry, move) → the carry after the step, and what is kept of it.
Watch = Callable[[Any, Move], tuple[Any, Any]]


def rollout(
    robot: Robot, act: Act, watch: Watch, carry: Any, rows: Any = None, steps: int | None = None
) -> tuple[Any, Any]:
    """Steps B robots, inside a jitted program.

    Args:
      robot: what steps.
      act: says where the robots are (it may put them somewhere else first) and what they do.
      watch: takes each step in.
      carry: what goes from one step to the next; a tree of arrays.
      rows: tree `[T, ...]`, one row a step for `act`; None if it needs none.
      steps: T, where there are no rows.

    Returns:
      the carry after T steps, and what `watch` kept, stacked `[T, ...]`.
    """

    def step(carry: Any, row: Any) -> tuple[Any, Any]:
        before, action, notes = act(carry, row)
        return watch(carry, Move(before, action, robot.step(before, action), notes))

    return jax.lax.scan(step, carry, rows, length=steps)
