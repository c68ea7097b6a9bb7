"""Random sampling (RS, §5.1): actions drawn at random at each step."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Learning
from genidm.experience import record
from genidm.robots.base import Robot
from genidm.tasks import Lanes, WalkForward, split


class Learner(flax.struct.PyTreeNode):
    """Lanes, and nothing that learns."""

    lanes: Lanes


@dataclasses.dataclass(frozen=True)
class RandomActions:
    """Uniform actions in [−1, 1].

    Attributes:
      lanes: robots at once.
      unroll: steps an iteration.
    """

    lanes: int = 128
    unroll: int = 32

    def learning(self, robot: Robot, task: WalkForward, mesh: Mesh) -> Learning:
        draw = jax.vmap(lambda key: jax.random.uniform(key, (robot.action.size,), minval=-1.0))

        def step(lanes: Lanes, _: None) -> tuple[Lanes, Any]:
            lanes, keys = split(lanes)
            lanes, transition = task.advance(robot, lanes, draw(keys))
            return lanes, (record(transition), transition.reward)

        def rollout(lanes: Lanes) -> tuple[Lanes, Any]:
            return jax.lax.scan(step, lanes, length=self.unroll)

        def start(key: jax.Array) -> Learner:
            return Learner(task.start(robot, jax.random.split(key, self.lanes)))

        def iterate(learner: Learner) -> tuple[Learner, Any, dict[str, jax.Array]]:
            sharded = devices.over_lanes(rollout, mesh, [0], (0, 1))
            lanes, (experience, reward) = sharded(learner.lanes)
            metrics = {"reward": reward.mean(), "diverged": (~experience.valid).sum()}
            return Learner(lanes), experience, metrics

        return Learning(start, jax.jit(iterate, donate_argnums=0))
