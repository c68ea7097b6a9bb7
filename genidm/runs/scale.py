"""Scales: how much of the paper's protocol a run does."""

from __future__ import annotations

import dataclasses

from genidm.agents.ppo import PPO
from genidm.errors import BadInput
from genidm.paper import protocol

# Up to this many interactions, an agent still falls early in most episodes.
SHORT_RUN = 400_000


@dataclasses.dataclass(frozen=True)
class Scale:
    """How much of the paper's protocol a run does.

    Attributes:
      name: name in paths and results.
      interactions: environment steps to collect.
      updates: fraction of a method's updates to make.
      seeds: number of test seeds.
      episodes: test episodes per seed.
      goal_horizon: upper limit of a method's `goal_horizon`, steps. With few interactions
        (`SHORT_RUN`) most episodes end in an early fall, and few are longer.
      fraction: lower limit of a method's `fraction` of the record: in the first half of a
        short record the agent hardly walks.
      min_learning_fraction: lower limit of the fraction of interactions in which an agent learns
        before it is frozen: with few interactions it needs most of them to learn to walk.
      ppo: replaces PPO at default settings (policy layers are kept). The defaults learn
        steadily but slowly; a short run must learn more from each interaction.
    """

    name: str
    interactions: int
    updates: float
    seeds: int
    episodes: int
    goal_horizon: int = 1000
    fraction: float = 0.0
    min_learning_fraction: float = 0.0
    ppo: PPO = dataclasses.field(default_factory=PPO)


def scale_of(text: str, interactions: int) -> Scale:
    """The scale that `--scale` names: "paper", "quick", or a fraction of the paper's numbers.

    Args:
      text: value of the flag.
      interactions: the paper's number of interactions for the robot.

    Raises:
      BadInput: `text` is not one of these.
    """
    if text == "paper":
        return Scale("paper", interactions, 1.0, protocol.TEST_SEEDS, protocol.TEST_EPISODES)
    if text == "quick":
        hurried = PPO(discounting=0.97, learning_rate=1e-3, entropy_cost=0.0)
        return Scale(
            "quick",
            400_000,
            0.2,
            2,
            50,
            goal_horizon=50,
            fraction=1.0,
            min_learning_fraction=2 / 3,
            ppo=hurried,
        )
    try:
        share = float(text)
    except ValueError:
        share = 0.0
    if not 0 < share < float("inf"):
        raise BadInput(f'--scale takes "quick", "paper" or a number above 0, not {text!r}')
    if share == 1:
        return scale_of("paper", interactions)
    interactions = max(1, round(interactions * share))
    return Scale(
        name=f"{share:g}",  # equal values get equal names: 5e-4 and 0.0005
        interactions=interactions,
        updates=min(share, 1.0),
        seeds=protocol.TEST_SEEDS,
        episodes=max(10, round(protocol.TEST_EPISODES * min(share, 1.0))),
        goal_horizon=1000 if interactions > SHORT_RUN else 50,
        min_learning_fraction=2 / 3 if share < 1 else 0.0,
    )
