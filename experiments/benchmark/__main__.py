"""The command line: `python -m experiments.benchmark`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.benchmark.bench import Bench, Options
from experiments.benchmark.comparing import measure, table
from experiments.benchmark.evaluating import controller
from experiments.benchmark.rows import OTHERS, ROWS, choose
from genidm import files
from genidm.errors import BadInput
from genidm.robots import Robot, by_name
from genidm.robots.mujoco import MujocoRobot
from genidm.runs.command import run_cli


def benchmark(robot: Robot, options: Options) -> list[dict[str, Any]]:
    """Measures the rows and writes them.

    Raises:
      BadInput: a row is unknown, the devices cannot share the lanes equally, the run is
        invalid, or the file cannot be written.
    """
    if robot.name not in ROWS and not isinstance(robot, MujocoRobot):
        raise BadInput(
            f"the benchmark has rows for robots with a MuJoCo model, not for {robot.name}"
        )
    rows, out = choose(options.rows, ROWS.get(robot.name, OTHERS)), place(robot, options)
    for lanes in (options.num_envs, options.wide):
        if lanes % robot.mesh().size:
            raise BadInput(f"{lanes} lanes cannot be shared among {robot.mesh().size} devices")
    with files.disk(out):  # a bad path must fail before the measurement
        if out.is_dir():
            raise BadInput(f"{out} is a directory")
        out.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as exits:
        bench = Bench(robot, options, exits)
        if options.run:
            bench.once(controller)
        results = measure(bench, rows)
    files.save_json(out, results)
    return results


def place(robot: Robot, options: Options) -> Path:
    """Path of the JSON file of the rows."""
    return Path(options.out or f"experiments/results/{robot.name}_benchmark.json")


def main() -> None:
    """The command line."""

    def command(
        options: Annotated[Options, tyro.conf.arg(name="")] = Options(),
    ) -> None:
        print(table(benchmark(by_name(options.robot, options.engine), options)))

    run_cli(command, "Measures the speed of every part, with its ratio to a limit or a reference.")


if __name__ == "__main__":
    main()
