"""One step of every lane, its fresh start drawn in it: `unroll.generate_unroll` without a loop."""

from __future__ import annotations

import jax

from genidm.robots import Robot
from genidm.robots.base import select
from genidm.tasks import EnvState, Task, Transition


def advance(
    task: Task, robot: Robot, lanes: EnvState, action: jax.Array
) -> tuple[EnvState, Transition]:
    """One step of every lane under `[B, A]`; where an episode ended, a fresh one is drawn."""
    step = task.transition(robot, lanes, action, robot.step(lanes.robots, action))
    going = lanes.replace(robots=step.after, episode_step=lanes.episode_step + 1)
    return select(step.last, task.start(robot, lanes.keys), going), step


def split(lanes: EnvState) -> tuple[EnvState, jax.Array]:
    """Draws one key a lane `[B]` from the lanes' own streams."""
    streams = jax.vmap(jax.random.split)(lanes.keys)
    return lanes.replace(keys=streams[:, 0]), streams[:, 1]
