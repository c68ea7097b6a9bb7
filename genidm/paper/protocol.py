"""The paper's numbers: Table 1, Table 2, A.1.2 and A.1.3, for its three robots.

Nothing here is ours. Our choices, where the paper is silent, are in `methods`. A run prints
and stores the settings that `--paper-settings` would change.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Literal

Layers = tuple[int, ...]
Algorithm = Literal["PPO", "SAC", "DDPG"]


@dataclasses.dataclass(frozen=True)
class Training:
    """A row of Table 2.

    Attributes:
      policy: hidden layers of the policy that collects experience, or walks to goals.
      lfm: hidden layers of ψ.
      idm: hidden layers of φ.
      algorithm: RL algorithm that trains the policy; None for random actions.
    """

    policy: Layers | None = None
    lfm: Layers | None = None
    idm: Layers | None = None
    algorithm: Algorithm | None = None


_50, _64, _256 = (50, 50), (64, 64), (256, 256)

TABLE2: Mapping[str, Mapping[str, Training]] = {
    "humanoid": {
        "RS": Training(idm=_256),
        "RL": Training(policy=_256, idm=_256, algorithm="SAC"),
        "VGCP": Training(policy=_256, algorithm="SAC"),
        "HER_SP": Training(policy=_64, algorithm="SAC"),
        "HER_DE": Training(policy=_64, algorithm="SAC"),
        "GE": Training(policy=_256, idm=_256, algorithm="SAC"),
        "LR": Training(policy=_256, lfm=_256, idm=_256, algorithm="SAC"),
    },
    "minitaur": {
        "RS": Training(idm=_256),
        "RL": Training(policy=_256, idm=_256, algorithm="PPO"),
        "VGCP": Training(policy=_256, algorithm="PPO"),
        "HER_SP": Training(policy=_64, algorithm="SAC"),
        "HER_DE": Training(policy=_64, algorithm="SAC"),
        "GE": Training(policy=_256, idm=_256, algorithm="PPO"),
        "LR": Training(policy=_256, lfm=_256, idm=_50, algorithm="PPO"),
    },
    "ant": {
        "RS": Training(idm=_256),
        "RL": Training(policy=_64, idm=_256, algorithm="PPO"),
        "VGCP": Training(policy=_64, algorithm="PPO"),
        "HER_SP": Training(policy=_64, algorithm="SAC"),
        "HER_DE": Training(policy=_64, algorithm="DDPG"),
        "GE": Training(policy=_64, idm=_256, algorithm="PPO"),
        "LR": Training(policy=_64, lfm=_256, idm=_50, algorithm="PPO"),
    },
}
"""Table 2: robot → method → networks and training algorithm.

HER_SP is the paper's HER-Sparse (HER-Sp), HER_DE its HER-Dense (HER-De).
"""

INTERACTIONS = {"humanoid": 15_000_000, "minitaur": 4_000_000, "ant": 2_000_000}
"""Table 2: robot → environment interactions of each method."""

LEARNED_BEFORE = {"humanoid": 5_000_000}
"""A.1.2: robot → interactions after which its policy is frozen. The record starts there."""

FRACTION = {"RS": 1.0, "RL": 1.0, "GE": 0.5, "LR": 0.5}
"""A.1.2: method → fraction of the record, from its start, that the method learns from."""

LATENT_SIZE = {"humanoid": 50, "minitaur": 10, "ant": 10}
"""A.1.2: robot → k (Eq. 3)."""

LATENT_WEIGHT = 0.25
"""A.1.2: λ (Eq. 7)."""

LEARNING_RATE = 1e-3
"""A.1.2: learning rate of Adam."""

BATCH_SIZE = 512
"""A.1.2: samples per minibatch."""

TARGET_DISTANCE = {"humanoid": (2.0, 5.0), "minitaur": (1.5, 2.5), "ant": (2.0, 5.0)}
"""A.1.3: robot → smallest and largest distance from the start to a target, metres."""

TARGET_BEARING = math.pi / 4
"""A.1.3: targets lie within ± this of the heading, radians."""

MAX_STEPS = 1000
"""A.1.3: maximum number of environment steps of an episode."""

TEST_SEEDS = 10
"""A.1.3: number of test seeds."""

TEST_EPISODES = 1000
"""A.1.3: episodes per test seed."""

TABLE1: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "humanoid": {
        "RS": (3.159, 0.579),
        "RL": (2.777, 0.841),
        "VGCP": (2.160, 0.955),
        "HER_SP": (2.902, 1.138),
        "HER_DE": (2.891, 1.135),
        "GE": (1.936, 0.977),
        "LR": (1.779, 0.986),
    },
    "minitaur": {
        "RS": (1.598, 0.282),
        "RL": (1.403, 0.438),
        "VGCP": (1.358, 0.326),
        "HER_SP": (1.440, 0.237),
        "HER_DE": (1.380, 0.251),
        "GE": (1.212, 0.485),
        "LR": (0.904, 0.482),
    },
    "ant": {
        "RS": (3.166, 0.569),
        "RL": (2.155, 1.054),
        "VGCP": (2.608, 0.607),
        "HER_SP": (2.602, 0.953),
        "HER_DE": (2.475, 0.693),
        "GE": (1.721, 0.978),
        "LR": (1.105, 0.866),
    },
}
"""Table 1: robot → method → (mean, standard deviation) of the closest distance, metres."""

METHOD = "LR"
"""The paper's own method; the report compares it with every other."""
