"""What `collect` asks of an agent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
from jax.sharding import Mesh

from genidm import devices
from genidm.experience import Experience
from genidm.robots.base import Robot
from genidm.tasks import WalkForward


class Learning(NamedTuple):
    """An agent at work on a robot: two jitted programs.

    Attributes:
      start: key → learner, a tree of arrays that holds all there is to resume from.
      iterate: learner → (learner, Experience `[unroll, lanes, ...]`, scalar metrics).
        The learner is donated.
    """

    start: Callable[[jax.Array], Any]
    iterate: Callable[[Any], tuple[Any, Experience, dict[str, jax.Array]]]


class Agent(Protocol):
    """Settings of an agent: a frozen dataclass.

    Attributes:
      lanes: robots at once.
      unroll: steps an iteration.
    """

    @property
    def lanes(self) -> int: ...
    @property
    def unroll(self) -> int: ...

    def learning(self, robot: Robot, task: WalkForward, mesh: Mesh) -> Learning:
        """The agent's programs for this robot, its lanes sharded over the mesh."""


def place(learner: Any, mesh: Mesh) -> Any:
    """Moves a learner onto the mesh: its lanes shared out, all else on every device."""
    return devices.put(learner, mesh, None).replace(lanes=devices.put(learner.lanes, mesh))
