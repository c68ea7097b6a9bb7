"""What child processes do: `python -m experiments.gpu.jobs JSON`, a `Job` in JSON."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from experiments.gpu import cells, children, speeds
from experiments.gpu.results import Results, Row
from genidm import devices
from genidm.engines import ENGINES, choose
from genidm.paper.methods import by_name
from genidm.provenance import environment
from genidm.robots import ROBOTS, Robot
from genidm.robots import by_name as robot_by_name
from genidm.runs.cell import make_run, scenarios_of, write_report
from genidm.runs.resolve import Options


@dataclasses.dataclass(frozen=True)
class Job:
    """A part of a call that a child does.

    Attributes:
      part: its name in `PARTS`.
      results_dir: where the results lie.
      run_dir: where the stages of the cells lie.
      robot: by its name.
      engine: by its name; in `look` the one that is chosen where jax runs, unless given.
      method: of a cell, by its name.
      scale: of a cell.
      minutes: that the whole call was given.
      seconds: that this part is given.
      again: measure what was measured before, too.
    """

    part: str
    results_dir: str
    run_dir: str
    robot: str = ""
    engine: str | None = None
    method: str | None = None
    scale: str = "paper"
    minutes: float = 0.0
    seconds: float = 0.0
    again: bool = False

    @property
    def stepper(self) -> str:
        """Name of the engine that steps the robot: the one asked for, if it can."""
        offered = ROBOTS[self.robot].engines
        asked = self.engine
        return asked if asked is not None and asked in offered else next(iter(offered), "its own")

    def made(self) -> Robot:
        """The robot, on its engine."""
        offered = ROBOTS[self.robot].engines
        return robot_by_name(self.robot, self.stepper if offered else None)

    @property
    def results(self) -> Results:
        """Where the results lie."""
        return Results(Path(self.results_dir))

    @property
    def options(self) -> Options:
        """Of a cell."""
        return Options(scale=self.scale, run_dir=Path(self.run_dir))

    @property
    def names(self) -> dict[str, Any]:
        """What names the rows of its robot, engine and cell."""
        return dict(robot=self.robot, engine=self.stepper, method=self.method, scale=self.scale)


def look(job: Job) -> None:
    """Writes down where this runs."""
    here, first = environment(), jax.devices()[0]
    # Where only the files were brought, and no repository.
    here["commit"] = here["commit"] or os.environ.get("GENIDM_COMMIT")
    kind = f"{jax.device_count()} × {first.device_kind}"
    machine = here["hardware"] if first.platform == "cpu" else kind
    found = {"devices": [str(x) for x in jax.devices()], "platform": first.platform,
             "memory_bytes": devices.memory(), "cores": devices.cores()}  # fmt: skip
    print(f"{here['hardware']}; jax {jax.__version__} on {kind}")
    engine = job.engine or choose(None, list(ENGINES), "robots")
    call = {"minutes": job.minutes, "engine": engine, "environment": here, **found}
    job.results.begin(machine, call)


def trial(job: Job) -> None:
    """LR at a tiny scale."""
    job.results.put("trials", {"robot": job.robot, "engine": job.stepper} | cells.trial(job.made()))


def measure(job: Job) -> None:
    """Steps a second, by number of lanes."""
    results = job.results

    def known(names: Row) -> Row | None:
        old = job.again or not results.current("speeds", names)
        return None if old else results.find("speeds", names)

    def save(row: Row) -> None:
        results.put("speeds", row)

    if speeds.Measuring(job.made(), job.stepper, job.seconds, known, save).run():
        results.put("measured", {"robot": job.robot, "engine": job.stepper})


def run_cell(job: Job) -> None:
    """A cell of Table 1, as far as it gets."""
    assert job.method
    outcome = cells.run(job.made(), job.method, job.options, job.results)
    job.results.put("cells", job.names | outcome)


def report(job: Job) -> None:
    """The table of all cells that have ended."""
    robot = job.made()
    assert job.method
    this = make_run(robot, by_name(job.method, robot.name), job.options)
    place = write_report(this, scenarios_of(this, job.options), job.options)
    print((place / "table.txt").read_text(encoding="utf-8"))
    names = dict(robot=job.robot, engine=job.stepper, scale=job.scale)
    job.results.put("reports", names | {"place": str(place)})


PARTS: dict[str, Callable[[Job], None]] = {
    "look": look,
    "trial": trial,
    "speeds": measure,
    "cell": run_cell,
    "report": report,
}
"""Name of a part → what does it."""


def start(job: Job, seconds: float) -> children.Ended:
    """Does a job in a child, for at most so many seconds."""
    text = json.dumps(dataclasses.asdict(dataclasses.replace(job, seconds=seconds)))
    return children.run([sys.executable, "-m", __spec__.name, text], seconds)


def main() -> None:
    """Does the job that the command line names."""
    job = Job(**json.loads(sys.argv[1]))
    # If it is not stopped from outside, because nobody is there any more.
    children.end_after(job.seconds + 2 * children.GRACE)
    PARTS[job.part](job)


if __name__ == "__main__":
    main()
