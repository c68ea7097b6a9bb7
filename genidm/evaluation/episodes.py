"""Results of an evaluation; every table and figure is made from them."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Episodes:
    """The results of test episodes, arrays `[seeds, episodes]` (A.1.3).

    Attributes:
      closest: metres; smallest horizontal distance to the target, the paper's measure.
      start: metres; horizontal distance to the target at the start.
      reached: bool; the robot came within the goal radius.
      fell: bool; a fall ended the episode.
      diverged: bool; non-finite physics ended the episode.
      steps: int; environment steps.
      path_length: metres; horizontal length of the path.
    """

    closest: np.ndarray
    start: np.ndarray
    reached: np.ndarray
    fell: np.ndarray
    diverged: np.ndarray
    steps: np.ndarray
    path_length: np.ndarray
