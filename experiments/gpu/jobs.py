"""The work of a child process: `python -m experiments.gpu.jobs JSON`, where JSON is a `Job`."""

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
    """A part of a call, which one child does.

    Attributes:
      part: name of the part in `PARTS`.
      results_dir: directory of the results.
      run_dir: directory of the runs.
      robot: name of the robot.
      engine: name of the engine; if None, `look` chooses it from jax's device.
      method: name of the method of a cell.
      scale: scale of a cell.
      minutes: time limit of the whole call.
      seconds: time limit of this part.
      again: also repeat measurements that are already there.
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
        """Name of the engine that steps the robot: `engine` if the robot has it, else its first."""
        offered = ROBOTS[self.robot].engines
        asked = self.engine
        return asked if asked is not None and asked in offered else next(iter(offered), "its own")

    def made(self) -> Robot:
        """The robot on its engine."""
        offered = ROBOTS[self.robot].engines
        return robot_by_name(self.robot, self.stepper if offered else None)

    @property
    def results(self) -> Results:
        """The results of all calls."""
        return Results(Path(self.results_dir))

    @property
    def options(self) -> Options:
        """Options of a cell's run."""
        return Options(scale=self.scale, run_dir=Path(self.run_dir))

    @property
    def names(self) -> dict[str, Any]:
        """The fields that identify result rows of this job."""
        return dict(robot=self.robot, engine=self.stepper, method=self.method, scale=self.scale)


def look(job: Job) -> None:
    """Writes down machine, versions and engine; begins the call in the results."""
    here, first = environment(), jax.devices()[0]
    # On a machine that has the files but no git repository.
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
    """Runs LR at a tiny scale."""
    job.results.put("trials", {"robot": job.robot, "engine": job.stepper} | cells.trial(job.made()))


def measure(job: Job) -> None:
    """Measures steps per second by number of lanes."""
    results = job.results

    def known(names: Row) -> Row | None:
        old = job.again or not results.current("speeds", names)
        return None if old else results.find("speeds", names)

    def save(row: Row) -> None:
        results.put("speeds", row)

    if speeds.Measuring(job.made(), job.stepper, job.seconds, known, save).run():
        results.put("measured", {"robot": job.robot, "engine": job.stepper})


def run_cell(job: Job) -> None:
    """Runs a cell of Table 1."""
    assert job.method
    outcome = cells.run(job.made(), job.method, job.options, job.results)
    job.results.put("cells", job.names | outcome)


def report(job: Job) -> None:
    """Writes and prints the table of all finished cells."""
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
"""Name of a part → the function that does it."""


def start(job: Job, seconds: float) -> children.Ended:
    """Does a job in a child, with a time limit in seconds."""
    text = json.dumps(dataclasses.asdict(dataclasses.replace(job, seconds=seconds)))
    return children.run([sys.executable, "-m", __spec__.name, text], seconds)


def main() -> None:
    """Does the job that the command line names."""
    job = Job(**json.loads(sys.argv[1]))
    # In case the parent has ended and cannot stop this process.
    children.end_after(job.seconds + 2 * children.GRACE)
    PARTS[job.part](job)


if __name__ == "__main__":
    main()
