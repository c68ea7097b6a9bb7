"""Fig. 7, waypoints: `python -m experiments.waypoints runs/ant/LR-0-… runs/ant/VGCP-0-…`."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from genidm import checks, files, video
from genidm.checks import count, number, optional, positive
from genidm.errors import BadInput
from genidm.evaluation.evaluator import ControllerFn
from genidm.evaluation.planners import ArcPlanner, Planner, first_unreached
from genidm.evaluation.waypoints import (
    WaypointRuns,
    WaypointSettings,
    follow_waypoints,
    in_twos,
    nothing,
)
from genidm.report import draw_waypoint_runs
from genidm.report.rows import jsonable, made_now
from genidm.report.table import aligned
from genidm.robots import Robot
from genidm.runs.cell import load_runs
from genidm.runs.command import run_cli

# Directions of the five legs of the course, degrees: it bends to the left twice, then twice to
# the right.
LEGS = (0.0, 60.0, 120.0, 60.0, 0.0)
# A leg, by the greatest target distance of the paper's test: 3 m, the Minitaur's 1.5 m.
LEG = 0.6
# The arc planner's turning radius if none is given, by the leg.
TURN = 1 / 3


@dataclasses.dataclass(frozen=True)
class Walk:
    """What all controllers do: a course, starts, planners.

    Attributes:
      waypoints: x and y of each, metres; robots start near the origin. By default five that bend
        both ways, in steps of 3 m (the Minitaur's: 1.5 m).
      robots: robots per controller and planner.
      yaw: radians by which the initial states are rotated.
      seed: of the initial states.
      planner: "straight" walks to the next waypoint, "arc" on curves of a least radius; or both.
      turning_radius: of the arc planner, metres; by default a third of a default leg.
      look_ahead: of the arc planner, metres; by default the turning radius.
    """

    waypoints: tuple[float, ...] = ()
    robots: int = 64
    yaw: float = 0.0
    seed: int = 0
    planner: tuple[Literal["straight", "arc"], ...] = ("straight",)
    turning_radius: float | None = None
    look_ahead: float | None = None

    def __post_init__(self) -> None:
        length = optional(positive())
        checks.check(self, robots=count(1, 10_000), yaw=number(), seed=checks.seed(),
                     turning_radius=length, look_ahead=length)  # fmt: skip
        if not self.planner:
            raise BadInput("give at least one planner: straight, arc")

    def points(self, robot: Robot) -> np.ndarray:
        """The waypoints `[W, 2]`, metres."""
        return in_twos(self.waypoints) if self.waypoints else course(robot)

    def planners(self, robot: Robot) -> dict[str, Planner]:
        """The planners by their names."""
        radius = self.turning_radius or round(TURN * LEG * robot.target_distance[1], 3)
        arc = ArcPlanner(radius, self.look_ahead or radius)
        every: dict[str, Planner] = {"straight": first_unreached, "arc": arc}
        return {name: every[name] for name in self.planner}


def course(robot: Robot) -> np.ndarray:
    """Five waypoints `[5, 2]` that bend both ways, metres, scaled to the robot's test."""
    angles = np.radians(LEGS)
    legs = LEG * robot.target_distance[1] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.cumsum(legs, axis=0).round(3)


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    walk: Annotated[Walk, tyro.conf.arg(name="")] = Walk(),
    engine: str | None = None,
    film: Annotated[bool, tyro.conf.arg(name="video")] = False,
    out: Path = Path("runs/waypoints"),
    settings: Annotated[WaypointSettings, tyro.conf.arg(name="")] = WaypointSettings(
        goal_radius=0.5
    ),
) -> None:
    """Runs controllers through waypoints, all from the same initial states.

    Args:
      runs: directories of fits or baselines (METHOD-SEED-…) under --run-dir.
      walk: course, starts, planners.
      engine: "mjx" or "mujoco"; default: MJX on an accelerator, MuJoCo in C on a CPU.
      film: write a video of each controller's median run.
      out: directory for the figure, the numbers and the videos.
      settings: length of an episode, goal radius.

    Raises:
      BadInput: no runs, or runs of different robots; invalid waypoints; or `out` is not writable.
    """
    if walk.waypoints:
        in_twos(walk.waypoints)  # raises its error before anything is loaded
    files.check_writable(out, directory=True)
    robot, models = load_runs(runs, engine)
    controllers = {name: model for name, (model, _) in models.items()}
    made = walked(robot, controllers, walk, settings, film)
    print("\n".join(aligned(table(made))))
    numbers = written(robot, made, walk, settings)
    numbers["controllers"] = {name: str(path) for name, path in zip(models, runs, strict=True)}
    name = f"{robot.name}_waypoints"
    files.save_json(out / f"{name}.json", numbers)
    draw_waypoint_runs(made, settings.goal_radius, out / f"{name}.png")
    print(f"Numbers and figure: {out / name}.json, .png")
    if film:
        write_videos(robot, made, settings.goal_radius, out)


def walked(
    robot: Robot,
    controllers: Mapping[str, ControllerFn],
    walk: Walk,
    settings: WaypointSettings,
    poses: bool = False,
) -> dict[str, WaypointRuns]:
    """Walks the course with each controller and planner; records poses if asked to."""
    if poses:
        robot.visual_model()  # raises its error before anything is computed
    record = video.POSES if poses else nothing
    keys = jax.random.split(jax.random.key(walk.seed), walk.robots)
    yaw, planners = jnp.full(walk.robots, walk.yaw), walk.planners(robot)
    return {
        f"{name}, {plan}" if len(planners) > 1 else name: follow_waypoints(
            robot, controller, walk.points(robot), keys, yaw, planner, settings, record=record
        )
        for name, controller in controllers.items()
        for plan, planner in planners.items()
    }


def written(
    robot: Robot, made: Mapping[str, WaypointRuns], walk: Walk, settings: WaypointSettings
) -> dict[str, Any]:
    """The numbers as they are written: course, settings, each method's summary, and provenance."""
    return {
        "waypoints": walk.points(robot),
        "settings": dataclasses.asdict(settings),
        "starts": {"robots": walk.robots, "yaw": walk.yaw, "seed": walk.seed},
        "planners": described(walk.planners(robot)),
        "engine": str(robot.engine),
        "methods": jsonable({name: one.summary() for name, one in made.items()}, digits=4),
        "made": made_now("genidm.evaluation.waypoints", robot, robot.engine),
    }


def described(planners: Mapping[str, Planner]) -> dict[str, Any]:
    """The settings of the planners, by their names."""
    return {
        name: dataclasses.asdict(planner) if isinstance(planner, ArcPlanner) else {}
        for name, planner in planners.items()
    }


def table(made: Mapping[str, WaypointRuns]) -> list[tuple[str, ...]]:
    """Rows of text: the header, then each method's numbers."""
    numbers = map(str, range(1, 1 + max(one.waypoints.shape[1] for one in made.values())))
    header = ("reached", *numbers, "all", "falls", "off the legs", "heading error", "speed", "time")
    return [header, *(_row(name, one) for name, one in made.items())]


def _row(name: str, made: WaypointRuns) -> tuple[str, ...]:
    found = made.summary()
    whole = made.times[np.isfinite(made.times).all(1), -1]
    return (
        name,
        *(f"{x:.0%}" for x in (*found["reached"], found["all"], found["fell"])),
        f"{found['cross_track_error']:.2f} m",
        f"{np.degrees(found['heading_error'] or 0):.0f}°",
        f"{found['speed']:.2f} m/s",
        f"{whole.mean():.1f} s" if len(whole) else "–",
    )


def write_videos(
    robot: Robot, made: Mapping[str, WaypointRuns], goal_radius: float, out: Path
) -> None:
    """Writes a page, and a gif if frames can be drawn, of each method's median run."""
    for name, one in made.items():
        shown = video.render_walked(robot, one, [one.typical], goal_radius, f"{name}, {robot.name}")
        path = out / f"{robot.name}_waypoints_{name.replace(', ', '_')}"
        video.write(shown, f"{path}.html")
        try:
            video.write(shown, f"{path}.gif")
        except BadInput as error:
            print(f"no gif: {error}", file=sys.stderr)
        print(f"Video: {path}.html, .gif")


if __name__ == "__main__":
    run_cli(main, "Runs controllers through waypoints.")
