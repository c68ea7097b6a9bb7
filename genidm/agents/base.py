"""The interface between `collect` and an agent."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import jax
from jax.sharding import Mesh

from genidm.agents.policy import Policy
from genidm.experience import Experience
from genidm.robots.base import Robot
from genidm.tasks import Task

Metrics = dict[str, jax.Array]
Iterate = Callable[[Any], tuple[Any, Experience, Metrics]]


class Learning(NamedTuple):
    """The functions that train an agent on a robot.

    Attributes:
      start: key → learner: a tree of arrays with everything that a resume needs.
      place: learner → the same learner, moved to the devices of the mesh.
      prepare: learner → `iterate`: compiles the agent's programs for a placed learner.
        `iterate` maps a learner, which it donates, to (learner, Experience
        `[unroll_length, num_envs, ...]` on the devices, metrics).
    """

    start: Callable[[jax.Array], Any]
    place: Callable[[Any], Any]
    prepare: Callable[[Any], Iterate]


class Agent(abc.ABC):
    """Settings of an agent; subclasses are frozen dataclasses, whose fields become flags.

    Attributes:
      num_envs: number of lanes: environments that step together.
      unroll_length: environment steps per lane in one iteration.
    """

    @property
    @abc.abstractmethod
    def num_envs(self) -> int: ...
    @property
    @abc.abstractmethod
    def unroll_length(self) -> int: ...

    @abc.abstractmethod
    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        """Functions that train the agent on this robot, with its lanes sharded over the mesh."""

    @abc.abstractmethod
    def policy(self, robot: Robot, task: Task, learner: Any) -> Policy | None:
        """The learned policy, without exploration; None for an agent that does not learn."""

    def for_accelerator(self) -> Self:
        """Settings for an accelerator: the same settings, unless a subclass overrides this."""
        return self
