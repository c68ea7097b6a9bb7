"""The command line: `python -m experiments.benchmark`."""

from __future__ import annotations

import contextlib
from typing import Annotated, Any

import jax
import tyro

from experiments.benchmark.bench import Bench, Options
from experiments.benchmark.comparing import measure, table
from experiments.benchmark.evaluating import controller
from experiments.benchmark.rows import choose
from genidm import files
from genidm.errors import BadInput
from genidm.experiment import guarded
from genidm.robots import Ant, Robot


def benchmark(robot: Robot, options: Options) -> list[dict[str, Any]]:
    """Measures the rows, and writes them.

    Raises:
      BadInput: unknown rows, lanes that the devices cannot share, a run that is none, or a
        place that cannot be written.
    """
    rows = choose(options.rows)
    for lanes in (options.lanes, options.wide):
        if lanes % jax.device_count():
            raise BadInput(f"{lanes} lanes cannot be shared among {jax.device_count()} devices")
    with files.disk(options.out):  # before the measuring, not after it
        if options.out.is_dir():
            raise BadInput(f"{options.out} is a directory")
        options.out.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as exits:
        bench = Bench(robot, options, exits)
        if options.run:
            bench.once(controller)
        results = measure(bench, rows)
    files.save_json(options.out, results)
    return results


def main() -> None:
    """The command line."""

    def command(
        options: Annotated[Options, tyro.conf.arg(name="")] = Options(),  # noqa: B008
    ) -> None:
        print(table(benchmark(Ant(), options)))

    guarded(command, "How fast everything is, as ratios to what limits it.")


if __name__ == "__main__":
    main()
