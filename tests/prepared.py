"""Programs that tests share."""

from __future__ import annotations

import functools
from typing import Any

from jax.sharding import Mesh

from genidm.agents.base import Agent, Iterate, Learning
from genidm.robots import Robot
from genidm.tasks import Task


class Prepared:
    """An agent whose programs are compiled once for each robot, task and mesh."""

    def __init__(self, agent: Agent):
        self.agent, self.num_envs, self.unroll_length = agent, agent.num_envs, agent.unroll_length

    @functools.cache  # noqa: B019  what it keeps alive, the programs, is what it is for
    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        learning = self.agent.learning(robot, task, mesh)
        ready: list[Iterate] = []

        def prepare(learner: Any) -> Iterate:
            ready.extend([] if ready else [learning.prepare(learner)])
            return ready[0]

        return learning._replace(prepare=prepare)
