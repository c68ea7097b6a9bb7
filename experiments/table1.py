"""All of Table 1 for one robot: `python -m experiments.table1 --robot ant`."""

from __future__ import annotations

import dataclasses
import itertools
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from genidm.checks import check, count
from genidm.errors import BadInput
from genidm.evaluation.scenarios import Scenarios
from genidm.offline.methods import AnyMethod, by_name
from genidm.paper.methods import EXTRA, ORDER, InverseDynamics
from genidm.robots import Robot
from genidm.robots import by_name as robot_by_name
from genidm.runs.cell import announce, make_run, render_run, scenarios_of, write_report
from genidm.runs.command import run_cli
from genidm.runs.resolve import Options
from genidm.runs.run import Run
from genidm.store import Stage

Methods = Sequence[AnyMethod]
MakeRun = Callable[[Robot, AnyMethod, Options], Run[Any]]


@dataclasses.dataclass(frozen=True)
class Table(Options):
    """Settings of the whole table.

    Attributes:
      robot: ant, humanoid, humanoid_world or minitaur.
      methods: the methods to run; the table also shows finished runs of other methods under
        `run_dir`.
      include_hf: whether to run HF, which the paper does not have.
      seeds: number of training seeds, from `seed`. The first makes the rows; the column "over
        seeds" shows the spread over all.
      episodes_per_extra_seed: test episodes per test seed, for all training seeds but the first.
    """

    robot: str = "ant"
    methods: tuple[str, ...] = ORDER
    include_hf: bool = True
    seeds: int = 1
    episodes_per_extra_seed: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, seeds=count(), episodes_per_extra_seed=count())


def chosen(options: Table) -> list[AnyMethod]:
    """The methods to run, without duplicates.

    Raises:
      BadInput: a method is unknown, or none is left.
    """
    rows = [by_name(name, options.robot) for name in dict.fromkeys(options.methods)]
    rows = rows if options.include_hf else [row for row in rows if row.name not in EXTRA]
    if not rows:
        raise BadInput(f"no method to run; choose from {', '.join(ORDER)}")
    return rows


def grouped(methods: Methods) -> list[AnyMethod]:
    """Sorts methods so that those with the same experience follow each other."""
    sources = [(method.agent, method.task) for method in methods]
    return sorted(methods, key=lambda method: sources.index((method.agent, method.task)))


@dataclasses.dataclass(frozen=True)
class Work:
    """A run and its test scenarios.

    Attributes:
      run: the run.
      scenarios: the scenarios of its test.
      whole: the scenarios of the table's rows. If the run is already tested on them, that test is
        used, so that the table does not depend on the order of commands.
    """

    run: Run[Any]
    scenarios: Scenarios
    whole: Scenarios

    def execute(self) -> Stage:
        """Runs whatever is not finished, up to the test; returns the stage of the test."""
        done = self.run.test_stage(self.whole).done
        return self.run.run_test(self.whole if done else self.scenarios)

    def __str__(self) -> str:
        return f"{self.run.method.name}, training seed {self.run.seed}"


def work(robot: Robot, methods: Methods, options: Table, make: MakeRun = make_run) -> list[Work]:
    """The runs of the table, seed by seed; later seeds use only the first scenarios."""
    numbers = range(options.seed, options.seed + options.seeds)
    seeds = [dataclasses.replace(options, seed=seed) for seed in numbers]
    first, *later = (
        [make(robot, m, _options_of(m, these)) for m in grouped(methods)] for these in seeds
    )
    scenarios = few = scenarios_of(first[0], options)
    if later and options.episodes_per_extra_seed < scenarios.shape[1]:
        few = scenarios_of(
            first[0], dataclasses.replace(options, episodes=options.episodes_per_extra_seed)
        )
    rest = itertools.chain(*later)
    return [
        *(Work(this, scenarios, scenarios) for this in first),
        *(Work(this, few, scenarios) for this in rest),
    ]


def _options_of(method: AnyMethod, options: Table) -> Table:
    """`options`; `paper_settings` is only for methods that fit, the others are the paper's."""
    fits = isinstance(method, InverseDynamics)
    return dataclasses.replace(options, paper_settings=options.paper_settings and fits)


def run(
    robot: Robot, methods: Methods, options: Table, make: MakeRun = make_run
) -> tuple[Path | None, list[Exception]]:
    """Runs every cell that is not finished, then writes one table of all.

    If a cell fails, the others still run.

    Args:
      robot: the robot.
      methods: the methods, in any order.
      options: settings of the table.
      make: makes the run of a method.

    Returns:
      the directory of the report, or None if every cell on the table's own scenarios failed; and
      the errors of the cells that failed.

    Raises:
      BadInput: an option is invalid; then nothing has run.
    """
    todo = work(robot, methods, options, make)
    announce(robot, options.engine)
    failures, tests, ended, first = list[Exception](), list[Stage](), False, todo[0]
    for number, item in enumerate(todo, 1):
        print(f"{item} ({number} of {len(todo)})", file=sys.stderr)
        made = attempt(item)
        if isinstance(made, Exception):
            failures.append(made)
            continue
        tests.append(made)
        if item.scenarios is first.scenarios:
            ended = True
            if options.video:
                render_run(item.run)
    report = write_report(first.run, first.scenarios, options, tests) if ended else None
    return report, failures


def attempt(item: Work) -> Stage | Exception:
    """Runs a cell; returns its finished test, or its error after printing it to stderr."""
    try:
        return item.execute()
    except BadInput as error:
        print(f"error: {item}: {error}", file=sys.stderr)
        return error
    except Exception as error:  # any error: the other cells do not depend on this one
        traceback.print_exc()
        print(f"error: {item} failed", file=sys.stderr)
        return error


def main(options: Annotated[Table, tyro.conf.arg(name="")] = Table()) -> None:
    """Runs the cells and prints the table; the exit status is not 0 if a cell failed."""
    table1(options)


def table1(options: Table, make: MakeRun = make_run) -> None:
    """`main`, with runs that `make` makes."""
    robot = robot_by_name(options.robot, options.engine)
    report, failures = run(robot, chosen(options), options, make)
    if report:
        print((report / "table.txt").read_text(encoding="utf-8"))
    if failures:
        print(f"error: cells that failed: {len(failures)}; see above", file=sys.stderr)
        sys.exit(2 if all(isinstance(error, BadInput) for error in failures) else 1)


if __name__ == "__main__":
    run_cli(main, "Table 1: every method on one robot, and the spread over training seeds.")
