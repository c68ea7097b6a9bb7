"""The iteration that all learners share: every device steps its own lanes, then one learns."""

from __future__ import annotations

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


def alternating(
    title: str,
    start: Callable[[jax.Array], Learner],
    acting: Callable[[Any], Any],
    stepping: Callable[..., Any],
    learn: Callable[..., Any],
    mesh: Mesh,
) -> Learning:
    """An agent whose iteration is two programs.

    Args:
      title: what the learner is called in messages.
      start: key → learner.
      acting: training state → statistics and policy, a copy on every device.
      stepping: the jitted (*acting(training), lanes `[B]`) → (lanes, Experience, what is
        learned from, metrics), all but the lanes `[unroll, B, ...]`; it donates the lanes.
      learn: (training state, what is learned from) → (training state, losses), on one device.
      mesh: the devices that share the lanes; its first one learns.
    """

    def place(learner: Learner) -> Learner:
        return Learner(devices.put(learner.lanes, mesh), devices.gather(learner.training, mesh))

    def prepare(learner: Learner) -> Iterate:
        args = (*acting(learner.training), learner.lanes)
        step = compiled(f"{title}'s stepping", stepping, *args)
        batch = jax.eval_shape(stepping, *args)[2]
        donating = jax.jit(learn, donate_argnums=0)
        update = compiled(f"{title}'s learning", donating, learner.training, batch)

        def iterate(learner: Learner) -> tuple[Learner, Experience, Metrics]:
            lanes, experience, batch, seen = step(*acting(learner.training), learner.lanes)
            training, losses = update(learner.training, devices.gather(batch, mesh))
            return Learner(lanes, training), experience, seen | losses

        return iterate

    return Learning(start, place, prepare)
