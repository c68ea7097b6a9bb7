"""Rollouts for training: consecutive episodes, with a record of every step."""

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
from genidm.tasks import EnvState, Task, Transition

# key → the random numbers of one action.
Draw = Callable[[jax.Array], Any]
# (inputs [B, I], random numbers [B, ...]) → (a [B, A], a before exploration [B, A], notes for
# Keep).
Choose = Callable[[jax.Array, Any], tuple[jax.Array, jax.Array, Any]]
# (step [B], notes) → what the learner needs of the step, [B, ...].
Keep = Callable[[Transition, Any], Any]


class _Carry(flax.struct.PyTreeNode):
    """Lanes, and their next initial states.

    Attributes:
      lanes: EnvState `[B]`.
      fresh: EnvState `[B]` at the start of the lanes' next episodes.
      used: `[B]` bool, whether the lane has used its fresh state.
    """

    lanes: EnvState
    fresh: EnvState
    used: jax.Array


def generate_unroll(
    robot: Robot, task: Task, steps: int, draw: Draw, choose: Choose, keep: Keep, lanes: EnvState
) -> tuple[EnvState, Experience, Any, Metrics]:
    """Step B lanes T times; when an episode ends, its lane starts a new one.

    Initial states and random numbers are drawn before the loop, because a reset of all lanes in
    every step is slow. They come from the lanes' own keys, so they do not depend on the mesh.

    Args:
      robot: the robot.
      task: reward and end of an episode.
      steps: T.
      draw: draws the random numbers for an action.
      choose: chooses the action.
      keep: selects what the learner needs of a step.
      lanes: EnvState `[B]` before the first step.

    Returns:
      EnvState `[B]` after the last step; Experience, the results of `keep`, and the task's
      metrics, `[T, B, ...]` each.
    """
    keys = jax.vmap(lambda key: jax.random.split(key, 3))(lanes.keys)
    step_keys = jax.vmap(lambda key: jax.random.split(key, steps), out_axes=1)(keys[:, 1])

    def numbers(key: jax.Array) -> tuple[Any, Any]:
        # `draw` sees the key itself, so that a task without numbers does not change its numbers.
        return draw(key), task.draw(jax.random.fold_in(key, 1))

    rows = jax.vmap(jax.vmap(numbers))(step_keys)
    fresh = task.start(robot, keys[:, 2])
    carry = _Carry(lanes.replace(keys=keys[:, 0]), fresh, jnp.zeros(lanes.episode_step.shape, bool))

    def act(carry: _Carry, row: Any) -> tuple[Any, jax.Array, Any]:
        lanes, (drawn, task_numbers) = carry.lanes, row
        *actions, notes = choose(lanes.inputs(robot), drawn)
        action, intended = (lanes.view.robot_action(robot, lanes.robots, a) for a in actions)
        return lanes.robots, action, (intended, notes, task_numbers)

    def watch(carry: _Carry, move: Move) -> tuple[_Carry, Any]:
        intended, notes, task_numbers = move.notes
        seen = task.transition(robot, carry.lanes, move.action, move.after)
        kept = record(seen, intended), keep(seen, notes), task.metrics(robot, seen)
        return _next(robot, task, carry, seen, task_numbers), kept

    carry, kept = rollout(robot, act, watch, carry, rows)
    return (carry.lanes, *narrow(kept))


def _next(robot: Robot, task: Task, carry: _Carry, seen: Transition, numbers: Any) -> _Carry:
    """The lanes after a step; those whose episode has ended are replaced by their fresh states."""

    def refill() -> tuple[EnvState, jax.Array]:
        # A fourth key, because `generate_unroll` uses the first three.
        keys = jax.vmap(lambda key: jax.random.split(key, 4)[3])(carry.fresh.keys)
        fresh = select(carry.used, task.start(robot, keys), carry.fresh)
        return fresh, jnp.zeros_like(carry.used)

    # Only if a lane ends a second episode in one rollout, draw new fresh states in the loop.
    none_left = (seen.last & carry.used).any()
    fresh, used = jax.lax.cond(none_left, refill, lambda: (carry.fresh, carry.used))
    going = carry.lanes.replace(robots=seen.after, episode_step=carry.lanes.episode_step + 1)
    going = task.advance(going, numbers)
    return _Carry(select(seen.last, fresh, going), fresh, used | seen.last)
