"""The methods of Table 1 at a size that a test can wait for."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

from genidm.agents.ddpg import DDPG
from genidm.agents.her import HER
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.sac import SAC
from genidm.evaluation.evaluate import Test
from genidm.paper.generalize import Generalize
from genidm.paper.methods import Direct, Inverse

M = TypeVar("M", Direct, Inverse)

_SIZE = dict(lanes=16, unroll=8)
_REPLAYING = dict(
    **_SIZE, updates=2, batch=16, capacity=512, warmup=128, hidden=(8,), critic_hidden=(8,)
)
AGENTS = {
    PPO: PPO(**_SIZE, epochs=1, minibatches=2, hidden=(8,), value_hidden=(8,)),
    SAC: SAC(**_REPLAYING, her=HER()),
    DDPG: DDPG(**_REPLAYING, her=HER()),
    RandomActions: RandomActions(**_SIZE),
}

TEST = Test(max_steps=40, lanes=16, chunk=10)


def tiny(method: M, **changes) -> M:
    """The method with small networks, few updates and short episodes."""
    fields = dict(
        agent=AGENTS[type(method.agent)], task=dataclasses.replace(method.task, episode_steps=20)
    )
    if isinstance(method, Inverse):
        fields |= dict(
            fit=dataclasses.replace(method.fit, updates=200, batch=16, idm=(8,), lfm=(8,)),
            generalize=method.generalize and Generalize(segment=6, lanes=32),
            look_ahead=5,
        )
    return dataclasses.replace(method, **(fields | changes))
