"""Hindsight experience replay (Andrychowicz et al. 2017): where a robot got to was a goal."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp

from genidm.agents.buffer import Buffer, Index
from genidm.checks import check, count

Strategy = Literal["future", "final", "episode"]


@dataclasses.dataclass(frozen=True)
class HER:
    """Settings of the relabelling.

    Attributes:
      goal_selection_strategy: goals are positions after this step in its episode ("future"), the
        last one of the episode ("final"), or any of it ("episode"). Of an episode that is not over,
        what has happened so far counts.
      n_sampled_goal: of each step drawn with its own goal, this many are drawn with another.
    """

    goal_selection_strategy: Strategy = "future"
    n_sampled_goal: int = 4

    def __post_init__(self) -> None:
        check(self, n_sampled_goal=count())

    def goal(
        self, buffer: Buffer, left: jax.Array, at: Index, key: jax.Array, height: float
    ) -> jax.Array:
        """Goals `[N, 3]` for the steps at an index, `n_sampled_goal` of n + 1 relabelled.

        Args:
          buffer: what happened.
          left: `steps_left` of it.
          at: the steps.
          key: of which are relabelled, and to what.
          height: metres; goals are given it, as all goals of the task have it.
        """
        which, when = jax.random.split(key)
        relabelled = jax.random.uniform(which, at.row.shape, jnp.float32) < self.n_sampled_goal / (
            self.n_sampled_goal + 1
        )
        first, last = self._window(buffer, left, at)
        offset = jax.random.randint(when, at.row.shape, first, last + 1)
        row = (at.row + offset) % buffer.rows.last.shape[0]
        reached = buffer.rows.o_next[row, at.lane].at[:, 2].set(height)
        return jnp.where(relabelled[:, None], reached, buffer.rows.goal[at.row, at.lane])

    def _window(self, buffer: Buffer, left: jax.Array, at: Index) -> tuple[jax.Array, jax.Array]:
        """First and last step `[N]` whose outcome may be the goal, counted from this step."""
        left = left[at.row, at.lane]
        if self.goal_selection_strategy == "future":
            return jnp.zeros_like(left), left
        if self.goal_selection_strategy == "final":
            return left, left
        kept = (at.row - buffer.oldest) % buffer.rows.last.shape[0]  # rows before it
        return -jnp.minimum(buffer.rows.episode_step[at.row, at.lane], kept), left
