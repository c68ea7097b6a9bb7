"""The action error of a fit on samples that it has not seen, by bearing and by heading."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from genidm import symmetry
from genidm.controller import Frame, heading, in_frame, relative_bearing
from genidm.errors import BadInput
from genidm.paper.fit import STD_FLOOR
from genidm.paper.pairs import Pairs
from genidm.robots.base import Robot

FILE = "held_out.json"
"""File of a `HeldOut` in the directory of its fit."""

BEARINGS = (-180, -90, -45, -15, 15, 45, 90, 180)
"""Edges of the bins of the bearing of d, degrees; targets of the test lie within ±45°."""

HEADINGS = tuple(range(-180, 181, 45))
"""Edges of the bins of the heading, degrees."""

# A fit takes minutes; with these numbers its error takes a second.
MOST = 20_000
SOUGHT, AMONG = 2_000, 10_000  # samples with a nearest neighbour, and samples to find it among
LEAST = 20  # samples of a bin with a number
# A standard deviation of 0.001: the errors of actions that never vary stay finite.
LEAST_VARIANCE = 1e-6


@dataclasses.dataclass(frozen=True)
class Bins:
    """Errors by an angle.

    Attributes:
      edges: edges of the K bins, degrees.
      share: fraction of the samples in each bin.
      error: as `HeldOut.error`, for the samples of each bin; None for fewer than 20 samples. The
        variance is that of all samples, so that bins can be compared.
      shuffled: the same with d shuffled.
    """

    edges: tuple[int, ...]
    share: tuple[float, ...]
    error: tuple[float | None, ...]
    shuffled: tuple[float | None, ...]


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """The error of a controller's actions: the share of the variance that it does not explain.

    The error is Σ(â − a)² / Σ(a − mean)² over samples and action dimensions: 0 is perfect, and 1
    is the error of the mean action, whatever s and d.

    Attributes:
      samples: number of samples.
      error: the error.
      shuffled: the error with the bearings of d shuffled among the samples. If it is not larger,
        the controller does not use d.
      nearest: the error of the action of the nearest sample of the fit (of 10,000), by normalised
        s and d in the heading frame; None without samples of the fit.
      bearing: by the bearing of d from the heading, positive to the left.
      heading: by the heading in the world.
    """

    samples: int
    error: float
    shuffled: float
    nearest: float | None
    bearing: Bins
    heading: Bins

    @property
    def totals(self) -> dict[str, float | int | None]:
        """The numbers without the bins."""
        return {name: getattr(self, name) for name in ("samples", "error", "shuffled", "nearest")}

    def __str__(self) -> str:
        """Totals and bins as a few lines of text."""
        total = f"held-out action error {self.error:.3f}, with d shuffled {self.shuffled:.3f}"
        if self.nearest is not None:
            total += f", of the nearest neighbour {self.nearest:.3f}"
        total += f" ({self.samples} samples; 1 is the mean action)"
        rows = _rows("bearing of d", self.bearing) + _rows("heading", self.heading)
        return "\n".join([total, *rows])


def held_out_error(
    robot: Robot,
    controller: Callable[[jax.Array, jax.Array], jax.Array],
    samples: Pairs,
    fitted: Pairs | None = None,
) -> HeldOut:
    """Measure the error of a controller's actions on samples that its fit has not seen.

    d is shuffled in the heading frame, so that the shuffled d are as likely as the real ones.

    Args:
      robot: robot of the samples.
      controller: (s `[N, S]`, d `[N, 3]`) → actions `[N, A]`, a `Controller` or any function.
      samples: held-out samples; at most 20,000 of their views are used, drawn at random.
      fitted: samples of the fit, among which nearest neighbours are found.

    Raises:
      BadInput: there are no samples.
    """
    if not len(samples.a):
        raise BadInput("there are no held-out samples to measure an error on")
    rng = np.random.default_rng(0)
    s, d, a = some = _draw(samples, MOST, rng)
    angle = relative_bearing(robot, s, d)
    turn = angle[rng.permutation(len(a))] - angle
    act = jax.jit(lambda s, d: controller(s, d))
    variance = max(float(a.var(axis=0).mean()), LEAST_VARIANCE)
    error, shuffled = (
        np.asarray(jnp.mean((act(s, way) - a) ** 2, axis=-1)) / variance
        for way in (d, symmetry.rotate_vector(d, turn))
    )
    nearest = None
    if fitted is not None:
        nearest = _nearest(robot, some, _draw(fitted, AMONG, rng)) / variance
    return HeldOut(
        samples=len(a),
        error=float(error.mean()),
        shuffled=float(shuffled.mean()),
        nearest=nearest,
        bearing=_bins(angle, BEARINGS, error, shuffled),
        heading=_bins(symmetry.wrap(heading(robot, s)), HEADINGS, error, shuffled),
    )


Drawn = tuple[jax.Array, jax.Array, jax.Array]


def _draw(samples: Pairs, most: int, rng: np.random.Generator) -> Drawn:
    """Draw s `[n, S]`, d `[n, 3]` and a `[n, A]` from all views."""
    views, count = samples.s.shape[:2]
    drawn = rng.choice(views * count, min(most, views * count), replace=False)
    view, sample = np.divmod(drawn, count)
    s, d, a = samples.s[view, sample], samples.d[view, sample], samples.a[sample]
    return jnp.asarray(s), jnp.asarray(d), jnp.asarray(a)


def _nearest(robot: Robot, sought: Drawn, among: Drawn) -> float:
    """Mean squared error of the actions of the nearest neighbours."""
    frame: Frame = "heading" if any(field.yaw for field in robot.observation.fields) else "world"
    x, y = (
        jnp.concatenate(in_frame(robot, frame, s[:most], d[:most]), axis=-1)
        for (s, d, _), most in ((sought, SOUGHT), (among, AMONG))
    )
    mean, std = y.mean(axis=0), jnp.maximum(y.std(axis=0), STD_FLOOR)
    x, y = (x - mean) / std, (y - mean) / std
    nearest = jnp.argmin(jnp.sum(y**2, axis=-1) - 2 * x @ y.T, axis=-1)
    return float(jnp.mean((among[2][nearest] - sought[2][:SOUGHT]) ** 2))


def _bins(angle: jax.Array, edges: Sequence[int], *errors: np.ndarray) -> Bins:
    """Mean errors by an angle in radians."""
    index = np.digitize(np.degrees(angle), edges[1:-1])
    counts = np.bincount(index, minlength=len(edges) - 1)
    means = (np.bincount(index, e, len(counts)) / np.maximum(counts, 1) for e in errors)
    error, shuffled = (
        tuple(float(x) if n >= LEAST else None for x, n in zip(mean, counts, strict=True))
        for mean in means
    )
    return Bins(tuple(edges), tuple((counts / len(angle)).tolist()), error, shuffled)


def _rows(name: str, bins: Bins) -> list[str]:
    """Lines of text: the bins, their share of the samples, and their errors."""
    between = zip(bins.edges[:-1], bins.edges[1:], strict=True)
    cells = {
        f"{name}, °": [f"{low}…{high}".replace("-", "−") for low, high in between],
        "samples": [f"{100 * x:.0f} %" for x in bins.share],
        "error": ["–" if x is None else f"{x:.2f}" for x in bins.error],
        "d shuffled": ["–" if x is None else f"{x:.2f}" for x in bins.shuffled],
    }
    return [f"  {k:<15}" + "".join(f"{cell:>10}" for cell in row) for k, row in cells.items()]
