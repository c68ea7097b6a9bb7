"""Random sampling (RS, §5.1): actions drawn at random at each step."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Iterate, Learning, Metrics
from genidm.errors import BadInput
from genidm.experience import Experience, record
from genidm.progress import compiled
from genidm.robots.base import Robot
from genidm.tasks import Lanes, Task, split


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

    def __post_init__(self) -> None:
        if self.lanes < 1 or self.unroll < 1:
            raise BadInput("random sampling needs lanes and unroll of at least 1")

    def policy(self, robot: Robot, task: Task, learner: Learner) -> None:
        """There is none: nothing is learned."""

    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        draw = jax.vmap(lambda key: jax.random.uniform(key, (robot.action.size,), minval=-1.0))

        def step(lanes: Lanes, _: None) -> tuple[Lanes, Any]:
            lanes, keys = split(lanes)
            lanes, transition = task.advance(robot, lanes, draw(keys))
            return lanes, (record(transition), task.metrics(robot, transition))

        def walk(lanes: Lanes) -> tuple[Lanes, Any]:
            return jax.lax.scan(step, lanes, length=self.unroll)

        def start(key: jax.Array) -> Learner:
            return Learner(task.start(robot, jax.random.split(key, self.lanes)))

        def prepare(learner: Learner) -> Iterate:
            sharded = jax.jit(devices.over_lanes(walk, mesh, [0], (0, 1)), donate_argnums=0)
            program = compiled("random stepping", sharded, learner.lanes)

            def iterate(learner: Learner) -> tuple[Learner, Experience, Metrics]:
                lanes, (experience, seen) = program(learner.lanes)
                return Learner(lanes), experience, seen

            return iterate

        return Learning(start, lambda learner: devices.put(learner, mesh), prepare)
