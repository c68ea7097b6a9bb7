"""The harder problem, velocities in the world's frame: `python -m experiments.humanoid_world`.

PyBullet's velocity of the Humanoid is in the heading frame, so it is already invariant to the
yaw. Here the same experience has the velocity in the world's frame, so the LFM has to learn this
invariance: the same episodes, actions and 𝒢, another s.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import tyro

from experiments import table1
from genidm.experience import Experience
from genidm.offline.methods import AnyMethod
from genidm.robots import Humanoid, HumanoidWorld, Robot
from genidm.runs.cell import make_run
from genidm.runs.command import run_cli
from genidm.runs.fitting import InverseDynamicsRun
from genidm.runs.resolve import Options
from genidm.runs.run import Run
from genidm.store import Stage

METHODS = ("RL", "GE", "LR")


def in_world(s: np.ndarray) -> np.ndarray:
    """Converts states `[..., 43]` of the Humanoid to those of HumanoidWorld.

    At yaw 0 the two states are equal. So each state is rotated to yaw 0 as the Humanoid's, and
    back as HumanoidWorld's.
    """
    heading, world, x = Humanoid().observation, HumanoidWorld().observation, jnp.asarray(s)
    yaw = heading.yaw(x)
    return np.asarray(world.rotate(heading.rotate(x, -yaw), yaw))


@dataclasses.dataclass(frozen=True)
class ConvertedRun(InverseDynamicsRun):
    """A run on the experience of another run, converted by `in_world`.

    Attributes:
      source: the run of the Humanoid.
    """

    source: InverseDynamicsRun | None = None

    @functools.cached_property
    def experience_stage(self) -> Stage:
        assert self.source
        config = {"converted_from": self.source.experience_stage.directory.name}
        return self._stage(f"experience-converted-{self.seed}", config, __name__, __name__)

    @property
    def sources(self) -> list[Stage]:
        assert self.source
        return [*self.source.sources[:-1], *super().sources]

    def _collected(self, made: list[Experience]) -> dict[str, Any]:
        assert self.source
        stage, experience = self.experience_stage, self.source.experience()
        converted = experience.replace(s=in_world(experience.s))
        converted.save(stage.path("experience") / "chunk_00000", overwrite=True)
        made.append(converted)
        summary: dict[str, Any] = self.source.experience_stage.summary()
        return summary


def converted(robot: Robot, method: AnyMethod, options: Options) -> Run[Any]:
    """The run of a method on HumanoidWorld, on the experience of the same run on the Humanoid."""
    source = make_run(Humanoid(engine=options.engine), method, options)
    run = make_run(robot, method, options)
    if not isinstance(source, InverseDynamicsRun):
        return run
    fields = {f.name: getattr(run, f.name) for f in dataclasses.fields(run)}
    return ConvertedRun(**fields, source=source)


def main(
    options: Annotated[table1.Table, tyro.conf.arg(name="")] = table1.Table(methods=METHODS),
) -> None:
    """Converts the Humanoid's experience to the world's frame and runs the methods on it."""
    table1.table1(dataclasses.replace(options, robot=HumanoidWorld.name), converted)


if __name__ == "__main__":
    run_cli(main, "The Humanoid with its velocity in the world's frame: RL, GE and LR.")
