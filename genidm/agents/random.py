"""Random sampling (RS, §5.1): actions drawn at random at each step."""

from __future__ import annotations

import dataclasses
import functools

import flax.struct
import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Iterate, Learning, Metrics
from genidm.agents.walking import walk
from genidm.checks import check, count
from genidm.experience import Experience
from genidm.progress import compiled
from genidm.robots.base import Robot
from genidm.tasks import Lanes, Step, Task


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
        check(self, lanes=count(), unroll=count())

    def policy(self, robot: Robot, task: Task, learner: Learner) -> None:
        """There is none: nothing is learned."""

    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        def draw(key: jax.Array) -> jax.Array:
            return jax.random.uniform(key, (robot.action.size,), jnp.float32, minval=-1.0)

        def choose(_: jax.Array, drawn: jax.Array) -> tuple[jax.Array, None]:
            return drawn, None

        def keep(step: Step, notes: None) -> None:
            """Nothing: nothing is learned."""

        stepping = functools.partial(walk, robot, task, self.unroll, draw, choose, keep)

        def start(key: jax.Array) -> Learner:
            return Learner(task.start(robot, jax.random.split(key, self.lanes)))

        def prepare(learner: Learner) -> Iterate:
            sharded = devices.over_lanes(stepping, mesh, [0], (0, 1, 1, 1))
            jitted = jax.jit(sharded, donate_argnums=0)
            program = compiled("random stepping", jitted, learner.lanes)

            def iterate(learner: Learner) -> tuple[Learner, Experience, Metrics]:
                lanes, experience, _, seen = program(learner.lanes)
                return Learner(lanes), experience, seen

            return iterate

        return Learning(start, lambda learner: devices.put(learner, mesh), prepare)
