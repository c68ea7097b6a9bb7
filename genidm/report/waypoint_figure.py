"""Fig. 7: trajectories through waypoints, and the heading of the body along them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from genidm.evaluation.waypoints import WaypointRuns
from genidm.report import drawing
from genidm.report.drawing import Style, Target, styles

ARROW = 0.6  # metres; length of an arrow that shows the heading
EVERY = 1.0  # seconds between arrows


def draw_waypoint_runs(
    by_method: Mapping[str, WaypointRuns], goal_radius: float, path: Target
) -> Figure:
    """Trajectories from above, one column per method; below, their distance from the path.

    Args:
      by_method: method → its runs; all methods have the same waypoints.
      goal_radius: radius of the waypoints' discs, metres.
      path: PNG to write.
    """
    columns = len(by_method)
    fig = Figure(figsize=(max(5.0, 3.4 * columns + 0.8), 6.4), layout="constrained")
    grid = fig.subplots(
        2, columns, squeeze=False, sharex="row", sharey="row", height_ratios=(2.2, 1)
    )
    looks = styles(by_method)
    for (above, below), (name, made) in zip(grid.T, by_method.items(), strict=True):
        _above(above, made, looks[name], goal_radius)
        _apart(below, made, looks[name])
        above.set_title(name, fontsize=12)
        drawing.style_axes(above, "x, m", "")
        drawing.style_axes(below, "time, s", "")
    grid[0, 0].set_ylabel("y, m", fontsize=11)
    grid[1, 0].set_ylabel("distance from\nthe path, m", fontsize=11)
    return drawing.write(fig, path)


def _above(ax: Axes, made: WaypointRuns, style: Style, goal_radius: float) -> None:
    """Draws all trajectories, the numbered waypoints, and the headings of the first run."""
    corners = np.concatenate([made.position[0, :1, :2], made.waypoints[0, :, :2]])
    ax.plot(*corners.T, color="0.6", linestyle=":", linewidth=1.2, zorder=1)
    for number, (x, y) in enumerate(corners[1:], 1):
        ax.add_patch(Circle((x, y), goal_radius, facecolor="none", edgecolor="black", zorder=3))
        ax.annotate(str(number), (x, y), (6, 6), textcoords="offset points", fontsize=10, zorder=6)
    for path, steps in zip(made.position, made.steps, strict=True):
        ax.plot(*path[: steps + 1, :2].T, color=style.colour, linewidth=1.0, alpha=0.7, zorder=2)
    stride = max(1, round(EVERY / made.dt))
    shown = np.arange(0, made.steps[0] + 1, stride)
    points, angles = made.position[0, shown, :2], made.heading[0, shown]
    ax.quiver(
        *points.T, np.cos(angles), np.sin(angles), angles="xy", scale_units="xy",
        scale=1 / ARROW, width=0.008, zorder=5,
    )  # fmt: skip
    ax.set_aspect("equal")


def _apart(ax: Axes, made: WaypointRuns, style: Style) -> None:
    seconds = made.dt * np.arange(made.position.shape[1])
    for row in made.cross_track_error:
        ax.plot(seconds, row, color=style.colour, linewidth=0.8, alpha=0.5)
    arrived = made.times[np.isfinite(made.times).all(1)]
    for time in arrived.mean(0) if len(arrived) else ():
        ax.axvline(time, color="0.6", linestyle=":", linewidth=1)
