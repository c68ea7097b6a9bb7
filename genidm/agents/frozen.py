"""An agent whose policy is fixed after training: how the Humanoid collects (A.1.2)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Agent, Iterate, Learning, Metrics
from genidm.agents.policy import Policy, no_statistics
from genidm.agents.rollout_then_learn import LearningAgent
from genidm.checks import check, number
from genidm.experience import Experience
from genidm.progress import compile_ahead
from genidm.robots.base import Robot
from genidm.tasks import EnvState, Task, input_size


@dataclasses.dataclass(frozen=True)
class Frozen:
    """Settings to train an agent first, and then record experience with its fixed policy.

    The training steps are not recorded. The final policy collects the record, with the same
    exploration as in training.

    Attributes:
      agent: settings of the agent that is trained.
      fraction: fraction of the interactions that are for training, in (0, 1).
    """

    agent: LearningAgent
    fraction: float

    def __post_init__(self) -> None:
        check(self, fraction=number(0, 1, above=True, below=True))

    def for_accelerator(self) -> Frozen:
        """These settings, with the agent's settings for an accelerator."""
        return dataclasses.replace(self, agent=self.agent.for_accelerator())


@dataclasses.dataclass(frozen=True)
class Acting(Agent):
    """An agent that collects with a fixed policy and does not learn.

    Attributes:
      agent: settings of the trained agent; they define the exploration.
      learned: the policy after training.
    """

    agent: LearningAgent
    learned: Policy

    @property
    def num_envs(self) -> int:
        return self.agent.num_envs

    @property
    def unroll_length(self) -> int:
        return self.agent.unroll_length

    def policy(self, robot: Robot, task: Task, learner: Any) -> Policy:
        """The fixed policy."""
        return self.learned

    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        """Functions that repeat the rollout program of `agent`, with the fixed policy."""
        stepping = self.agent.programs(robot, task, mesh).stepping
        statistics = no_statistics(input_size(robot, task))
        statistics = statistics.replace(mean=self.learned.mean, std=self.learned.std)
        actor_params = devices.put((statistics, self.learned.params), mesh, None)

        def start(key: jax.Array) -> EnvState:
            return task.start(robot, jax.random.split(key, self.num_envs))

        def prepare(lanes: EnvState) -> Iterate:
            program = compile_ahead("rollout of the fixed policy", stepping, *actor_params, lanes)

            def iterate(lanes: EnvState) -> tuple[EnvState, Experience, Metrics]:
                lanes, experience, _, seen = program(*actor_params, lanes)
                return lanes, experience, seen

            return iterate

        return Learning(start, lambda lanes: devices.put(lanes, mesh), prepare)
