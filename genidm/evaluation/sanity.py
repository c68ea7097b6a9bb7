"""Warnings about controllers that hardly move or ignore their goal; no mean distance shows it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from genidm.evaluation.episodes import Episodes

# Mean path length divided by mean distance to the target; below this, a robot hardly moves. In the
# Ant's test the ratio is 1.6 to 5 for fitted controllers, and 0.8 for RS.
STILL = 0.5
# Value of `heeds` below which a controller ignores its goal. On the Ant, HF, GE and LR have 0.14
# to 0.3; RL and RS, which do not walk to their goals, have 0.03 to 0.07.
HEEDLESS = 0.1


def walked(name: str, episodes: Episodes) -> dict[str, float]:
    """Compute mean path length / mean distance to the target; warn if the robot hardly moves.

    Args:
      name: name of the controller in the warning.
      episodes: results of its test; diverged episodes are left out.

    Returns:
      "walked": the ratio; 1 for a robot that walks straight to its target.
    """
    finite = ~np.asarray(episodes.diverged)
    if not finite.any():
        return {"walked": 0.0}
    path, start = (float(x[finite].mean()) for x in (episodes.path_length, episodes.start))
    if path < STILL * start:
        print(
            f"warning: {name} hardly moves: it walks {path:.2g} m, but its targets are "
            f"{start:.2g} m away",
            file=sys.stderr,
        )
    return {"walked": path / start}


def heeds(name: str, ways: Sequence[np.ndarray], target: np.ndarray) -> dict[str, float]:
    """Measure how much the direction of a trajectory (Fig. 8) depends on the target.

    The episodes of a row have the same start and different targets, so a controller that
    ignores its goal walks in the same direction in all of them. Warn if the value is low.

    The increase of a fit's loss with shuffled d is not a good measure: d is nearly constant in a
    record of walking. On the Ant, it is 0 to 3 % for HF, and 49 % for RS, which overfits its few
    samples.

    Args:
      name: name of the controller in the warning.
      ways: positions `[steps + 1, 3]` of every episode, row by row, metres.
      target: `[rows, episodes, 3]`, metres.

    Returns:
      "heeds": mean cosine between the direction walked and the direction to the episode's own
      target, minus that to the other targets; 0 for a controller that ignores its goal.
    """
    rows, episodes = target.shape[:2]
    start, end = (np.stack([way[i] for way in ways]).reshape(target.shape) for i in (0, -1))
    actual, wanted = (_horizontal(x - start) for x in (end, target))
    cosine = np.einsum("rix,rjx->rij", actual, wanted)
    own = np.trace(cosine, axis1=1, axis2=2)
    others = (cosine.sum((1, 2)) - own) / (episodes - 1)
    difference = float((own - others).sum() / (rows * episodes))
    if difference < HEEDLESS:
        print(
            f"warning: {name} hardly reacts to its goal: it walks in nearly the same direction "
            "to all targets",
            file=sys.stderr,
        )
    return {"heeds": difference}


def _horizontal(x: np.ndarray) -> np.ndarray:
    """Horizontal unit vectors `[..., 2]`; zero where the length is zero."""
    return x[..., :2] / np.maximum(np.linalg.norm(x[..., :2], axis=-1, keepdims=True), 1e-6)
