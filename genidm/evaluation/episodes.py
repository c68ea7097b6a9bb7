"""What an evaluation leaves behind; every table and figure derives from it."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Episodes:
    """The outcome of each test episode, arrays `[seeds, episodes]` (A.1.3).

    Attributes:
      closest: metres; least horizontal distance to the target, the paper's measure.
      start: metres; horizontal distance at the start.
      reached: bool; came within the goal radius.
      fell: bool; ended by a fall.
      diverged: bool; ended because the physics left the finite numbers.
      steps: int; control steps made.
      path_length: metres; horizontal length of the way.
    """

    closest: np.ndarray
    start: np.ndarray
    reached: np.ndarray
    fell: np.ndarray
    diverged: np.ndarray
    steps: np.ndarray
    path_length: np.ndarray
