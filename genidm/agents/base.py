"""What `collect` asks of an agent."""

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
    """An agent at work on a robot.

    Attributes:
      start: key → learner: a tree of arrays that holds all there is to resume from.
      place: learner → the same learner on its devices, from wherever it was.
      prepare: learner → `iterate`: compiles the agent's programs for a placed learner.
        `iterate` takes a learner, which it donates, to (learner, Experience
        `[unroll_length, lanes, ...]` on the devices, metrics).
    """

    start: Callable[[jax.Array], Any]
    place: Callable[[Any], Any]
    prepare: Callable[[Any], Iterate]


class Agent(abc.ABC):
    """Settings of an agent; subclasses are frozen dataclasses, so that their fields are flags.

    Attributes:
      num_envs: robots at once.
      unroll_length: steps an iteration.
    """

    @property
    @abc.abstractmethod
    def num_envs(self) -> int: ...
    @property
    @abc.abstractmethod
    def unroll_length(self) -> int: ...

    @abc.abstractmethod
    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        """The agent on this robot, its lanes sharded over the mesh."""

    @abc.abstractmethod
    def policy(self, robot: Robot, task: Task, learner: Any) -> Policy | None:
        """The policy of a learner, without exploration; None if it learns nothing."""

    def for_accelerator(self) -> Self:
        """The settings where jax runs on an accelerator: these, unless a subclass has others."""
        return self
