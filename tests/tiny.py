"""The methods of Table 1 at a size that a test can wait for."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

from genidm.agents.ddpg import DDPG
from genidm.agents.her import HER
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.sac import SAC
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.paper.generalize import Generalize
from genidm.paper.methods import AgentTurned, GoalConditioned, InverseDynamics
from genidm.tasks import WalkForward

M = TypeVar("M", GoalConditioned, InverseDynamics, AgentTurned)

_SIZE = dict(num_envs=16, unroll_length=8)
_REPLAYING = dict(
    **_SIZE,
    grad_updates_per_step=2,
    batch_size=16,
    max_replay_size=512,
    min_replay_size=128,
    policy_hidden_layer_sizes=(8,),
    critic_hidden_layer_sizes=(8,),
)
AGENTS = {
    PPO: PPO(
        **_SIZE,
        num_updates_per_batch=1,
        num_minibatches=2,
        policy_hidden_layer_sizes=(8,),
        value_hidden_layer_sizes=(8,),
    ),
    SAC: SAC(**_REPLAYING, her=HER()),
    DDPG: DDPG(**_REPLAYING, her=HER()),
    RandomActions: RandomActions(**_SIZE),
}

TEST = EvaluationSettings(max_steps=40, num_envs=16, chunk=10)


def tiny(method: M, **changes) -> M:
    """The method with small networks, few updates and short episodes."""
    task = dataclasses.replace(method.task, episode_steps=20)
    if isinstance(task, WalkForward):
        task = dataclasses.replace(task, nearest_side=False)  # a point has no sides
    fields = dict(agent=AGENTS[type(method.agent)], task=task)
    if isinstance(method, InverseDynamics):
        fields |= dict(
            fit=dataclasses.replace(method.fit, updates=200, batch_size=16, idm=(8,), lfm=(8,)),
            generalize=method.generalize and Generalize(segment=6, num_envs=32),
            goal_horizon=5,
            nearest_side=False,
        )
    return dataclasses.replace(method, **(fields | changes))
