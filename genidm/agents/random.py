"""Random sampling (RS, §5.1): a new random action at each step."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Agent, Iterate, Learning, Metrics
from genidm.agents.unroll import generate_unroll
from genidm.checks import check, count
from genidm.experience import Experience
from genidm.progress import compile_ahead
from genidm.robots.base import Robot
from genidm.tasks import EnvState, Task, Transition


@dataclasses.dataclass(frozen=True)
class RandomActions(Agent):
    """Uniform actions in [−1, 1].

    Attributes:
      num_envs: number of lanes: environments that step together.
      unroll_length: environment steps per lane in one iteration.
    """

    num_envs: int = 128
    unroll_length: int = 32

    def __post_init__(self) -> None:
        check(self, num_envs=count(), unroll_length=count())

    def policy(self, robot: Robot, task: Task, learner: EnvState) -> None:
        """None: this agent does not learn."""

    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        def draw(key: jax.Array) -> jax.Array:
            return jax.random.uniform(key, (robot.action.size,), jnp.float32, minval=-1.0)

        def choose(_: jax.Array, drawn: jax.Array) -> tuple[jax.Array, jax.Array, None]:
            return drawn, drawn, None

        def keep(step: Transition, notes: None) -> None:
            """None: this agent does not learn."""

        stepping = functools.partial(
            generate_unroll, robot, task, self.unroll_length, draw, choose, keep
        )

        def start(key: jax.Array) -> EnvState:
            return task.start(robot, jax.random.split(key, self.num_envs))

        def prepare(lanes: EnvState) -> Iterate:
            sharded = devices.over_lanes(stepping, mesh, [0], (0, 1, 1, 1))
            jitted = jax.jit(sharded, donate_argnums=0)
            program = compile_ahead("rollout of random actions", jitted, lanes)

            def iterate(lanes: EnvState) -> tuple[EnvState, Experience, Metrics]:
                lanes, experience, _, seen = program(lanes)
                return lanes, experience, seen

            return iterate

        return Learning(start, lambda lanes: devices.put(lanes, mesh), prepare)
