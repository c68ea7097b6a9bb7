"""Hindsight experience replay (Andrychowicz et al. 2017): reached positions become goals."""

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
    """Settings of hindsight experience replay: how sampled steps get new goals.

    Attributes:
      goal_selection_strategy: the new goal is a position that the episode reaches after this step
        ("future"), its last position ("final"), or any of its positions ("episode"). For an
        unfinished episode, the stored steps count.
      n_sampled_goal: number of relabelled steps per step with its original goal, on average.
    """

    goal_selection_strategy: Strategy = "future"
    n_sampled_goal: int = 4

    def __post_init__(self) -> None:
        check(self, n_sampled_goal=count())

    def goal(
        self, buffer: Buffer, left: jax.Array, at: Index, key: jax.Array, height: float
    ) -> jax.Array:
        """Goals `[N, 3]` of sampled steps, relabelled with probability n / (n + 1).

        n is `n_sampled_goal`.

        Args:
          buffer: the stored steps.
          left: `steps_left(buffer)`.
          at: the sampled steps.
          key: random key.
          height: metres, the height of all goals of the task.
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
        """Offsets `[N]` from a step to the first and last step whose o_next may be its goal."""
        left = left[at.row, at.lane]
        if self.goal_selection_strategy == "future":
            return jnp.zeros_like(left), left
        if self.goal_selection_strategy == "final":
            return left, left
        older = (at.row - buffer.oldest) % buffer.rows.last.shape[0]  # rows before this step
        return -jnp.minimum(buffer.rows.episode_step[at.row, at.lane], older), left
