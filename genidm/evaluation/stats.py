"""Statistics of episodes: means, intervals, and comparisons on the same scenarios (Table 1).

The interval of a single controller is a percentile bootstrap over *test seeds*: it averages
the episodes of each seed, because they share a random key, and resamples these means. It
shows how precisely the test measures this controller. `spread` and `paired_spread` show how
much the training seed changes the result, usually more: they average the episodes of each
training seed, and resample the training seeds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.stats

from genidm.evaluation.episodes import Episodes

Array = np.ndarray

THRESHOLDS = (0.25, 0.5, 1.0)  # metres; an episode that comes this near is a success
RESAMPLES = 10_000  # of each bootstrap
_BATCH = 1_000  # resamples drawn at once, to limit the memory
_SEED = 0  # fixed, so that the same episodes give the same interval
_FEWEST = 3  # training seeds that an interval needs


def summary(episodes: Episodes) -> dict[str, Any]:
    """Compute a method's row of Table 1 from its episodes `[seeds, episodes]`.

    Means (mean, std, ci95, iqm, steps) leave out diverged episodes, whose numbers have no
    meaning. Fractions (success, fell, reached, diverged) count all episodes; a diverged
    episode is not a success, so a controller gains nothing by breaking the physics.

    Returns:
      mean, std: metres; closest distance over all episodes, the two columns of Table 1.
      ci95: metres; 95 % bootstrap interval of the mean (see `interval`).
      iqm: metres; interquartile mean over episodes.
      success: fraction of episodes within "0.25", "0.5" and "1.0" metres of the target.
      fell, reached, diverged: fractions of episodes.
      steps: mean number of environment steps per episode.
      seeds, episodes: number of test seeds, and of episodes per seed.

      A mean is NaN if every episode diverged.

    Raises:
      ValueError: closest is not `[seeds, episodes]`, is empty, or is not finite in an
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
    """Compare method a with method b on the same scenarios, both `[seeds, episodes]`.

    Scenarios in which a or b diverged are left out.

    Returns:
      difference: metres; mean closest distance of a minus that of b, negative if a is better.
      ci95: metres; 95 % bootstrap interval of the difference (see `interval`).
      improvement: probability that a comes nearer than b in a scenario; ties count half.

    Raises:
      ValueError: a and b are not on the same scenarios.
    """
    _check_same_scenarios(a, b)
    difference = masked(a) - masked(b)
    return {
        "difference": _mean(difference),
        "ci95": list(interval(difference)),
        "improvement": improvement(difference),
    }


def improvement(difference: Array) -> float:
    """Probability that a is nearer than b, from differences of distances a − b.

    The fraction of differences below 0; 0 counts half, and NaN is left out.
    """
    kept = difference[np.isfinite(difference)]
    return _mean((kept < 0) + 0.5 * (kept == 0))


def common(a: Episodes, b: Episodes) -> tuple[Episodes, Episodes]:
    """Cut two tests of different size to the scenarios that both have.

    Scenarios with fewer seeds or episodes are the start of those with more.
    """
    seeds, episodes = map(min, zip(a.closest.shape, b.closest.shape, strict=True))

    def cut(whole: Episodes) -> Episodes:
        names = [f.name for f in dataclasses.fields(whole)]
        return Episodes(**{n: getattr(whole, n)[:seeds, :episodes] for n in names})

    return cut(a), cut(b)


def spread(runs: Sequence[Episodes]) -> dict[str, Any]:
    """Statistics of a method over training seeds; each run has episodes `[seeds, episodes]`.

    Returns:
      means: metres; mean closest distance of each run, in the given order.
      mean, std: metres; mean and sample standard deviation (n − 1) of these; std of one is NaN.
      ci95: metres; 95 % bootstrap interval of the mean over training seeds; NaN for fewer than
        3. For 3 it is the smallest and the largest, which contain the true mean in 3 of 4 cases.
    """
    return _spread([_mean(masked(run)) for run in runs])


def paired_spread(a: Sequence[Episodes], b: Sequence[Episodes]) -> dict[str, Any]:
    """`spread` of the paired difference a − b; run i of a and of b have the same training seed.

    Each pair of runs is compared on the scenarios that both have.

    Returns:
      `spread` of the differences, and improvement: the fraction of training seeds for which
      a has the smaller mean; ties count half.

    Raises:
      ValueError: a and b have different numbers of runs, or a pair is not on the same
        scenarios.
    """
    pairs = [paired(*common(x, y)) for x, y in zip(a, b, strict=True)]
    differences = [pair["difference"] for pair in pairs]
    return {**_spread(differences), "improvement": improvement(np.asarray(differences))}


def interval(values: Array) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean of `values [seeds, episodes]`.

    Resamples the means of the seeds. If only one seed has values, it resamples its episodes:
    this interval assumes that they are independent, and is too narrow if they are not.
    NaN values are left out; without other values the interval is NaN.
    """
    rows = [row[np.isfinite(row)] for row in np.asarray(values, float)]
    rows = [row for row in rows if row.size]
    units = np.array([row.mean() for row in rows]) if len(rows) != 1 else rows[0]
    if units.size < 2:  # SciPy cannot resample fewer than two numbers
        return _mean(units), _mean(units)
    low, high = scipy.stats.bootstrap(
        (units,), np.mean, n_resamples=RESAMPLES, batch=_BATCH, confidence_level=0.95,
        method="percentile", rng=np.random.default_rng(_SEED),
    ).confidence_interval  # fmt: skip
    return float(low), float(high)


def interquartile_mean(values: Array) -> float:
    """Mean of the middle half of `values`, without NaN and the lowest and highest quarter."""
    kept = values[np.isfinite(values)]
    return float(scipy.stats.trim_mean(kept, 0.25)) if kept.size else float("nan")


def masked(episodes: Episodes) -> Array:
    """Closest distance `[seeds, episodes]` in metres, NaN where the episode diverged.

    Raises:
      ValueError: closest is not `[seeds, episodes]`, is empty, or is not finite in an
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
    # 1 mm is far more than float32 rounding in another program, and far less than the difference
    # between two scenarios.
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
