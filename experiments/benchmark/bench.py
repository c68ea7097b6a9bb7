"""What rows share: the robot, the sizes, and what is made once for several of them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from jax.sharding import Mesh

from genidm.agents.ppo import PPO
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.robots import Robot

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Options:
    """What is measured, and for how long.

    Attributes:
      robot: by its name.
      engine: steps the robot; the robot chooses, unless given. The rows of raw stepping measure
        every engine in any case.
      out: where the rows are written, as JSON; experiments/results/ROBOT_benchmark.json,
        unless given.
      run: the finished fit stage whose controller is evaluated; an untrained one, unless
        given. It decides how long episodes are, and with that the useful share.
      rows: only the rows of these names, or of which these are a part, and those that they
        are compared with; the file then holds no others.
      seconds: of measuring, for each row.
      num_envs: robots at once in the rows of collecting.
      wide: robots at once in the rows of 𝒢 and evaluation.
      scenarios: test seeds, and episodes for each of them, of the useful share of evaluation.
    """

    robot: str = "ant"
    engine: str | None = None
    out: Path | str | None = None
    run: Path | str | None = None
    rows: tuple[str, ...] = ()
    seconds: float = 60.0
    num_envs: int = PPO().num_envs
    wide: int = EvaluationSettings().num_envs
    scenarios: tuple[int, int] = (10, 1000)

    def __post_init__(self) -> None:
        if not 0 < self.seconds < math.inf:
            raise BadInput(f"seconds must be a number above 0, not {self.seconds}")
        if min(self.num_envs, self.wide, *self.scenarios) < 1:
            raise BadInput("num_envs, wide and both numbers of scenarios must be at least 1")


@dataclasses.dataclass
class Bench:
    """Where rows are measured.

    Attributes:
      robot: whose physics is stepped.
      options: sizes.
      exits: what is to be closed at the end.
    """

    robot: Robot
    options: Options
    exits: contextlib.ExitStack
    _made: dict[Callable[[Bench], Any], Any] = dataclasses.field(default_factory=dict)

    def once(self, make: Callable[[Bench], T]) -> T:
        """What `make` makes of this bench, made when it is first asked for."""
        if make not in self._made:
            self._made[make] = make(self)
        return self._made[make]

    def num_envs(self, wide: bool) -> int:
        """Robots at once: as in 𝒢 and evaluation, or as in collecting."""
        return self.options.wide if wide else self.options.num_envs

    @functools.cached_property
    def mesh(self) -> Mesh:
        """The devices that share the robot's lanes."""
        return self.robot.mesh()

    @functools.cached_property
    def scratch(self) -> Path:
        """A directory that is removed at the end."""
        return Path(self.exits.enter_context(tempfile.TemporaryDirectory(prefix="genidm-")))


def counted(n: int, what: str) -> str:
    """A number of things, in words: "1 lane", "8 lanes"."""
    return f"{n} {what}{'s' if n > 1 else ''}"
