"""Whether a controller moves at all, and whether it heeds its goal: said, as no mean tells it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from genidm.evaluation.episodes import Episodes

# Way walked over distance to the target, means: below it a robot hardly moves. In the Ant's test
# it is 1.6 to 5 for fitted controllers, 0.8 where actions at random were learned from.
STILL = 0.5
# `heeds` below which a controller hardly does. On the Ant HF, GE and LR have 0.14 to 0.3, and RL
# and RS, which do not go where they are told, 0.03 to 0.07.
HEEDLESS = 0.1


def walked(name: str, episodes: Episodes) -> dict[str, float]:
    """Way walked over distance to the target, means of all episodes; a warning where it is short.

    Args:
      name: what a warning calls the controller.
      episodes: its test.

    Returns:
      "walked": 1 for a robot that goes straight to its target.
    """
    finite = ~np.asarray(episodes.diverged)
    if not finite.any():
        return {"walked": 0.0}
    way, start = (float(x[finite].mean()) for x in (episodes.path_length, episodes.start))
    if way < STILL * start:
        print(
            f"warning: {name} hardly moves: it walks {way:.2g} m, where targets are {start:.2g} m "
            "away",
            file=sys.stderr,
        )
    return {"walked": way / start}


def heeds(name: str, ways: Sequence[np.ndarray], target: np.ndarray) -> dict[str, float]:
    """How much better the ways of the tours (Fig. 8) fit their own targets than those of others.

    The tours of a row start alike, and their targets alone differ: who does not heed the goal goes
    the same way in all of them. A warning where the ways hardly tell the targets apart.

    Not taken: the loss of a fit with d shuffled. A record of walking has d nearly alike throughout,
    so that it hardly rises: on the Ant by 0 to 3 % for HF, and by 49 % for RS, which knows its few
    samples by heart.

    Args:
      name: what a warning calls the controller.
      ways: positions `[steps + 1, 3]` of every tour, row by row, metres.
      target: `[rows, tours, 3]`, metres.

    Returns:
      "heeds": the mean cosine between the way gone and the way to its own target, less that to the
      targets of the others; 0 for a controller that ignores where it is to go.
    """
    rows, tours = target.shape[:2]
    start, end = (np.stack([way[i] for way in ways]).reshape(target.shape) for i in (0, -1))
    gone, there = (_level(x - start) for x in (end, target))
    cosine = np.einsum("rix,rjx->rij", gone, there)
    own = np.trace(cosine, axis1=1, axis2=2)
    others = (cosine.sum((1, 2)) - own) / (tours - 1)
    more = float((own - others).sum() / (rows * tours))
    if more < HEEDLESS:
        print(
            f"warning: {name} hardly heeds where it is to go: on its way to other targets it goes "
            "much the same way",
            file=sys.stderr,
        )
    return {"heeds": more}


def _level(x: np.ndarray) -> np.ndarray:
    """Horizontal unit vectors `[..., 2]`; zero where there is no length."""
    return x[..., :2] / np.maximum(np.linalg.norm(x[..., :2], axis=-1, keepdims=True), 1e-6)
