"""What all learners share: in an iteration every device steps its own lanes, then one learns."""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import flax.struct
import jax
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Iterate, Learning, Metrics
from genidm.agents.policy import Activation, Policy
from genidm.experience import Experience
from genidm.progress import compiled
from genidm.robots.base import Robot
from genidm.rollout import narrow
from genidm.tasks import Lanes, Task


class Learner(flax.struct.PyTreeNode):
    """All that is carried from one iteration to the next.

    Attributes:
      lanes: the robots.
      training: what learns. Its `chosen` is what of it chooses actions: (statistics of the
        inputs, parameters of the policy network).
    """

    lanes: Lanes
    training: Any


@dataclasses.dataclass(frozen=True)
class Alternating:
    """An iteration of two programs: all devices step, then one learns and the others wait.

    Attributes:
      title: what the learner is called in messages.
      start: key → learner.
      walk: (statistics, policy, lanes `[B]`) → (lanes, Experience, what is learned from,
        metrics), all but the lanes `[unroll, B, ...]`.
      learn: (training state, what is learned from) → (training state, losses).
      mesh: the devices that share the lanes; its first one learns.
    """

    title: str
    start: Callable[[jax.Array], Learner]
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
        return devices.put(training.chosen, self.mesh, None)

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


class Alternates(abc.ABC):
    """Settings of an agent whose iteration is Alternating.

    Attributes:
      activation: of the policy's hidden layers.
      hidden: layers of the policy.
    """

    activation: ClassVar[Activation]
    hidden: tuple[int, ...]

    @abc.abstractmethod
    def programs(self, robot: Robot, task: Task, mesh: Mesh) -> Alternating:
        """The two programs of an iteration."""

    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        return self.programs(robot, task, mesh).learning()

    def policy(self, robot: Robot, task: Task, learner: Learner) -> Policy:
        """The policy of a learner, without exploration."""
        statistics, params = learner.training.chosen
        statistics = narrow(statistics)
        return Policy(
            params=params, mean=statistics.mean, std=statistics.std, hidden=self.hidden,
            activation=self.activation, directed=task.directed, robot=robot,
        )  # fmt: skip
