"""The harder problem, velocities in the world's frame: `python -m experiments.humanoid_world`.

PyBullet's velocity of the Humanoid is in the heading frame, so it is already invariant to the
yaw. Here the same experience has the velocity in the world's frame, so the LFM has to learn this
invariance: the same episodes, actions and 𝒢, another s.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import tyro

from experiments import table1
from genidm.experience import Experience
from genidm.paper.methods import by_name
from genidm.robots import Humanoid, HumanoidWorld
from genidm.runs.cell import make_run
from genidm.runs.command import run_cli
from genidm.runs.run import InverseDynamicsRun

METHODS = ("RL", "GE", "LR")


def in_world(s: np.ndarray) -> np.ndarray:
    """Converts states `[..., 43]` of the Humanoid to those of HumanoidWorld.

    At yaw 0 the two states are equal. So each state is rotated to yaw 0 as the Humanoid's, and
    back as HumanoidWorld's.
    """
    heading, world, x = Humanoid().observation, HumanoidWorld().observation, jnp.asarray(s)
    yaw = heading.yaw(x)
    return np.asarray(world.rotate(heading.rotate(x, -yaw), yaw))


def record(options: table1.Table) -> Experience:
    """Stores the Humanoid's experience, converted, as HumanoidWorld's; collects it if missing."""
    lr = by_name("LR", Humanoid.name)
    source, target = (
        make_run(robot(engine=options.engine), lr, options) for robot in (Humanoid, HumanoidWorld)
    )
    assert isinstance(source, InverseDynamicsRun) and isinstance(target, InverseDynamicsRun)
    stage = target.experience_stage

    def work() -> dict[str, Any]:
        experience = source.experience()
        converted = experience.replace(s=in_world(experience.s))
        converted.save(stage.path("experience") / "chunk_00000", overwrite=True)
        return source.experience_stage.summary()

    stage.run_once(work)
    return target.experience()


def main(
    options: Annotated[table1.Table, tyro.conf.arg(name="")] = table1.Table(methods=METHODS),
) -> None:
    """Converts the Humanoid's experience to the world's frame and runs the methods on it."""
    record(options)
    table1.table1(dataclasses.replace(options, robot=HumanoidWorld.name))


if __name__ == "__main__":
    run_cli(main, "The Humanoid with its velocity in the world's frame: RL, GE and LR.")
