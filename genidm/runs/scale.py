"""How much of the paper's protocol is run."""

from __future__ import annotations

import dataclasses

from genidm.agents.ppo import PPO
from genidm.errors import BadInput
from genidm.paper import protocol

# Interactions up to which an agent has just begun to learn.
YOUNG = 400_000


@dataclasses.dataclass(frozen=True)
class Scale:
    """How much of the paper's protocol is run.

    Attributes:
      name: as it stands in paths and results.
      interactions: steps that are collected.
      updates: share of a method's updates that are made.
      seeds: test seeds.
      episodes: test episodes a seed.
      goal_horizon: most steps to the intermediate goal. Agents that have just begun to learn
        (`YOUNG`) fall so soon that few of their episodes reach further.
      fraction: least part of the record that is learned from: in the first half of a short one
        the agent hardly walks.
      learning: least part of the interactions in which an agent that is frozen afterwards
        learns: with few of them it needs most to learn to walk at all.
      ppo: stands for PPO at its defaults, whatever its policy's layers, which take their time
        and fall seldom. With few interactions more has to be made of each.
    """

    name: str
    interactions: int
    updates: float
    seeds: int
    episodes: int
    goal_horizon: int = 1000
    fraction: float = 0.0
    learning: float = 0.0
    ppo: PPO = dataclasses.field(default_factory=PPO)


def scale_of(text: str, interactions: int) -> Scale:
    """What `--scale` names: "paper", "quick", or a share of the paper's numbers.

    Args:
      text: what the user gave.
      interactions: the paper's number for the robot.

    Raises:
      BadInput: it is none of these.
    """
    if text == "paper":
        return Scale("paper", interactions, 1.0, protocol.TEST_SEEDS, protocol.TEST_EPISODES)
    if text == "quick":
        hurried = PPO(discounting=0.97, learning_rate=1e-3, entropy_cost=0.0)
        return Scale(
            "quick", 400_000, 0.1, 2, 50, goal_horizon=50, fraction=1.0, learning=2 / 3, ppo=hurried
        )
    try:
        share = float(text)
    except ValueError:
        share = 0.0
    if not 0 < share < float("inf"):
        raise BadInput(f'--scale takes "quick", "paper" or a number above 0, not {text!r}')
    interactions = max(1, round(interactions * share))
    return Scale(
        name=f"{share:g}",  # by its value: 5e-4 is 0.0005
        interactions=interactions,
        updates=min(share, 1.0),
        seeds=protocol.TEST_SEEDS,
        episodes=max(10, round(protocol.TEST_EPISODES * min(share, 1.0))),
        goal_horizon=1000 if interactions > YOUNG else 50,
        learning=2 / 3 if share < 1 else 0.0,
    )
