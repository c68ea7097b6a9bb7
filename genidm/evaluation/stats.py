"""Numbers from episodes: means, intervals, and comparisons on the same scenarios.

An interval of one controller's test is a percentile bootstrap over *test seeds*: a seed's
episodes are averaged first, because they share a random key, and the seeds' means are
resampled. It tells how well the test measured this one trained controller. How much another
training seed would move the number is in `spread` and `paired_spread`, and it is usually more:
there a training seed's episodes are averaged first, and the training seeds are resampled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.stats

from genidm.evaluation.episodes import Episodes

Array = np.ndarray

THRESHOLDS = (0.25, 0.5, 1.0)  # metres; an episode that came this near is a success
RESAMPLES = 10_000  # of each bootstrap
_BATCH = 1_000  # resamples drawn at once, which bounds the memory
_SEED = 0  # of the bootstrap's generator: the same episodes give the same interval
_FEWEST = 3  # training seeds that an interval is made from


def summary(episodes: Episodes) -> dict[str, Any]:
    """One method's row of Table 1, from its episodes `[seeds, episodes]`.

    Diverged episodes are left out of every mean (mean, std, ci95, iqm, steps), as their numbers
    mean nothing. The shares (success, fell, reached, diverged) are of all episodes, and a
    diverged episode is no success, so that breaking the physics never pays.

    Returns:
      mean, std: metres; closest distance over all episodes, the two columns of Table 1.
      ci95: metres; 95 % bootstrap interval of the mean (see `interval`).
      iqm: metres; interquartile mean over episodes.
      success: share of episodes within "0.25", "0.5" and "1.0" metres of the target.
      fell, reached, diverged: shares of episodes.
      steps: mean control steps of an episode.
      seeds, episodes: how many test seeds, and episodes of each.

      A mean is NaN where every episode diverged.

    Raises:
      ValueError: closest is not `[seeds, episodes]`, holds none, or is not finite in an
        episode that did not diverge.
    """
    closest, lost = masked(episodes), np.asarray(episodes.diverged, bool)
    seeds, count = closest.shape
    return {
        **_closest(closest),
        "success": {str(t): _share((closest <= t) & ~lost) for t in THRESHOLDS},
        "fell": _share(episodes.fell),
        "reached": _share(episodes.reached),
        "diverged": _share(lost),
        "steps": _mean(np.where(lost, np.nan, episodes.steps)),
        "seeds": seeds,
        "episodes": count,
    }


def paired(a: Episodes, b: Episodes) -> dict[str, Any]:
    """Method a against method b on identical scenarios, both `[seeds, episodes]`.

    Scenarios in which either diverged are left out.

    Returns:
      difference: metres; mean of a's closest distance minus b's, negative where a is better.
      ci95: metres; 95 % bootstrap interval of the difference (see `interval`).
      improvement: probability that a comes nearer than b in a scenario; equals count half.

    Raises:
      ValueError: the two were not run on the same scenarios.
    """
    _check_same_scenarios(a, b)
    difference = masked(a) - masked(b)
    return {
        "difference": _mean(difference),
        "ci95": list(interval(difference)),
        "improvement": improvement(difference),
    }


def improvement(difference: Array) -> float:
    """Probability that the first of two is nearer, from differences of their distances.

    The share of differences below 0, where 0 itself counts half and NaN is left out.
    """
    kept = difference[np.isfinite(difference)]
    return _mean((kept < 0) + 0.5 * (kept == 0))


def common(a: Episodes, b: Episodes) -> tuple[Episodes, Episodes]:
    """The part of two tests that both made, where one stopped earlier in the same scenarios.

    Scenarios with fewer seeds or episodes are the beginning of one with more.
    """
    seeds, episodes = map(min, zip(a.closest.shape, b.closest.shape, strict=True))

    def cut(whole: Episodes) -> Episodes:
        names = [f.name for f in dataclasses.fields(whole)]
        return Episodes(**{n: getattr(whole, n)[:seeds, :episodes] for n in names})

    return cut(a), cut(b)


def spread(runs: Sequence[Episodes]) -> dict[str, Any]:
    """One method over several training seeds, the episodes of each run `[seeds, episodes]`.

    Returns:
      means: metres; each run's mean closest distance, in the order given.
      mean, std: metres; mean and sample standard deviation (n − 1) of these; NaN std of one.
      ci95: metres; 95 % bootstrap interval of the mean over training seeds; NaN of fewer
        than 3. Of 3 it is the least and the greatest, and covers the truth 3 times in 4.
    """
    return _spread([_mean(masked(run)) for run in runs])


def paired_spread(a: Sequence[Episodes], b: Sequence[Episodes]) -> dict[str, Any]:
    """`spread` of the paired difference a − b, run i of both with one training seed.

    Each pair of runs is compared on the scenarios that both saw.

    Returns:
      what `spread` does, of the differences, and improvement: the share of training seeds
      with which a comes nearer in the mean; equals count half.

    Raises:
      ValueError: not as many runs of both, or two runs were not on the same scenarios.
    """
    pairs = [paired(*common(x, y)) for x, y in zip(a, b, strict=True)]
    differences = [pair["difference"] for pair in pairs]
    return {**_spread(differences), "improvement": improvement(np.asarray(differences))}


def interval(values: Array) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean of `values [seeds, episodes]`.

    Resamples the seeds' means. Where only one seed has values, its episodes are resampled
    instead: such an interval takes them as independent and is too narrow if they are not.
    NaN values are left out; the interval is NaN where nothing is left.
    """
    rows = [row[np.isfinite(row)] for row in np.asarray(values, float)]
    rows = [row for row in rows if row.size]
    units = np.array([row.mean() for row in rows]) if len(rows) != 1 else rows[0]
    if units.size < 2:  # SciPy refuses to resample one number, or none
        return _mean(units), _mean(units)
    low, high = scipy.stats.bootstrap(
        (units,), np.mean, n_resamples=RESAMPLES, batch=_BATCH, confidence_level=0.95,
        method="percentile", rng=np.random.default_rng(_SEED),
    ).confidence_interval  # fmt: skip
    return float(low), float(high)


def interquartile_mean(values: Array) -> float:
    """Mean of the middle half of `values`, NaN left out: the least and greatest quarter go."""
    kept = values[np.isfinite(values)]
    return float(scipy.stats.trim_mean(kept, 0.25)) if kept.size else float("nan")


def masked(episodes: Episodes) -> Array:
    """Closest distance `[seeds, episodes]` in metres, NaN where the episode diverged.

    Raises:
      ValueError: closest is not `[seeds, episodes]`, holds none, or is not finite in an
        episode that did not diverge.
    """
    closest = np.asarray(episodes.closest, float)
    if closest.ndim != 2 or not closest.size:
        raise ValueError(f"episodes must be [seeds, episodes], not of shape {closest.shape}")
    closest = np.where(episodes.diverged, np.nan, closest)
    if not np.all(np.isfinite(closest) | episodes.diverged):
        raise ValueError("an episode that did not diverge has no finite closest distance")
    return closest


def _closest(closest: Array) -> dict[str, Any]:
    kept = closest[np.isfinite(closest)]
    return {
        "mean": _mean(kept),
        "std": float(kept.std()) if kept.size else float("nan"),
        "ci95": list(interval(closest)),
        "iqm": interquartile_mean(kept),
    }


def _check_same_scenarios(a: Episodes, b: Episodes) -> None:
    if a.closest.shape != b.closest.shape:
        raise ValueError(f"not the same scenarios: {a.closest.shape} and {b.closest.shape}")
    both = ~(np.asarray(a.diverged, bool) | np.asarray(b.diverged, bool))
    # A millimetre: far above what another program order does to a float32 start, far below
    # what another scenario does.
    if not np.allclose(a.start[both], b.start[both], rtol=0, atol=1e-3):
        raise ValueError("not the same scenarios: the distances at the start differ")


def _spread(means: Sequence[float]) -> dict[str, Any]:
    units = np.asarray(means, float)
    std = float(np.std(units, ddof=1)) if units.size > 1 else float("nan")
    finite = int(np.isfinite(units).sum())
    bounds = interval(units[:, None]) if finite >= _FEWEST else (float("nan"), float("nan"))
    return {"means": list(means), "mean": _mean(units), "std": std, "ci95": list(bounds)}


def _mean(values: Array) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if kept.size else float("nan")


def _share(flags: Array) -> float:
    return float(np.mean(flags))
