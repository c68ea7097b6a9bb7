"""The iteration that all learners share: every device steps its own lanes, then one learns."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Iterate, Learning, Metrics
from genidm.experience import Experience
from genidm.progress import compiled
from genidm.tasks import Lanes


class Learner(flax.struct.PyTreeNode):
    """All that is carried from one iteration to the next."""

    lanes: Lanes
    training: Any


@dataclasses.dataclass(frozen=True)
class Alternating:
    """An iteration of two programs: all devices step, then one learns and the others wait.

    Attributes:
      title: what the learner is called in messages.
      start: key → learner.
      chosen: training state → (statistics, policy): what of it chooses actions.
      walk: (statistics, policy, lanes `[B]`) → (lanes, Experience, what is learned from,
        metrics), all but the lanes `[unroll, B, ...]`.
      learn: (training state, what is learned from) → (training state, losses).
      mesh: the devices that share the lanes; its first one learns.
    """

    title: str
    start: Callable[[jax.Array], Learner]
    chosen: Callable[[Any], tuple[Any, Any]]
    walk: Callable[..., Any]
    learn: Callable[..., Any]
    mesh: Mesh

    @functools.cached_property
    def stepping(self) -> Any:
        """The first program: `walk`, each device with its own lanes, which it donates."""
        sharded = devices.over_lanes(self.walk, self.mesh, [None, None, 0], (0, 1, 1, 1))
        return jax.jit(sharded, donate_argnums=2)

    @functools.cached_property
    def updating(self) -> Any:
        """The second program: `learn`, on one device; it donates the training state."""
        return jax.jit(self.learn, donate_argnums=0)

    def acting(self, training: Any) -> tuple[Any, Any]:
        """What chooses actions, a copy on every device."""
        return devices.put(self.chosen(training), self.mesh, None)

    def place(self, learner: Learner) -> Learner:
        return Learner(
            devices.put(learner.lanes, self.mesh), devices.gather(learner.training, self.mesh)
        )

    def prepare(self, learner: Learner) -> Iterate:
        args = (*self.acting(learner.training), learner.lanes)
        step = compiled(f"{self.title}'s stepping", self.stepping, *args)
        batch = jax.eval_shape(self.stepping, *args)[2]
        update = compiled(f"{self.title}'s learning", self.updating, learner.training, batch)

        def iterate(learner: Learner) -> tuple[Learner, Experience, Metrics]:
            lanes, experience, batch, seen = step(*self.acting(learner.training), learner.lanes)
            training, losses = update(learner.training, devices.gather(batch, self.mesh))
            return Learner(lanes, training), experience, seen | losses

        return iterate

    def learning(self) -> Learning:
        """As `collect` asks for it."""
        return Learning(self.start, self.place, self.prepare)
