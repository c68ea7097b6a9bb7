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
      runs: one directory of a fit or a baseline (METHOD-SEED-…), as a cell leaves it under
        --run-dir.
      out: files to write: .gif, .mp4 (needs the extra `video`), or .html, a page that can be
        turned and played and needs no renderer; runs/video/ROBOT-RUN.gif, unless given.
      episodes: numbers of the test's episodes, from 0 on, or of the starts of journeys through
        waypoints; 0 1 2 of the test, and one journey, unless given.
      waypoints: x and y of each, metres; starts are near the origin. Without any, the test's
        targets.
      goal_radius: metres; a waypoint is reached when the robot is this near. The test has its own.
      seed: of the test, or of the starts.
      seconds: an episode that is longer ends here.
      width: pixels of a picture; 320 in a gif, 640 in an mp4, unless given.
      height: pixels; 240 and 480, unless given.
      fps: pictures a second, at most 50 in a gif; 12.5 and 25, unless given.
      engine: "mjx" or "mujoco"; that of the run, unless given.

    Raises:
      BadInput: there is no such file, controller or visual model, or nothing to draw with.
    """
    if len(runs) != 1:
        raise BadInput(f"a video is of one run, not of {', '.join(map(str, runs)) or 'none'}")
    (run,) = runs
    paths = out or (Path("runs/video") / f"{run.resolve().parent.name}-{run.resolve().name}.gif",)
    given = {"width": width, "height": height, "fps": fps}
    changes: dict[str, Any] = {name: x for name, x in given.items() if x is not None}
    for path in paths:
        video.check(path, **changes)
    points = in_twos(waypoints) if waypoints else None
    made = video.render_run(run, episodes, points, seed, seconds, goal_radius, engine)
    for path in paths:
        video.write(made, path, **changes)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    run_cli(main, "Renders a saved controller.")
