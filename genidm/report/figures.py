"""The figures, each a function of data and a path that writes a PNG and returns the Figure.

A method has one colour, marker, line and hatch in every figure (`STYLES`). The colours are
Okabe and Ito's, which the colour-blind tell apart; the others do it in grey print.
Nothing here touches pyplot or its global state.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import EngFormatter

from genidm import stats
from genidm.report.table import Row

Array = np.ndarray
Target = str | os.PathLike[str]
Panel = tuple[str, Mapping[str, Sequence[Array]], Array, float]

DPI = 150
TARGET_RADIUS = 0.1  # metres; what counts as reached, drawn to scale
BESIDE = 0.2  # of the distance between violins; how far from the middle the means stand
TARGET_RED = "#D00000"
FLOOR = 1e-8  # metres; where a log axis shows a residual of exactly 0

METRICS = {
    "episode_reward": "episode reward",
    "reward": "reward",
    "forward_speed": "forward speed, m/s",
    "speed": "forward speed, m/s",
    "fell": "share of falls",
    "episode_length": "episode length, steps",
    "loss": "loss L (Eq. 7)",
    "loss_latent": "latent loss L1 (Eq. 5)",
    "loss_action": "action loss L2 (Eq. 6)",
}
"""Metric → label of its axis; any other metric is labelled by its own name."""


@dataclasses.dataclass(frozen=True)
class Style:
    """How a method is drawn.

    Attributes:
      colour: hexadecimal RGB.
      marker, line, hatch: Matplotlib's codes.
    """

    colour: str
    marker: str
    line: Any
    hatch: str


_DASHES = (0, (6, 1.5, 1.5, 1.5))
STYLES = {
    "RS": Style("#8C8C8C", "x", ":", ""),
    "RL": Style("#E69F00", "s", "--", "//"),
    "VGCP": Style("#56B4E9", "v", "-.", "\\\\"),
    "HER_SP": Style("#F0E442", "<", _DASHES, "--"),
    "HER_DE": Style("#CC79A7", ">", (0, (1, 1)), "||"),
    "GE": Style("#009E73", "^", "-.", "xx"),
    "LR": Style("#0072B2", "o", "-", ".."),
    "HF": Style("#D55E00", "D", (0, (5, 1)), "++"),
}
"""Method → style, the same in every figure."""

_SPARE = (
    Style("#0072B2", "o", "-", ""),
    Style("#D55E00", "s", "--", "//"),
    Style("#009E73", "^", "-.", "xx"),
    Style("#CC79A7", "v", _DASHES, "\\\\"),
    Style("#56B4E9", "P", (0, (5, 1)), "++"),
    Style("#E69F00", "X", (0, (1, 1)), "||"),
    Style("#882255", "D", ":", "oo"),
)


def styles(names: Iterable[str]) -> dict[str, Style]:
    """A style for each name: a method's own, and for the others what no method here uses."""
    names = list(names)
    taken = {STYLES[n].colour for n in names if n in STYLES}
    free = [s for s in _SPARE if s.colour not in taken] or list(_SPARE)
    spare = itertools.cycle(free)
    return {name: STYLES[name] if name in STYLES else next(spare) for name in names}


def violins(
    rows: Sequence[Row], path: Target, paper: Mapping[str, tuple[float, float]] | None = None
) -> Figure:
    """Closest distance by method, over all test episodes (Fig. 5).

    Args:
      rows: one a method, drawn in this order; diverged episodes are left out.
      path: PNG to write.
      paper: method → (mean, std) in metres, as in `paper.TABLE1[robot]`; the mean is marked.
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
    _dress(ax, "", "closest distance to the target, m")
    _key(fig, _violin_key(bool(paper)))
    return _write(fig, path)


def paths(panels: Sequence[Panel], path: Target) -> Figure:
    """Ways walked towards targets seen and unseen while learning (Fig. 8), one row a panel.

    Args:
      panels: (title, method → ways, each `[T, 2]` metres, targets `[E, 2]` metres, heading at
        the start in radians). Every method of a panel has its own axes, equally scaled.
      path: PNG to write.
    """
    methods = list(dict.fromkeys(name for panel in panels for name in panel[1]))
    size = (max(4.0, 2.3 * len(methods) + 0.7), 2.45 * len(panels) + 0.8)
    fig = Figure(figsize=size, layout="constrained")
    grid = fig.subplots(len(panels), len(methods), squeeze=False, sharex="row", sharey="row")
    looks = styles(methods)
    for axes, (title, ways, targets, heading) in zip(grid, panels, strict=True):
        limits = _square([np.asarray(targets), *itertools.chain(*ways.values())])
        for ax, name in zip(axes, methods, strict=True):
            _targets(ax, targets)
            _ways(ax, ways.get(name, ()), looks[name], heading, limits)
            ax.set(xlim=limits[0], ylim=limits[1], aspect="equal")
            _dress(ax, "", "")
            ax.grid(False)
        axes[0].set_ylabel(f"{title}\ny, m", fontsize=11)
    _head_and_foot(grid, methods)
    _key(fig, _path_key(), "lower")
    return _write(fig, path)


def learning_curves(
    curves: Mapping[str, Sequence[Mapping[str, Any]]],
    path: Target,
    keys: Sequence[str] | None = None,
    steps: str = "steps",
) -> Figure:
    """Metrics while learning, one panel a metric, one line a label.

    Args:
      curves: label → records with "step" and metrics, as a run's JSONL holds them; a record
        need not hold every metric.
      path: PNG to write.
      keys: the metrics to draw, in order; by default every number of the records.
      steps: what "step" counts, the label of the horizontal axis ("interactions", "updates").
    """
    keys = list(keys) if keys is not None else _metrics(curves)
    columns = max(1, min(3, len(keys)))
    rows = max(1, -(-len(keys) // columns))
    fig = Figure(figsize=(3.7 * columns + 0.4, 2.9 * rows + 0.5), layout="constrained")
    axes = fig.subplots(rows, columns, squeeze=False, gridspec_kw={"wspace": 0.08}).ravel()
    looks = styles(curves)
    for ax, key in zip(axes, keys, strict=False):
        _curve_panel(ax, curves, key, looks)
        _dress(ax, steps, METRICS.get(key, key.replace("_", " ")))
    for ax in axes[len(keys) :]:
        ax.set_visible(False)
    _line_key(fig, looks)
    return _write(fig, path)


def residuals(curves: Mapping[str, Mapping[str, Array]], path: Target) -> Figure:
    """How far 𝒢's replay is from the exactly turned record, by step since placing (Def. 1, 4).

    Args:
      curves: mode of 𝒢 → "median" and "p90", each `[H]` metres, of the first to the H-th step
        after placing. A residual of exactly 0 is drawn at the axis' foot.
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
    _dress(ax, "steps since placing", "distance to the exact rotation, m")
    kinds = [
        Line2D([], [], color="0.25", lw=2.2, label="median"),
        Line2D([], [], color="0.25", lw=0.9, label="90th percentile"),
    ]
    _line_key(fig, looks, kinds)
    return _write(fig, path)


def bearings(closest: Mapping[str, Array], bearing: Array, heading: Array, path: Target) -> Figure:
    """Closest distance against where the target lies and which way the robot faces.

    The first panel shows turns that a method never learned, the second where it is not
    invariant to yaw. Marks are means of bins, bars their standard errors over episodes.

    Args:
      closest: method → closest distance in metres, `[seeds, episodes]`; NaN is left out.
      bearing: radians, `[seeds, episodes]`; of the target from the heading, left positive.
      heading: radians, `[seeds, episodes]`; yaw at the start, in the world frame.
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
    _dress(
        left,
        "bearing of the target, degrees (left is positive)",
        "closest distance to the target, m",
    )
    _dress(right, "heading at the start in the world, degrees", "")
    _line_key(fig, looks)
    return _write(fig, path)


def _write(fig: Figure, path: Target) -> Figure:
    """Writes beside `path` and moves into place, so that no reader sees half a picture."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        # Without the version of Matplotlib in it, equal figures are equal files.
        fig.savefig(part, dpi=DPI, format="png", metadata={"Software": None})
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return fig


def _dress(ax: Axes, xlabel: str, ylabel: str) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=10)
    ax.grid(axis="y", color="0.9", linewidth=0.8)
    ax.set_axisbelow(True)
    if xlabel:
        ax.set_xlabel(xlabel, fontsize=11)
    if ylabel:
        ax.set_ylabel(ylabel, fontsize=11)


def _line_key(fig: Figure, looks: Mapping[str, Style], extra: Sequence[Line2D] = ()) -> None:
    lines = [
        Line2D([], [], color=s.colour, marker=s.marker, linestyle=s.line, label=name)
        for name, s in looks.items()
    ]
    _key(fig, [*lines, *extra])


def _key(fig: Figure, handles: Sequence[Line2D], edge: str = "upper") -> None:
    """A legend above or below the axes, in as many columns as fit."""
    if not handles:
        return
    # Inches at 9 points: a handle with its gaps, and a letter.
    widths = [0.73 + 0.07 * len(str(h.get_label())) for h in handles]
    fitting = max(1, int(fig.get_figwidth() / max(widths)))
    columns = len(handles) if sum(widths) < fig.get_figwidth() else min(len(handles), fitting)
    place: Any = f"outside {edge} center"
    fig.legend(handles=handles, loc=place, ncols=columns, fontsize=9, handlelength=3)


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


def _targets(ax: Axes, targets: Array) -> None:
    for x, y in np.asarray(targets):
        disc = Circle((x, y), TARGET_RADIUS, facecolor=TARGET_RED, edgecolor="black", zorder=5)
        ax.add_patch(disc)


def _ways(
    ax: Axes,
    ways: Sequence[Array],
    style: Style,
    heading: float,
    limits: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    for way in map(np.asarray, ways):
        ax.plot(way[:, 0], way[:, 1], color=style.colour, linewidth=1.2)
        ax.plot(*way[-1], marker=style.marker, color=style.colour, mec="black", mew=0.6, ms=5)
    if len(ways):
        length = 0.12 * (limits[0][1] - limits[0][0])
        tip = ways[0][0] + length * np.array([np.cos(heading), np.sin(heading)])
        arrow = {"arrowstyle": "-|>", "color": "black", "linewidth": 1.8, "shrinkA": 0}
        ax.annotate("", tip, ways[0][0], arrowprops=arrow, zorder=6)


def _square(points: Iterable[Array]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits (x, y) of one length that hold all finite points `[N, 2]` and a margin."""
    stacked = np.concatenate([np.reshape(p, (-1, 2)) for p in points])
    stacked = stacked[np.isfinite(stacked).all(axis=1)]
    low, high = (stacked.min(0), stacked.max(0)) if len(stacked) else (np.zeros(2), np.ones(2))
    middle, half = (low + high) / 2, 0.54 * float((high - low).max()) + TARGET_RADIUS
    x, y = ((float(m - half), float(m + half)) for m in middle)
    return x, y


def _head_and_foot(grid: Array, methods: Sequence[str]) -> None:
    for ax, name in zip(grid[0], methods, strict=True):
        ax.set_title(name, fontsize=12)
    for ax in grid[-1]:
        ax.set_xlabel("x, m", fontsize=11)


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


def _curve_panel(
    ax: Axes,
    curves: Mapping[str, Sequence[Mapping[str, Any]]],
    key: str,
    looks: Mapping[str, Style],
) -> None:
    """One metric; losses on a log axis where they allow it."""
    least = np.inf
    for name, records in curves.items():
        points = np.array([(r["step"], r[key]) for r in records if key in r], float)
        if points.size:
            _line(ax, points[:, 0], points[:, 1], looks[name])
            least = min(least, np.min(points[:, 1]))
    if key.startswith("loss") and 0 < least < np.inf:
        ax.set_yscale("log")
    ax.xaxis.set_major_formatter(EngFormatter())


def _line(ax: Axes, x: Array, y: Array, style: Style, width: float = 1.8, marks: int = 8) -> None:
    every = max(1, len(x) // marks)
    marker: dict[str, Any] = {"marker": style.marker, "markevery": every, "markersize": 5}
    ax.plot(x, y, color=style.colour, linestyle=style.line, linewidth=width, **marker)


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


def _shifts(count: int) -> Array:
    """Where in its bin each of `count` methods stands, so that bars do not hide each other."""
    return np.linspace(-0.12, 0.12, count) if count > 1 else np.zeros(count)


def _bins(ax: Axes, angle: Array, closest: Array, edges: Array, style: Style, shift: float) -> None:
    kept = np.isfinite(closest)
    values, width = np.asarray(closest, float)[kept], edges[1] - edges[0]
    index = np.clip(np.digitize(np.asarray(angle)[kept], edges) - 1, 0, len(edges) - 2)
    groups = [values[index == i] for i in range(len(edges) - 1)]
    mean = [g.mean() if g.size else np.nan for g in groups]
    error = [g.std(ddof=1) / np.sqrt(g.size) if g.size > 1 else 0.0 for g in groups]
    x = (edges[:-1] + edges[1:]) / 2 + shift * width
    ax.errorbar(
        *(x, mean, error),
        color=style.colour,
        linestyle=style.line,
        marker=style.marker,
        markersize=5,
        capsize=2,
    )
