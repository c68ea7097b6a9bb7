"""Fig. 7: trajectories through waypoints; speed and orientation of the robots along them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from scipy.ndimage import uniform_filter1d

from genidm.evaluation.waypoints import WaypointRuns
from genidm.report import drawing
from genidm.report.drawing import Style, Target, styles

INK = "0.15"
ARROWS = 26  # along a path
ARROW = 0.2  # length of an arrow, as a fraction of the mean leg
OTHERS = 9.0  # opacity of the runs that are not highlighted, times their number; at most FEW
FEW = 0.3
BAND = (10, 90)  # percentiles of the robots, over time
SMOOTH = 1.0  # seconds over which the values over time are averaged
MARGIN = 1.08  # of the time axis, beyond the end of the longest highlighted run


def draw_waypoint_runs(
    by_method: Mapping[str, WaypointRuns], goal_radius: float, path: Target
) -> Figure:
    """Trajectories from above, one column per method; below, speed and heading error over time.

    The median run of each method (`WaypointRuns.typical`) is highlighted, with arrows that show
    where the body faces. The bands over time hold the middle 80 % of the robots that still walk.

    Args:
      by_method: method → its runs; all methods have the same waypoints. What follows a comma in a
        name (a planner) does not change the colour.
      goal_radius: radius of the waypoints' discs, metres.
      path: PNG to write.
    """
    columns = len(by_method)
    fig = Figure(figsize=(max(4.6, 3.3 * columns + 0.7), 6.8), layout="constrained")
    grid = fig.subplots(
        3, columns, squeeze=False, sharex="row", sharey="row", height_ratios=(3.2, 1, 1)
    )
    methods = {name: name.split(",")[0] for name in by_method}
    looks, longest = styles(dict.fromkeys(methods.values())), 0.0
    for (above, speed, error), (name, made) in zip(grid.T, by_method.items(), strict=True):
        look = looks[methods[name]]
        _above(above, made, look, goal_radius)
        _over_time(speed, made, made.speed, look)
        _over_time(error, made, np.degrees(made.heading_error), look)
        above.set_title(_title(name, made), fontsize=11)
        for ax, label in ((above, "x, m"), (speed, ""), (error, "time, s")):
            drawing.style_axes(ax, label, "")
        longest = max(longest, made.dt * float(made.steps[made.typical]))
    _scale(grid, list(by_method.values()), goal_radius, longest)
    _key(fig)
    return drawing.write(fig, path)


def _title(name: str, made: WaypointRuns) -> str:
    found = made.summary()
    falls = f", {found['fell']:.0%} fell" if found["fell"] else ""
    return f"{name}: {found['all']:.0%} reach all{falls}"


def _scale(grid: np.ndarray, runs: list[WaypointRuns], goal_radius: float, longest: float) -> None:
    """Sets the labels and limits that all columns share."""
    above, speed, error = grid[:, 0]
    for ax, label in ((above, "y, m"), (speed, "speed,\nm/s"), (error, "heading\nerror, °")):
        ax.set_ylabel(label, fontsize=11)
    corners = np.concatenate([_corners(runs[0]), *(_highlighted(made) for made in runs)])
    low, high = corners.min(0) - 2.2 * goal_radius, corners.max(0) + 2.2 * goal_radius
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    fastest = max(float(np.nanpercentile(made.speed, 98)) for made in runs)
    speed.set(xlim=(0, MARGIN * longest), ylim=(0, 1.1 * max(fastest, 0.1)))
    error.set(xlim=(0, MARGIN * longest), ylim=(0, 180), yticks=(0, 90, 180))


def _key(fig: Figure) -> None:
    drawing.key(fig, [
        Line2D([], [], color=INK, linewidth=2, label="median robot"),
        Line2D([], [], color=INK, linewidth=1, alpha=0.35, label="all robots"),
        Line2D([], [], color=INK, linewidth=7, alpha=0.2, label="their middle 80 %"),
        Line2D([], [], color=INK, linestyle="", marker=">", label="where its body faces"),
        Line2D([], [], color=INK, linestyle="", marker="x", label="a fall"),
    ], "lower")  # fmt: skip


def _corners(made: WaypointRuns) -> np.ndarray:
    """The start of the first run, and the waypoints `[W + 1, 2]`."""
    return np.concatenate([made.position[0, :1, :2], made.waypoints[0, :, :2]])


def _highlighted(made: WaypointRuns) -> np.ndarray:
    """Positions `[t, 2]` of the median run."""
    return made.position[made.typical, : made.steps[made.typical] + 1, :2]


def _above(ax: Axes, made: WaypointRuns, style: Style, goal_radius: float) -> None:
    """Draws the course, all trajectories, and the headings along the median one."""
    _course(ax, made, goal_radius)
    faint = min(FEW, OTHERS / len(made.steps))
    for path, steps, fell in zip(made.position, made.steps, made.fell, strict=True):
        x, y = path[: steps + 1, :2].T
        ax.plot(x, y, color=style.colour, linewidth=0.9, alpha=faint, zorder=2)
        if fell:
            ax.plot(x[-1], y[-1], "x", color=INK, markersize=4, alpha=0.6, zorder=3)
    walked = _highlighted(made)
    edge = [withStroke(linewidth=3.4, foreground="white")]
    ax.plot(*walked.T, color=style.colour, linewidth=2, path_effects=edge, zorder=4)
    _arrows(ax, made)
    ax.set_aspect("equal", adjustable="box")


def _course(ax: Axes, made: WaypointRuns, goal_radius: float) -> None:
    """Draws legs and numbered discs, with the fraction of the runs that reached each."""
    corners = _corners(made)
    ax.plot(*corners.T, color="0.55", linestyle=(0, (4, 3)), linewidth=1.1, zorder=1)
    ax.plot(*corners[0], "o", color=INK, markersize=4, zorder=3)
    legs = np.diff(corners, axis=0)
    legs /= np.maximum(np.linalg.norm(legs, axis=-1, keepdims=True), 1e-9)
    reached = (made.arrival >= 0).mean(0)
    for i, (point, came) in enumerate(zip(corners[1:], legs, strict=True)):
        ax.add_patch(Circle(tuple(point), goal_radius, facecolor="0.9", edgecolor="0.35", zorder=1))
        outside = came - legs[i + 1] if i + 1 < len(legs) else came
        outside = outside / max(float(np.linalg.norm(outside)), 1e-9)
        white = [withStroke(linewidth=2.5, foreground="white")]
        ax.annotate(str(i + 1), tuple(point), ha="center", va="center", fontsize=9, color=INK,
                    weight="bold", path_effects=white, zorder=7)  # fmt: skip
        x, y = point + 1.75 * goal_radius * outside
        ax.annotate(f"{reached[i]:.0%}", (x, y), ha="center", va="center", fontsize=8,
                    color=INK, path_effects=white, zorder=7)  # fmt: skip


def _arrows(ax: Axes, made: WaypointRuns) -> None:
    """Draws where the body faces, at equal distances in time, along the median run."""
    i = made.typical
    shown = np.unique(np.linspace(0, made.steps[i], ARROWS).astype(int))
    points, angles = made.position[i, shown, :2], made.heading[i, shown]
    leg = np.linalg.norm(np.diff(_corners(made), axis=0), axis=-1).mean()
    ax.quiver(
        *points.T, np.cos(angles), np.sin(angles), angles="xy", scale_units="xy",
        scale=1 / (ARROW * leg), units="inches", width=0.018, headwidth=4.5, headlength=5,
        headaxislength=4.5, color=INK, zorder=5,
    )  # fmt: skip


def _over_time(ax: Axes, made: WaypointRuns, values: np.ndarray, style: Style) -> None:
    """Draws the band of `values [B, T + 1]`, and the median run's values and arrivals."""
    seconds, smooth = made.dt * np.arange(values.shape[1]), _smooth(values, made.dt)
    walks = np.isfinite(smooth).any(0)
    if walks.any():
        low, high = np.nanpercentile(smooth[:, walks], BAND, axis=0)
        ax.fill_between(seconds[walks], low, high, color=style.colour, alpha=0.2, linewidth=0)
    for time in made.times[made.typical]:
        ax.axvline(time, color="0.55", linestyle=(0, (4, 3)), linewidth=1, zorder=1)
    ax.plot(seconds, smooth[made.typical], color=style.colour, linewidth=1.6, zorder=4)


def _smooth(values: np.ndarray, dt: float) -> np.ndarray:
    """Means of `values [B, T + 1]` over SMOOTH seconds, without NaN; NaN stays NaN."""
    width = 2 * round(SMOOTH / 2 / dt) + 1
    finite = np.isfinite(values)
    total = uniform_filter1d(np.where(finite, values, 0.0), width, axis=1, mode="constant")
    share = uniform_filter1d(finite.astype(float), width, axis=1, mode="constant")
    return np.where(finite, total / np.maximum(share, 1e-9), np.nan)
