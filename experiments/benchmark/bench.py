"""What rows share: the robot, the sizes, and objects that are made once for several rows."""

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
    """Options of the benchmark.

    Attributes:
      robot: name of the robot.
      engine: engine that steps the robot; default: the robot's choice. The rows of raw stepping
        measure every engine in any case.
      out: JSON file of the rows; default: experiments/results/ROBOT_benchmark.json.
      run: directory of a finished fit, whose controller is evaluated; default: an untrained
        controller. It determines the length of episodes, and so the share of useful steps.
      rows: names, or parts of names, of the rows to measure; the rows that these are compared
        with are added. The file contains no other rows. Default: all.
      seconds: measuring time of each row.
      num_envs: lanes in the rows of collecting.
      wide: lanes in the rows of 𝒢 and evaluation.
      scenarios: number of test seeds, and of episodes per seed, in the rows of useful steps.
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
    """The state that all rows share.

    Attributes:
      robot: the robot to step.
      options: sizes and times.
      exits: closes resources at the end.
    """

    robot: Robot
    options: Options
    exits: contextlib.ExitStack
    _made: dict[Callable[[Bench], Any], Any] = dataclasses.field(default_factory=dict)

    def once(self, make: Callable[[Bench], T]) -> T:
        """Returns `make(self)`; calls `make` only the first time."""
        if make not in self._made:
            self._made[make] = make(self)
        return self._made[make]

    def num_envs(self, wide: bool) -> int:
        """Number of lanes: that of 𝒢 and evaluation if `wide`, else that of collecting."""
        return self.options.wide if wide else self.options.num_envs

    @functools.cached_property
    def mesh(self) -> Mesh:
        """The devices that share the lanes."""
        return self.robot.mesh()

    @functools.cached_property
    def scratch(self) -> Path:
        """A temporary directory, removed at the end."""
        return Path(self.exits.enter_context(tempfile.TemporaryDirectory(prefix="genidm-")))


def counted(n: int, what: str) -> str:
    """A number with its noun: "1 lane", "8 lanes"."""
    return f"{n} {what}{'s' if n > 1 else ''}"
