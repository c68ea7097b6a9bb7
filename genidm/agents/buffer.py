"""A replay buffer that preserves episodes: a ring of environment steps on one device.

A row holds one step of every lane. Rows are in time order, so the next step of an episode
is in the next row of the same column.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from genidm.errors import BadInput
from genidm.robots.base import Robot
from genidm.tasks import Transition


class ReplayTransition(flax.struct.PyTreeNode):
    """Stored steps `[...]`; the state after a step is s of the next row.

    Attributes:
      s: `[..., S]`, state before the step, as the policy sees it.
      o: `[..., 3]`, position before the step, metres, world frame.
      o_next: `[..., 3]`, position after the step, before any reset.
      a: `[..., A]`, action, as the policy chose it.
      goal: `[..., 3]`, metres, world frame; None if the task has no goals.
      cost: control and contact costs.
      fallen: bool, the robot fell, or its physics diverged.
      reward: see `Transition`.
      absorbing_reward: see `Transition`.
      terminal: see `Transition`.
      last: see `Transition`.
      episode_step: see `Transition`.
    """

    s: Any
    o: Any
    o_next: Any
    a: Any
    goal: Any
    cost: Any
    fallen: Any
    reward: Any
    absorbing_reward: Any
    terminal: Any
    last: Any
    episode_step: Any


def to_replay_transition(robot: Robot, step: Transition) -> ReplayTransition:
    """Convert one transition of B lanes to what the buffer stores, `[B, ...]`."""
    return ReplayTransition(
        s=step.view.state(robot, step.before),
        o=step.before.position,
        o_next=step.after.position,
        a=step.view.seen_action(robot, step.before, step.action),
        goal=step.goal,
        cost=robot.cost(step.after, step.action),
        fallen=step.after.fallen | step.after.diverged,
        reward=step.reward,
        absorbing_reward=step.absorbing_reward,
        terminal=step.terminal,
        last=step.last,
        episode_step=step.episode_step,
    )


class Buffer(flax.struct.PyTreeNode):
    """The newest T steps of B lanes.

    Attributes:
      rows: ReplayTransition `[T, B, ...]`, a ring: the n-th written row is at index n mod T.
      written: int32, number of rows written since the start.
    """

    rows: ReplayTransition
    written: jax.Array

    @property
    def filled(self) -> jax.Array:
        """Number of rows that hold steps."""
        return jnp.minimum(self.written, self.rows.last.shape[0])

    @property
    def oldest(self) -> jax.Array:
        """Index of the oldest row."""
        return (self.written - self.filled) % self.rows.last.shape[0]


class Index(NamedTuple):
    """Indices of N steps in a buffer: `row [N]` and `lane [N]`, int32."""

    row: jax.Array
    lane: jax.Array


def empty(part: ReplayTransition, max_replay_size: int) -> Buffer:
    """An empty buffer.

    Args:
      part: ReplayTransition `[U, B, ...]` of one iteration, or its shapes.
      max_replay_size: steps, over all lanes; rounded down to whole iterations.

    Raises:
      BadInput: the buffer is smaller than two iterations.
    """
    unroll_length, lanes = part.last.shape
    rows = max_replay_size // (unroll_length * lanes) * unroll_length
    if rows < 2 * unroll_length:
        size = unroll_length * lanes
        raise BadInput(
            f"max_replay_size {max_replay_size} is less than two iterations of {size} steps"
        )
    blank = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape[1:]), x.dtype), part)
    return Buffer(blank, jnp.zeros((), jnp.int32))


def add(buffer: Buffer, part: ReplayTransition) -> Buffer:
    """Overwrite the oldest rows with a part `[U, B, ...]`; U must divide T."""
    row = buffer.written % buffer.rows.last.shape[0]

    def write(ring: jax.Array, new: jax.Array) -> jax.Array:
        return jax.lax.dynamic_update_slice_in_dim(ring, new, row, axis=0)

    rows = jax.tree.map(write, buffer.rows, part)
    return Buffer(rows, buffer.written + part.last.shape[0])


@functools.partial(jax.jit, static_argnums=1)
def newest(buffer: Buffer, count: int) -> ReplayTransition:
    """The newest rows `[count, B, ...]`, oldest first."""
    row = (buffer.written - count + jnp.arange(count)) % buffer.rows.last.shape[0]
    return jax.tree.map(lambda x: x[row], buffer.rows)


def steps_left(buffer: Buffer) -> jax.Array:
    """Number of stored steps `[T, B]` int32 that follow each step in its episode."""
    rows = buffer.rows.last.shape[0]
    last = jnp.roll(buffer.rows.last, -buffer.oldest, axis=0)
    time = jnp.arange(rows, dtype=jnp.int32)[:, None]
    ends = jnp.where(last | (time == buffer.filled - 1), time, rows)
    end = jax.lax.cummin(ends, axis=0, reverse=True)
    return jnp.roll(end - time, buffer.oldest, axis=0)


def sample_index(buffer: Buffer, key: jax.Array, size: int) -> Index:
    """Sample steps uniformly; exclude the newest row, because its next state is not stored yet."""
    rows, lanes = buffer.rows.last.shape
    which, where = jax.random.split(key)
    row = jax.random.randint(which, (size,), 0, buffer.filled - 1)
    return Index((buffer.oldest + row) % rows, jax.random.randint(where, (size,), 0, lanes))


def gather(buffer: Buffer, at: Index) -> tuple[ReplayTransition, jax.Array]:
    """Steps `[N, ...]` at the given indices, and their next states `[N, S]`.

    After the last step of an episode, the next state is the first of the next episode.
    """
    rows = buffer.rows.last.shape[0]
    return (
        jax.tree.map(lambda x: x[at.row, at.lane], buffer.rows),
        buffer.rows.s[(at.row + 1) % rows, at.lane],
    )
