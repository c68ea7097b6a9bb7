"""The held-out action error of the fits, by bearing of d and by heading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from genidm.report import drawing
from genidm.report.drawing import Style, Target, styles

SHUFFLED: dict[str, Any] = {"linestyle": ":", "linewidth": 1.1, "marker": ""}
MEAN: dict[str, Any] = {"color": "0.45", "linestyle": (0, (6, 3)), "linewidth": 1}


def draw_held_out(
    errors: Mapping[str, Mapping[str, Any]],
    bearings: Mapping[str, Sequence[float]],
    path: Target,
) -> Figure:
    """Draw the error of each fit on samples that it has not seen, as a fraction of the variance.

    Dotted lines are the error with d shuffled. The dashed line is the error of the mean action. A
    bar below the left panel is the range of bearings that the fit has seen.

    Args:
      errors: method → `genidm.paper.held_out.HeldOut`, as in its JSON file.
      bearings: method → `Controller.bearings`, radians.
      path: PNG to write.
    """
    fig = Figure(figsize=(9.0, 3.9), layout="constrained")
    left, right = fig.subplots(1, 2, sharey=True)
    looks = styles(errors)
    for name, found in errors.items():
        _lines(left, found["bearing"], looks[name])
        _lines(right, found["heading"], looks[name])
    for ax in (left, right):
        ax.axhline(1, **MEAN)
        ax.set(xlim=(-180, 180), xticks=np.arange(-180, 181, 60))
    _ranges(left, bearings, looks)
    drawing.style_axes(
        left,
        "bearing of d from the heading, degrees (left is positive)",
        "held-out action error / variance",
    )
    drawing.style_axes(right, "heading in the world, degrees", "")
    drawing.line_key(fig, looks, _key(bool(bearings)))
    return drawing.write(fig, path)


def _lines(ax: Axes, bins: Mapping[str, Any], style: Style) -> None:
    edges = np.asarray(bins["edges"], float)
    middle = (edges[:-1] + edges[1:]) / 2
    ax.plot(middle, np.array(bins["error"], float), **drawing.strokes(style), markersize=5)
    ax.plot(middle, np.array(bins["shuffled"], float), **drawing.strokes(style) | SHUFFLED)


def _ranges(ax: Axes, bearings: Mapping[str, Sequence[float]], looks: Mapping[str, Style]) -> None:
    """Draws the ranges below 0, one below the other."""
    ax.set_ylim(bottom=0)
    top = ax.get_ylim()[1]
    row = 0.035 * top
    ax.set_yticks([tick for tick in ax.get_yticks() if 0 <= tick <= top])
    ax.set_ylim(-row * (len(bearings) + 1), top)
    for number, (name, ends) in enumerate(bearings.items(), 1):
        ax.hlines(-row * number, *np.degrees(ends), color=looks[name].colour, linewidth=3)


def _key(ranges: bool) -> list[Line2D]:
    key = [
        Line2D([], [], color="0.25", label="with d shuffled", **SHUFFLED),
        Line2D([], [], label="mean action", **MEAN),
    ]
    seen = Line2D([], [], color="0.25", linewidth=3, label="98 % of the d of the fit")
    return [*key, seen] if ranges else key
