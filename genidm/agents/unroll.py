"""An agent's steps: what acts, episode after episode, and the record of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from genidm.agents.base import Metrics
from genidm.experience import Experience, record
from genidm.robots.base import Robot, select
from genidm.rollout import Move, narrow, rollout
from genidm.tasks import EnvState, Task, Transition, inputs

# key → the random numbers of one action.
Draw = Callable[[jax.Array], Any]
# (inputs [B, I], random numbers [B, ...]) → (a [B, A], notes).
Choose = Callable[[jax.Array, Any], tuple[jax.Array, Any]]
# (step [B], notes) → what a learner needs of it, [B, ...].
Keep = Callable[[Transition, Any], Any]


class _Carry(flax.struct.PyTreeNode):
    """Lanes, and the starts that they take when their episodes end.

    Attributes:
      lanes: EnvState `[B]`.
      fresh: EnvState `[B]`, ready to start.
      spent: `[B]` bool, whether the lane has taken its fresh start already.
    """

    lanes: EnvState
    fresh: EnvState
    spent: jax.Array


def generate_unroll(
    robot: Robot, task: Task, steps: int, draw: Draw, choose: Choose, keep: Keep, lanes: EnvState
) -> tuple[EnvState, Experience, Any, Metrics]:
    """T steps of B lanes; where an episode ends, a fresh one begins.

    Starts and random numbers are drawn before the loop, not in every step. They belong to
    the lanes' own keys, so that they do not depend on how lanes are shared among devices.

    Args:
      robot: what walks.
      task: what ends an episode, and what it pays.
      steps: T.
      draw: the random numbers of an action.
      choose: the action.
      keep: what the learner needs of a step.
      lanes: EnvState `[B]` before the first step.

    Returns:
      the lanes after the last step; the record, what was kept, and the task's metrics,
      `[T, B, ...]` each.
    """
    keys = jax.vmap(lambda key: jax.random.split(key, 3))(lanes.keys)
    of_steps = jax.vmap(lambda key: jax.random.split(key, steps), out_axes=1)(keys[:, 1])
    rows = jax.vmap(jax.vmap(draw))(of_steps)
    fresh = task.start(robot, keys[:, 2])
    carry = _Carry(lanes.replace(keys=keys[:, 0]), fresh, jnp.zeros(lanes.episode_step.shape, bool))

    def act(carry: _Carry, row: Any) -> tuple[Any, jax.Array, Any]:
        lanes = carry.lanes
        action, notes = choose(inputs(lanes.robots.observation, lanes.relative_goal), row)
        return lanes.robots, action, notes

    def watch(carry: _Carry, move: Move) -> tuple[_Carry, Any]:
        seen = task.transition(robot, carry.lanes, move.action, move.after)
        kept = record(seen), keep(seen, move.notes), task.metrics(robot, seen)
        return _go_on(robot, task, carry, seen), kept

    carry, kept = rollout(robot, act, watch, carry, rows)
    return (carry.lanes, *narrow(kept))


def _go_on(robot: Robot, task: Task, carry: _Carry, seen: Transition) -> _Carry:
    """Lanes whose episode has ended take their fresh starts."""

    def renewed() -> tuple[EnvState, jax.Array]:
        # The fourth of a key of which `generate_unroll` splits three.
        keys = jax.vmap(lambda key: jax.random.split(key, 4)[3])(carry.fresh.keys)
        fresh = select(carry.spent, task.start(robot, keys), carry.fresh)
        return fresh, jnp.zeros_like(carry.spent)

    short = (seen.last & carry.spent).any()
    fresh, spent = jax.lax.cond(short, renewed, lambda: (carry.fresh, carry.spent))
    going = carry.lanes.replace(robots=seen.after, episode_step=carry.lanes.episode_step + 1)
    return _Carry(select(seen.last, fresh, going), fresh, spent | seen.last)
