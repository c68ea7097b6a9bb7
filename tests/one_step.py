"""One step of every lane, whose fresh start is drawn in it: what `walking.walk` does in a loop."""

from __future__ import annotations

import jax

from genidm.robots import Robot
from genidm.robots.base import select
from genidm.tasks import Lanes, Step, Task


def advance(task: Task, robot: Robot, lanes: Lanes, action: jax.Array) -> tuple[Lanes, Step]:
    """One step of every lane under `[B, A]`; where an episode ended, a fresh one is drawn."""
    step = task.judge(robot, lanes, action, robot.step(lanes.robots, action))
    going = lanes.replace(robots=step.after, age=lanes.age + 1)
    return select(step.last, task.start(robot, lanes.keys), going), step


def split(lanes: Lanes) -> tuple[Lanes, jax.Array]:
    """Draws one key a lane `[B]` from the lanes' own streams."""
    streams = jax.vmap(jax.random.split)(lanes.keys)
    return lanes.replace(keys=streams[:, 0]), streams[:, 1]
