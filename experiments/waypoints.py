"""Fig. 7: `python -m experiments.waypoints runs/ant/LR-0-… runs/ant/VGCP-0-…`."""

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
from genidm.provenance import environment
from genidm.report import draw_waypoint_runs
from genidm.report.rows import jsonable
from genidm.runs.cell import saved
from genidm.runs.command import run_cli

# Metres. It goes ahead, turns both ways, and comes back facing where it started from.
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
    """Leads robots through waypoints, one controller after another from the same starts.

    Args:
      runs: directories of fits or baselines (METHOD-SEED-…), as cells leave them under --run-dir.
      waypoints: x and y of each, metres; starts are near the origin.
      robots: journeys of each controller.
      yaw: radians, that the starts are turned by.
      seed: of the starts.
      engine: "mjx" or "mujoco"; MJX on an accelerator, MuJoCo in C on a CPU, unless given.
      out: directory that gets the figure and the numbers.
      settings: of a journey.

    Raises:
      BadInput: runs of different robots, or none; waypoints that are none; `out` cannot be
        written.
    """
    check_value("robots", robots, count(1, 10_000))
    check_value("yaw", yaw, number())
    check_value("seed", seed, checks.seed())
    points = in_twos(waypoints)
    files.check_writable(out, directory=True)
    robot, models = saved(runs, engine)
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
        **environment(),
    }
    name = f"{robot.name}_waypoints"
    files.save_json(out / f"{name}.json", written)
    draw_waypoint_runs(made, settings.goal_radius, out / f"{name}.png")
    print(f"Numbers and figure: {out / name}.json, .png")


def sentence(made: WaypointRuns) -> str:
    """What became of the journeys, in words."""
    found = made.summary()
    whole = made.times[np.isfinite(made.times).all(1), -1]
    took = f", in {whole.mean():.1f} s" if len(whole) else ""
    each = " ".join(str(n) for n in (made.arrival >= 0).sum(0))
    return (
        f"{len(whole)} of {found['runs']} through all waypoints{took} ({each} reached each); "
        f"{found['cross_track_error']:.2f} m from the path, "
        f"body {np.degrees(found['heading_error'] or 0):.0f}° from its course, "
        f"{found['fell']:.0%} fell"
    )


if __name__ == "__main__":
    run_cli(main, "Through waypoints.")
