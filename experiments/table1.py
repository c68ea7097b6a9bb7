"""Table 1, all of it: `python -m experiments.table1 --robot ant`."""

from __future__ import annotations

import dataclasses
import itertools
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from genidm.checks import check, count
from genidm.errors import BadInput
from genidm.evaluation.scenarios import Scenarios
from genidm.paper.methods import EXTRA, ORDER, GoalConditioned, InverseDynamics, by_name
from genidm.robots import Robot
from genidm.robots import by_name as robot_by_name
from genidm.runs.cell import announce, make_run, render_run, scenarios_of, write_report
from genidm.runs.command import run_cli
from genidm.runs.resolve import Options
from genidm.runs.run import Run
from genidm.store import Stage

Methods = Sequence[GoalConditioned | InverseDynamics]


@dataclasses.dataclass(frozen=True)
class Table(Options):
    """What the whole table takes.

    Attributes:
      robot: ant, humanoid, humanoid_world or minitaur.
      methods: the rows to make; what lies under `run_dir` already stands in the table, too.
      include_hf: also the rows that the paper does not have (HF); off, they are left out.
      seeds: how many training seeds, from `seed` on. The first makes the rows; the spread
        over all of them stands beside.
      episodes_per_extra_seed: test episodes a test seed with the later training seeds.
    """

    robot: str = "ant"
    methods: tuple[str, ...] = ORDER
    include_hf: bool = True
    seeds: int = 1
    episodes_per_extra_seed: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, seeds=count(), episodes_per_extra_seed=count())


def chosen(options: Table) -> list[GoalConditioned | InverseDynamics]:
    """The methods that a user named.

    Raises:
      BadInput: there is no such method, or none is left.
    """
    rows = [by_name(name, options.robot) for name in dict.fromkeys(options.methods)]
    rows = rows if options.include_hf else [row for row in rows if row.name not in EXTRA]
    if not rows:
        raise BadInput(f"no method to run; there are: {', '.join(ORDER)}")
    return rows


def grouped(methods: Methods) -> list[GoalConditioned | InverseDynamics]:
    """Methods that learn from one agent's experience together: it is collected by the first."""
    sources = [(method.agent, method.task) for method in methods]
    return sorted(methods, key=lambda method: sources.index((method.agent, method.task)))


@dataclasses.dataclass(frozen=True)
class Work:
    """A cell to run, and what it is tested on.

    Attributes:
      run: what is run.
      scenarios: the scenarios of its test.
      whole: those of the table's rows. Where the cell has been tested on them already, that
        test stands, so that a table does not depend on which command came first.
    """

    run: Run[Any]
    scenarios: Scenarios
    whole: Scenarios

    def execute(self) -> Stage:
        """The finished test."""
        done = self.run.test_stage(self.whole).done
        return self.run.run_test(self.whole if done else self.scenarios)

    def __str__(self) -> str:
        return f"{self.run.method.name}, training seed {self.run.seed}"


def work(robot: Robot, methods: Methods, options: Table) -> list[Work]:
    """The cells of the table, seed by seed; the later ones on the first of the scenarios."""
    numbers = range(options.seed, options.seed + options.seeds)
    seeds = [dataclasses.replace(options, seed=seed) for seed in numbers]
    first, *later = ([make_run(robot, m, these) for m in grouped(methods)] for these in seeds)
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


def run(robot: Robot, methods: Methods, options: Table) -> tuple[Path | None, list[Exception]]:
    """Runs every cell that is not done, then writes one table of all.

    A cell that fails does not keep the others from running.

    Args:
      robot: whose table it is.
      methods: its rows, in any order.
      options: scale, seeds, places.

    Returns:
      the directory of the report, or None where no cell on the table's own scenarios ended;
      and what the cells that did not end failed with.

    Raises:
      BadInput: an option cannot be; nothing has been run then.
    """
    todo = work(robot, methods, options)
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
    """Runs a cell to its end; or what it failed with, once that is said on stderr."""
    try:
        return item.execute()
    except BadInput as error:
        print(f"error: {item}: {error}", file=sys.stderr)
        return error
    except Exception as error:  # of whatever kind: the other cells do not depend on it
        traceback.print_exc()
        print(f"error: {item} failed", file=sys.stderr)
        return error


def table1(options: Annotated[Table, tyro.conf.arg(name="")] = Table()) -> None:
    """Runs the cells and prints the table; a cell that failed shows in the exit status."""
    robot = robot_by_name(options.robot, options.engine)
    report, failures = run(robot, chosen(options), options)
    if report:
        print((report / "table.txt").read_text(encoding="utf-8"))
    if failures:
        print(f"error: {len(failures)} cells did not end; see above", file=sys.stderr)
        sys.exit(2 if all(isinstance(error, BadInput) for error in failures) else 1)


if __name__ == "__main__":
    run_cli(table1, "Table 1: every method on one robot, and the spread over training seeds.")
