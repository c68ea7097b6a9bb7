"""Renders a saved controller: `python -m genidm.video runs/ant/LR-0-…`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from genidm import video
from genidm.errors import BadInput
from genidm.evaluation.waypoints import WaypointSettings, in_twos
from genidm.runs.command import run_cli
from genidm.video.clips import LONGEST


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: tuple[Path, ...] = (),
    episodes: tuple[int, ...] = (),
    waypoints: tuple[float, ...] = (),
    goal_radius: float = WaypointSettings.goal_radius,
    seed: int = 0,
    seconds: float = LONGEST,
    width: int | None = None,
    height: int | None = None,
    fps: float | None = None,
    engine: str | None = None,
) -> None:
    """Renders a controller in episodes of the test (A.1.3), or on its way through waypoints.

    Args:
      runs: one directory of a fit or a baseline (METHOD-SEED-…) under --run-dir.
      out: files to write: .gif, .mp4 (needs the extra `video`), or .html, an interactive page that
        needs no renderer; default: runs/video/ROBOT-RUN.gif.
      episodes: numbers of episodes, from 0; default: 0 1 2 of the test, or 0 with waypoints.
      waypoints: x and y of each, metres; robots start near the origin. Default: the targets of
        the test.
      goal_radius: metres; a waypoint is reached when the robot is this near. The test has its own.
      seed: of the test, or of the initial states.
      seconds: longest duration of an episode.
      width: pixels of a frame; default: 320 in a gif, 640 in an mp4.
      height: pixels of a frame; default: 240 in a gif, 480 in an mp4.
      fps: frames per second, at most 50 in a gif; default: 12.5 in a gif, 25 in an mp4.
      engine: "mjx" or "mujoco"; default: the run's engine.

    Raises:
      BadInput: no such controller or episode; the robot has no visual model; a renderer or an
        encoder is missing; or a file cannot be written.
    """
    if len(runs) != 1:
        given = ", ".join(map(str, runs)) or "none"
        raise BadInput(f"a video needs exactly one run, got {given}")
    (run,) = runs
    paths = out or (Path("runs/video") / f"{run.resolve().parent.name}-{run.resolve().name}.gif",)
    settings = {"width": width, "height": height, "fps": fps}
    changes: dict[str, Any] = {name: x for name, x in settings.items() if x is not None}
    for path in paths:
        video.check(path, **changes)
    points = in_twos(waypoints) if waypoints else None
    made = video.render_run(run, episodes, points, seed, seconds, goal_radius, engine)
    for path in paths:
        video.write(made, path, **changes)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    run_cli(main, "Renders a saved controller.")
