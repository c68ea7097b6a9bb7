"""Figures. Each function takes data and a path, writes a PNG and returns the Figure."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import EngFormatter, FuncFormatter, NullLocator

from genidm.evaluation import stats
from genidm.paper.protocol import METHOD
from genidm.report import drawing
from genidm.report.drawing import Array, Style, Target, styles
from genidm.report.rows import Row

Panel = tuple[str, Mapping[str, Sequence[Array]], Array, float]

TARGET_RADIUS = 0.1  # metres; a target counts as reached within it; drawn to scale
ABREAST = 5  # most methods side by side in a figure of trajectories
BESIDE = 0.2  # offset of the means from a violin's middle; violins are 1 apart
TARGET_RED = "#D00000"
CURVE_POINTS = 100  # points of a learning curve; averaging removes the noise of iterations
FLOOR = 1e-8  # metres; a log axis shows a residual of exactly 0 here
LINEAR = 1e-2  # the axis of action changes is linear below this
NOISE = 1e-3  # action changes below this are float noise
CHOSEN: dict[str, Any] = {"color": "0.45", "linestyle": (0, (6, 3)), "linewidth": 1}
SINGLE: dict[str, Any] = {"linestyle": "none", "marker": "o", "mfc": "white", "ms": 5}

METRICS = {
    "episode_reward": "episode reward",
    "reward": "reward",
    "forward_speed": "forward speed, m/s",
    "speed": "speed ahead / to goal, m/s",
    "reached": "arrivals a step",
    "fell": "share of falls",
    "episode_length": "episode length, steps",
    "loss": "loss L (Eq. 7)",
    "loss_latent": "latent loss L1 (Eq. 5)",
    "loss_action": "action loss L2 (Eq. 6)",
}
"""Metric → axis label; the label of any other metric is its name."""


def violins(
    rows: Sequence[Row], path: Target, paper: Mapping[str, tuple[float, float]] | None = None
) -> Figure:
    """Violins of the closest distance over all test episodes, by method (Fig. 5).

    Args:
      rows: one per method, drawn in this order; diverged episodes are left out.
      path: PNG to write.
      paper: method → (mean, std) in metres, as in `protocol.TABLE1[robot]`; marks the mean.
    """
    fig = Figure(figsize=(max(5.0, 1.1 * len(rows) + 1.6), 4.4), layout="constrained")
    ax = fig.add_subplot()
    looks = styles(row.method for row in rows)
    for x, row in enumerate(rows):
        values = stats.masked(row.episodes)
        _violin(ax, x, values[np.isfinite(values)], looks[row.method])
        _mark_paper(ax, x, (paper or {}).get(row.method))
    _start_line(ax, rows)
    ax.set_xticks(range(len(rows)), [row.method for row in rows])
    ax.set_ylim(bottom=0)
    drawing.style_axes(ax, "", "closest distance to the target, m")
    drawing.key(fig, _violin_key(bool(paper)))
    return drawing.write(fig, path)


def paths(panels: Sequence[Panel], path: Target) -> Figure:
    """Trajectories towards targets (Fig. 8), one row of axes per panel.

    If there are more methods than fit side by side, the rows repeat for the next methods.

    Args:
      panels: (title, method → trajectories `[T, 2]` in metres, targets `[E, 2]` in metres,
        initial heading in radians). Each method has its own axes, all with the same limits.
      path: PNG to write.
    """
    methods = list(dict.fromkeys(name for panel in panels for name in panel[1]))
    bands = _bands(methods)
    rows, columns = len(bands) * len(panels), len(bands[0])
    fig = Figure(figsize=(max(4.0, 2.3 * columns + 0.7), 2.45 * rows + 0.8), layout="constrained")
    grid = fig.subplots(rows, columns, squeeze=False, sharex="row", sharey="row")
    looks = styles(methods)
    for axes, (names, panel) in zip(grid, itertools.product(bands, panels), strict=True):
        _panel(axes, names, panel, looks)
    for axes, names in zip(grid[:: len(panels)], bands, strict=True):
        for ax, name in zip(axes, names, strict=False):
            ax.set_title(name, fontsize=12)
    for ax in grid[-1]:
        ax.set_xlabel("x, m", fontsize=11)
    drawing.key(fig, _path_key(), "lower")
    return drawing.write(fig, path)


def learning_curves(
    curves: Mapping[str, Sequence[Mapping[str, Any]]],
    path: Target,
    keys: Sequence[str] | None = None,
    steps: str = "steps",
) -> Figure:
    """Learning curves, one panel per metric and one line per label; long curves are averaged.

    Args:
      curves: label → records with "step" and metrics, as in `metrics.jsonl`; a record need not
        have every metric. Labels that agree up to a comma ("PPO, seed 1") have the same style.
      path: PNG to write.
      keys: metrics to draw, in order; default: every number in the records.
      steps: label of the horizontal axis: the unit of "step" ("interactions", "updates").
    """
    keys = list(keys) if keys is not None else _metrics(curves)
    columns = max(1, min(3, len(keys)))
    rows = max(1, -(-len(keys) // columns))
    fig = Figure(figsize=(3.7 * columns + 0.4, 2.9 * rows + 0.5), layout="constrained")
    axes = fig.subplots(rows, columns, squeeze=False, gridspec_kw={"wspace": 0.08}).ravel()
    looks = styles(dict.fromkeys(map(_family, curves)))
    for ax, key in zip(axes, keys, strict=False):
        _curve_panel(ax, curves, key, looks)
        drawing.style_axes(ax, steps, METRICS.get(key, key.replace("_", " ")))
    for ax in axes[len(keys) :]:
        ax.set_visible(False)
    drawing.line_key(fig, looks)
    return drawing.write(fig, path)


def residuals(curves: Mapping[str, Mapping[str, Array]], path: Target) -> Figure:
    """Distance of 𝒢's replay from the exactly rotated record, by step (Def. 1, 4).

    Args:
      curves: mode of 𝒢 → "median" and "p90", each `[H]` metres, for steps 1 to H after the
        replay starts from the record. Values of 0 are drawn at the bottom of the axis.
      path: PNG to write.
    """
    fig = Figure(figsize=(6.4, 4.2), layout="constrained")
    ax = fig.add_subplot()
    looks = styles(curves)
    for name, curve in curves.items():
        _residual(ax, curve, looks[name])
    ax.set(xscale="log", yscale="log")
    if any(np.min(curve["median"]) < FLOOR for curve in curves.values()):
        ax.text(1, 1.4 * FLOOR, "exactly 0, or less than the axis shows", fontsize=9)
    ax.set_ylim(bottom=FLOOR / 2)
    drawing.style_axes(ax, "steps since placing", "distance to the exact rotation, m")
    kinds = [
        Line2D([], [], color="0.25", lw=2.2, label="median"),
        Line2D([], [], color="0.25", lw=0.9, label="90th percentile"),
    ]
    drawing.line_key(fig, looks, kinds)
    return drawing.write(fig, path)


def bearings(closest: Mapping[str, Array], bearing: Array, heading: Array, path: Target) -> Figure:
    """Closest distance against the target's bearing and against the initial heading.

    The left panel shows whether a method turns to targets at its sides, the right panel whether
    it is invariant to yaw. Marks are means of bins, bars are standard errors over episodes.

    Args:
      closest: method → closest distance in metres, `[seeds, episodes]`; NaN is left out.
      bearing: bearing of the target from the heading, `[seeds, episodes]` radians, positive to
        the left.
      heading: initial yaw in the world frame, `[seeds, episodes]` radians.
      path: PNG to write.
    """
    fig = Figure(figsize=(9.0, 3.9), layout="constrained")
    left, right = fig.subplots(1, 2, sharey=True)
    looks = styles(closest)
    turned = (np.degrees(heading) + 180) % 360 - 180
    for shift, (name, values) in zip(_shifts(len(closest)), closest.items(), strict=True):
        _bins(left, np.degrees(bearing), values, np.linspace(-45, 45, 7), looks[name], shift)
        _bins(right, turned, values, np.linspace(-180, 180, 13), looks[name], shift)
    left.set(xticks=np.arange(-45, 46, 15), ylim=(0, None))
    right.set_xticks(np.arange(-180, 181, 60))
    drawing.style_axes(
        left,
        "bearing of the target, degrees (left is positive)",
        "closest distance to the target, m",
    )
    drawing.style_axes(right, "heading at the start in the world, degrees", "")
    drawing.line_key(fig, looks)
    return drawing.write(fig, path)


def invariance(changes: Mapping[str, Array], angle: Array, path: Target) -> Figure:
    """Change of actions when robot and goal are rotated together, by angle (Def. 3).

    Marks are medians over states, bars are quartiles. The axis is linear below `LINEAR`, so that
    it can show 0. A method with only float noise is labelled with its maximum.

    Args:
      changes: method → Euclidean distances of the actions `[K, N]` in N states.
      angle: rotation angles `[K]`, radians.
      path: PNG to write.
    """
    fig = Figure(figsize=(7.4, 4.6), layout="constrained")
    ax = fig.add_subplot()
    ax.set_yscale("symlog", linthresh=LINEAR, linscale=0.6)
    looks, degrees = styles(changes), np.degrees(angle)
    step = float(np.diff(degrees).min()) if len(degrees) > 1 else 1.0
    for shift, (name, values) in zip(_shifts(len(changes), 0.3), changes.items(), strict=True):
        low, median, high = np.percentile(np.asarray(values, float), [25, 50, 75], axis=1)
        bars = np.stack([median - low, high - median])
        _bars(ax, degrees + shift * step, median, bars, looks[name])
    ax.set(ylim=(-0.1 * LINEAR, None), xticks=np.arange(0, 181, 30))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    _name_noise(ax, changes)
    drawing.style_axes(ax, "turned by, degrees", "change of the action (Def. 3)")
    drawing.line_key(fig, looks)
    return drawing.write(fig, path)


def latent_sizes(
    closest: Mapping[int, Sequence[Array]], path: Target, chosen: int | None = None
) -> Figure:
    """Closest distance against the latent size k (Fig. 9).

    The line is the mean over fits. Bars are the 95 % interval over test seeds (one fit per k) or
    the standard deviation over fits (several per k, also drawn one by one).

    Args:
      closest: k → closest distances of each fit in metres, `[seeds, episodes]`; NaN is left
        out.
      path: PNG to write.
      chosen: the k of Table 1, marked by a line.
    """
    fig = Figure(figsize=(6.4, 4.2), layout="constrained")
    ax = fig.add_subplot()
    sizes, style = sorted(closest), drawing.STYLES[METHOD]
    means = [[float(np.nanmean(fit)) for fit in closest[k]] for k in sizes]
    several = all(len(fits) > 1 for fits in means)
    middle = np.array([np.mean(fits) for fits in means])
    bars = _deviations(means) if several else _intervals([closest[k][0] for k in sizes], middle)
    if chosen is not None:
        ax.axvline(chosen, **CHOSEN)
    if several:
        x = np.repeat(np.multiply(sizes, 1.07), [len(fits) for fits in means])  # right of the bars
        ax.plot(x, np.concatenate(means), **SINGLE, color=style.colour)
    _bars(ax, np.asarray(sizes, float), middle, bars, style)
    ax.set_xscale("log")
    ax.set(xticks=sizes, xticklabels=[str(k) for k in sizes], ylim=(0, None))
    ax.xaxis.set_minor_locator(NullLocator())
    drawing.style_axes(ax, "size k of the latent", "closest distance to the target, m")
    drawing.key(fig, _size_key(style, several, chosen))
    return drawing.write(fig, path)


def _violin(ax: Axes, x: float, values: Array, style: Style) -> None:
    if not values.size:
        return
    drawn: Any = ax.violinplot([values], [x], widths=0.85, points=200, showextrema=False)
    for body in drawn["bodies"]:
        body.set(facecolor=style.colour, edgecolor="0.2", hatch=style.hatch, alpha=0.75)
    low, median, high = np.percentile(values, [25, 50, 75])
    ax.vlines(x, low, high, color="black", linewidth=4)
    ax.plot(x, median, "o", color="white", markeredgecolor="black", markersize=7)
    ax.plot(x - BESIDE, values.mean(), "D", color="black", markeredgecolor="white", markersize=7)


def _mark_paper(ax: Axes, x: float, number: tuple[float, float] | None) -> None:
    if number is not None:
        ax.plot(x + BESIDE, number[0], "D", mfc="white", color="black", mew=1.6, ms=8)


def _start_line(ax: Axes, rows: Sequence[Row]) -> None:
    if rows:
        start = float(np.nanmean(rows[0].episodes.start))
        ax.axhline(start, color="0.45", linestyle=(0, (6, 3)), linewidth=1, zorder=0)


def _violin_key(paper: bool) -> list[Line2D]:
    dot: dict[str, Any] = {"linestyle": "none", "color": "black"}
    key = [
        Line2D([], [], color="black", lw=4, label="quartiles"),
        Line2D([], [], marker="o", mfc="white", ms=7, label="median", **dot),
        Line2D([], [], marker="D", mec="white", ms=7, label="mean", **dot),
        Line2D([], [], marker="D", mfc="white", mew=1.6, ms=8, label="paper's mean", **dot),
        Line2D([], [], color="0.45", linestyle=(0, (6, 3)), label="mean at the start"),
    ]
    return key if paper else [*key[:3], key[4]]


def _bands(names: Sequence[str]) -> list[list[str]]:
    """Splits names into rows of at most `ABREAST`, of nearly equal length."""
    count = max(1, -(-len(names) // ABREAST))
    width = -(-len(names) // count)
    return [list(names[i * width : (i + 1) * width]) for i in range(count)]


def _panel(axes: Array, names: Sequence[str], panel: Panel, looks: Mapping[str, Style]) -> None:
    """Draws a row of axes `[columns]`, one per method; removes the unused axes."""
    title, trajectories, targets, heading = panel
    walked = itertools.chain(*trajectories.values())
    limits = _square([np.asarray(targets), *(_near(path, targets) for path in walked)])
    for ax, name in zip(axes, names, strict=False):
        _targets(ax, targets)
        _trajectories(ax, trajectories.get(name, ()), looks[name], heading, limits)
        ax.set(xlim=limits[0], ylim=limits[1], aspect="equal")
        drawing.style_axes(ax, "", "")
        ax.grid(False)
    axes[0].set_ylabel(f"{title}\ny, m", fontsize=11)
    for ax in axes[len(names) :]:
        ax.remove()


def _targets(ax: Axes, targets: Array) -> None:
    for x, y in np.asarray(targets):
        disc = Circle((x, y), TARGET_RADIUS, facecolor=TARGET_RED, edgecolor="black", zorder=5)
        ax.add_patch(disc)


def _trajectories(
    ax: Axes,
    trajectories: Sequence[Array],
    style: Style,
    heading: float,
    limits: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    line = drawing.strokes(style) | {"marker": "", "linestyle": "-", "linewidth": 1.2}
    for path in map(np.asarray, trajectories):
        ax.plot(path[:, 0], path[:, 1], **line)
        ax.plot(*path[-1], marker=style.marker, color=style.colour, mec="black", mew=0.6, ms=5)
    if len(trajectories):
        length = 0.12 * (limits[0][1] - limits[0][0])
        tip = trajectories[0][0] + length * np.array([np.cos(heading), np.sin(heading)])
        arrow = {"arrowstyle": "-|>", "color": "black", "linewidth": 1.8, "shrinkA": 0}
        ax.annotate("", tip, trajectories[0][0], arrowprops=arrow, zorder=6)


def _near(path: Array, targets: Array) -> Array:
    """The points of a trajectory `[n, 2]` within 1.5 × the farthest target's distance.

    A robot that misses its target and walks on would otherwise set the scale of all axes.
    """
    path, targets = np.asarray(path), np.asarray(targets)
    most = 1.5 * np.linalg.norm(targets - path[0], axis=-1).max()
    return path[np.linalg.norm(path - path[0], axis=-1) <= most]


def _square(points: Iterable[Array]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits (x, y) of a square that contains all finite points `[N, 2]` and a margin."""
    stacked = np.concatenate([np.reshape(p, (-1, 2)) for p in points])
    stacked = stacked[np.isfinite(stacked).all(axis=1)]
    low, high = (stacked.min(0), stacked.max(0)) if len(stacked) else (np.zeros(2), np.ones(2))
    middle, half = (low + high) / 2, 0.54 * float((high - low).max()) + TARGET_RADIUS
    x, y = ((float(m - half), float(m + half)) for m in middle)
    return x, y


def _path_key() -> list[Line2D]:
    dot: dict[str, Any] = {"linestyle": "none", "color": "black"}
    return [
        Line2D([], [], marker="o", mfc=TARGET_RED, ms=8, label="target, 0.1 m", **dot),
        Line2D([], [], marker=r"$\rightarrow$", ms=13, label="heading at the start", **dot),
        Line2D([], [], marker="o", mfc="0.6", ms=5, label="end of the way", **dot),
    ]


def _metrics(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    records = itertools.chain(*curves.values())
    found = dict.fromkeys(k for r in records for k, v in r.items() if isinstance(v, int | float))
    return [key for key in found if key != "step"]


def _family(label: str) -> str:
    """The label up to a comma; curves with equal families have the same style."""
    return label.partition(",")[0]


def _curve_panel(
    ax: Axes,
    curves: Mapping[str, Sequence[Mapping[str, Any]]],
    key: str,
    looks: Mapping[str, Style],
) -> None:
    """Draws one metric; a loss on a log axis if all its values are positive."""
    least = np.inf
    for name, records in curves.items():
        points = np.array([(r["step"], r[key]) for r in records if key in r], float)
        if points.size:
            points = _thinned(points)
            drawing.line(ax, points[:, 0], points[:, 1], looks[_family(name)])
            least = min(least, np.min(points[:, 1]))
    if key.startswith("loss") and 0 < least < np.inf:
        ax.set_yscale("log")
    ax.xaxis.set_major_formatter(EngFormatter())


def _thinned(points: np.ndarray) -> np.ndarray:
    """Means of points `[N, 2]` over at most `CURVE_POINTS` groups of consecutive points."""
    groups = np.array_split(points, min(CURVE_POINTS, len(points)))
    return np.array([group.mean(0) for group in groups])


def _residual(ax: Axes, curve: Mapping[str, Array], style: Style) -> None:
    for key, width in (("median", 2.2), ("p90", 0.9)):
        values = np.maximum(np.asarray(curve[key], float), FLOOR)
        x = np.arange(1, len(values) + 1)
        marks = np.unique(np.geomspace(1, len(values), 9).astype(int)) - 1
        ax.plot(
            *(x, values),
            color=style.colour,
            linestyle=style.line,
            linewidth=width,
            marker=style.marker if key == "median" else "",
            markevery=marks.tolist(),
        )


def _name_noise(ax: Axes, changes: Mapping[str, Array]) -> None:
    """Labels the methods whose changes are too small for the axis with their maximum."""
    greatest = {name: float(np.max(values)) for name, values in changes.items()}
    for row, (name, most) in enumerate((n, m) for n, m in greatest.items() if m < NOISE):
        number = f"{most:.0e}".replace("e-0", "e-")
        text = f"{name}: at most {number}, float noise" if most else f"{name}: exactly 0"
        place: dict[str, Any] = dict(textcoords="offset points", ha="right", fontsize=9)
        place["xycoords"] = ("axes fraction", "data")
        ax.annotate(text, (0.99, 0), (0, 7 + 12 * row), **place)


def _deviations(means: Sequence[Sequence[float]]) -> Array:
    """Standard deviations over fits, as error bars `[2, n]`."""
    return np.stack([[np.std(fits, ddof=1) for fits in means]] * 2)


def _intervals(fits: Sequence[Array], middle: Array) -> Array:
    """95 % intervals over test seeds, as error bars `[2, n]` from the means."""
    low, high = np.array([stats.interval(fit) for fit in fits]).T
    return np.stack([middle - low, high - middle])


def _size_key(style: Style, several: bool, chosen: int | None) -> list[Line2D]:
    bars = " ± standard deviation over fits" if several else ", 95 % interval over test seeds"
    key = [Line2D([], [], label=f"{METHOD}, mean{bars}", **drawing.strokes(style))]
    if several:
        key.append(Line2D([], [], color=style.colour, label="one fit", **SINGLE))
    return key if chosen is None else [*key, Line2D([], [], label="k of Table 1", **CHOSEN)]


def _shifts(count: int, most: float = 0.12) -> Array:
    """Horizontal offsets of `count` methods in a bin, so that bars do not hide each other."""
    return np.linspace(-most, most, count) if count > 1 else np.zeros(count)


def _bars(ax: Axes, x: Array, y: Any, error: Any, style: Style) -> None:
    """Draws a method's line with error bars."""
    ax.errorbar(x, y, error, **drawing.strokes(style), markersize=5, capsize=2)


def _bins(ax: Axes, angle: Array, closest: Array, edges: Array, style: Style, shift: float) -> None:
    kept = np.isfinite(closest)
    values, width = np.asarray(closest, float)[kept], edges[1] - edges[0]
    index = np.clip(np.digitize(np.asarray(angle)[kept], edges) - 1, 0, len(edges) - 2)
    groups = [values[index == i] for i in range(len(edges) - 1)]
    mean = [g.mean() if g.size else np.nan for g in groups]
    error = [g.std(ddof=1) / np.sqrt(g.size) if g.size > 1 else 0.0 for g in groups]
    x = (edges[:-1] + edges[1:]) / 2 + shift * width
    _bars(ax, x, mean, error, style)
