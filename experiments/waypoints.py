"""Fig. 7, waypoints: `python -m experiments.waypoints runs/ant/LR-0-… runs/ant/VGCP-0-…`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from genidm import checks, files
from genidm.checks import check_value, count, number
from genidm.evaluation.waypoints import WaypointRuns, WaypointSettings, follow_waypoints, in_twos
from genidm.report import draw_waypoint_runs
from genidm.report.rows import jsonable, made_now
from genidm.runs.cell import load_runs
from genidm.runs.command import run_cli

# Metres. The path goes ahead, turns left by more than 180°, and ends 2.8 m from its start.
LOOP = (3.0, 0.0, 5.0, 2.0, 4.0, 5.0, 0.0, 5.0, -2.0, 2.0)


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    waypoints: tuple[float, ...] = LOOP,
    robots: int = 10,
    yaw: float = 0.0,
    seed: int = 0,
    engine: str | None = None,
    out: Path = Path("runs/waypoints"),
    settings: Annotated[WaypointSettings, tyro.conf.arg(name="")] = WaypointSettings(),
) -> None:
    """Runs controllers through waypoints, all from the same initial states.

    Args:
      runs: directories of fits or baselines (METHOD-SEED-…) under --run-dir.
      waypoints: x and y of each, metres; robots start near the origin.
      robots: robots per controller.
      yaw: radians by which the initial states are rotated.
      seed: of the initial states.
      engine: "mjx" or "mujoco"; default: MJX on an accelerator, MuJoCo in C on a CPU.
      out: directory for the figure and the numbers.
      settings: length of an episode, goal radius.

    Raises:
      BadInput: no runs, or runs of different robots; invalid waypoints; or `out` is not writable.
    """
    check_value("robots", robots, count(1, 10_000))
    check_value("yaw", yaw, number())
    check_value("seed", seed, checks.seed())
    points = in_twos(waypoints)
    files.check_writable(out, directory=True)
    robot, models = load_runs(runs, engine)
    keys, turned = jax.random.split(jax.random.key(seed), robots), jnp.full(robots, yaw)
    made = dict[str, WaypointRuns]()
    for name, (model, _) in models.items():
        made[name] = follow_waypoints(robot, model, points, keys, turned, settings=settings)
        print(f"{name}: {sentence(made[name])}")
    summary = {name: one.summary() for name, one in made.items()}
    written = {
        "waypoints": points,
        "engine": str(robot.engine),
        "methods": jsonable(summary, digits=4),
        "made": made_now("genidm.evaluation.waypoints", robot, robot.engine),
        "controllers": {name: str(path) for name, path in zip(models, runs, strict=True)},
    }
    name = f"{robot.name}_waypoints"
    files.save_json(out / f"{name}.json", written)
    draw_waypoint_runs(made, settings.goal_radius, out / f"{name}.png")
    print(f"Numbers and figure: {out / name}.json, .png")


def sentence(made: WaypointRuns) -> str:
    """A summary of one controller's runs in one sentence."""
    found = made.summary()
    complete = made.times[np.isfinite(made.times).all(1), -1]
    duration = f", in {complete.mean():.1f} s" if len(complete) else ""
    each = " ".join(str(n) for n in (made.arrival >= 0).sum(0))
    return (
        f"{len(complete)} of {found['runs']} reached all waypoints{duration} (each: {each}); "
        f"cross-track error {found['cross_track_error']:.2f} m, "
        f"heading error {np.degrees(found['heading_error'] or 0):.0f}°, "
        f"{found['fell']:.0%} fell"
    )


if __name__ == "__main__":
    run_cli(main, "Runs controllers through waypoints.")
