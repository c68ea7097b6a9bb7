"""What a robot is rewarded for, and when its episode ends, over any Robot.

Collecting rewards walking one way (A.1.1): forward velocity, a bonus for staying up,
minus control and contact costs.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from genidm.robots.base import Robot, State, select


class Lanes(flax.struct.PyTreeNode):
    """B robots in the middle of their episodes.

    Attributes:
      robots: their State.
      age: `[B]` int32, steps since the episode began.
      keys: `[B]`, one random stream a lane, so that results do not depend on sharding.
    """

    robots: State
    age: jax.Array
    keys: jax.Array


class Step(flax.struct.PyTreeNode):
    """One transition of B lanes, before any reset; what learners and records read.

    Attributes:
      before: State `[B]` that the action was chosen in.
      action: a `[B, A]`.
      after: State `[B]` that it led to.
      reward: `[B]`.
      first: `[B]` bool, `before` is the start of an episode.
      terminal: `[B]` bool, the robot fell or its physics diverged.
      last: `[B]` bool, the episode ended here: terminal, or at the time limit.
    """

    before: State
    action: jax.Array
    after: State
    reward: jax.Array
    first: jax.Array
    terminal: jax.Array
    last: jax.Array


@dataclasses.dataclass(frozen=True)
class WalkForward:
    """Walk towards +x for as long as you stand.

    Attributes:
      episode_steps: the time limit.
      start_yaw: radians; starts are turned by a yaw drawn from ± this. 0 is the paper's:
        every episode starts facing +x.
    """

    episode_steps: int = 1000
    start_yaw: float = 0.0

    def start(self, robot: Robot, keys: jax.Array) -> Lanes:
        """Lanes `[B]` at the start of fresh episodes."""
        streams = jax.vmap(lambda k: jax.random.split(k, 3))(keys)
        turn = jax.vmap(lambda k: jax.random.uniform(k, minval=-1.0, maxval=1.0))(streams[:, 0])
        robots = robot.reset(streams[:, 1], self.start_yaw * turn)
        return Lanes(robots, jnp.zeros(keys.shape, jnp.int32), streams[:, 2])

    def reward(self, robot: Robot, before: State, action: jax.Array, after: State) -> jax.Array:
        """Reward `[B]` of one step."""
        forward = (after.position[:, 0] - before.position[:, 0]) / robot.control_step
        alive = robot.alive_bonus * ~(after.fallen | after.diverged)
        return forward + alive - robot.cost(after, action)

    def advance(self, robot: Robot, lanes: Lanes, action: jax.Array) -> tuple[Lanes, Step]:
        """One step of every lane; where an episode ended, a fresh one is drawn."""
        before = lanes.robots
        after = robot.step(before, action)
        terminal = after.fallen | after.diverged
        last = terminal | (lanes.age + 1 >= self.episode_steps)
        step = Step(
            before=before,
            action=action,
            after=after,
            reward=self.reward(robot, before, action, after),
            first=lanes.age == 0,
            terminal=terminal,
            last=last,
        )
        going = Lanes(after, lanes.age + 1, lanes.keys)
        return select(last, self.start(robot, lanes.keys), going), step


def metrics(robot: Robot, step: Step) -> dict[str, jax.Array]:
    """What is worth a learning curve, `[B]` each: forward speed in m/s, reward, falls."""
    forward = step.after.position[:, 0] - step.before.position[:, 0]
    return {
        "reward": step.reward,
        "speed": forward / robot.control_step,
        "falls": 1.0 * step.after.fallen,
        "diverged": 1.0 * step.after.diverged,
    }


def split(lanes: Lanes) -> tuple[Lanes, Any]:
    """Draws one key a lane `[B]` from the lanes' own streams."""
    streams = jax.vmap(jax.random.split)(lanes.keys)
    return lanes.replace(keys=streams[:, 0]), streams[:, 1]
