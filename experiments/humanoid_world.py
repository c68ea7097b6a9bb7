"""The harder problem, velocities in the world's frame: `python -m experiments.humanoid_world`.

What PyBullet tells of a humanoid's velocity is turned by the yaw already, which takes from LFM
some of what it is to learn. Here the same record is read with the velocity as the world has it:
the same walks, the same actions, the same 𝒢, another s.
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
    """Humanoid states `[..., 43]` as HumanoidWorld has them.

    Turned so that it faces +x a robot reads the same in both frames; turned back, its velocity
    goes with it in one of them.
    """
    heading, world, x = Humanoid().observation, HumanoidWorld().observation, jnp.asarray(s)
    yaw = heading.yaw(x)
    return np.asarray(world.rotate(heading.rotate(x, -yaw), yaw))


def record(options: table1.Table) -> Experience:
    """The Humanoid's record in the place of HumanoidWorld's; collected, unless it is there."""
    lr = by_name("LR", Humanoid.name)
    source, target = (
        make_run(robot(engine=options.engine), lr, options) for robot in (Humanoid, HumanoidWorld)
    )
    assert isinstance(source, InverseDynamicsRun) and isinstance(target, InverseDynamicsRun)
    stage = target.experience_stage

    def work() -> dict[str, Any]:
        seen = source.experience()
        seen = seen.replace(s=in_world(seen.s))
        seen.save(stage.path("experience") / "chunk_00000", overwrite=True)
        return source.experience_stage.summary()

    stage.run_once(work)
    return target.experience()


def main(
    options: Annotated[table1.Table, tyro.conf.arg(name="")] = table1.Table(methods=METHODS),
) -> None:
    """Reads the Humanoid's record in the world's frame, then runs the methods on it."""
    record(options)
    table1.table1(dataclasses.replace(options, robot=HumanoidWorld.name))


if __name__ == "__main__":
    run_cli(main, "The Humanoid with its velocity in the world's frame: RL, GE and LR.")
