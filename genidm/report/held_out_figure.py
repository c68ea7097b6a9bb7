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
    for row, (name, found) in enumerate(errors.items()):
        _lines(left, found["bearing"], looks[name])
        _lines(right, found["heading"], looks[name])
        if name in bearings:
            ends, height = np.degrees(bearings[name]), -0.06 * (row + 1)
            left.plot(ends, [height, height], color=looks[name].colour, linewidth=3)
    for ax in (left, right):
        ax.axhline(1, **MEAN)
        ax.set(xlim=(-180, 180), xticks=np.arange(-180, 181, 60))
    left.set_yticks([tick for tick in left.get_yticks() if tick >= 0])
    left.set_ylim(-0.06 * (len(errors) + 1), None)
    drawing.style_axes(
        left,
        "bearing of d from the heading, degrees (left is positive)",
        "action error / variance",
    )
    drawing.style_axes(right, "heading in the world, degrees", "")
    drawing.line_key(fig, looks, _key(bool(bearings)))
    return drawing.write(fig, path)


def _lines(ax: Axes, bins: Mapping[str, Any], style: Style) -> None:
    edges = np.asarray(bins["edges"], float)
    middle = (edges[:-1] + edges[1:]) / 2
    ax.plot(middle, np.array(bins["error"], float), **drawing.strokes(style), markersize=5)
    ax.plot(middle, np.array(bins["shuffled"], float), **drawing.strokes(style) | SHUFFLED)


def _key(ranges: bool) -> list[Line2D]:
    key = [
        Line2D([], [], color="0.25", label="with d shuffled", **SHUFFLED),
        Line2D([], [], label="mean action", **MEAN),
    ]
    seen = Line2D([], [], color="0.25", linewidth=3, label="98 % of the d of the fit")
    return [*key, seen] if ranges else key
