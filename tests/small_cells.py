"""Cells on a point, at a size that a test can wait for, and what they leave."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from point import Point
from tiny import TEST, tiny

from genidm.evaluation.scenarios import Scenarios, scenarios
from genidm.paper import methods
from genidm.paper.methods import InverseDynamics, Method
from genidm.runs import command as command_module
from genidm.runs import fitting, recording
from genidm.runs import run as run_module
from genidm.runs.cell import make_run, run_method
from genidm.runs.resolve import Options


def small(method: InverseDynamics) -> InverseDynamics:
    """Tiny, with updates enough to be killed among."""
    fit = dataclasses.replace(
        tiny(method).fit, updates=2500, latent_size=method.fit.latent_size and 2
    )
    return tiny(method, goal_horizon=10, fit=fit)


RS, GE, LR = (small(m) for m in (methods.RS, methods.GE, methods.LR))
VGCP, HER_SP = (tiny(m) for m in (methods.VGCP, methods.HER_SP))


def options(out: Path, **changes) -> Options:
    return dataclasses.replace(Options(scale="0.5", run_dir=out, episodes=2, test=TEST), **changes)


STAGES = {"collect": recording, "replay": fitting, "fit": fitting, "run": run_module}


@contextlib.contextmanager
def counted() -> Iterator[Counter]:
    """Which stages' work is done meanwhile, and how often."""
    calls: Counter = Counter()

    def counting(name: str, work: Callable) -> Callable:
        def counted(*args, **kwargs):
            calls[name] += 1
            return work(*args, **kwargs)

        return counted

    with pytest.MonkeyPatch.context() as m:
        for name, module in STAGES.items():
            m.setattr(module, name, counting(name, getattr(module, name)))
        yield calls


@dataclasses.dataclass
class Finished:
    """Runs of cells, one after another, what each of them had to do, and their report."""

    out: Path
    report: Path
    done: list[Counter]

    @property
    def results(self) -> dict:
        return json.loads((self.report / "results.json").read_text())


def finish(out: Path, *of: Method) -> Finished:
    """Runs the cells of these methods in one place; they share what they can."""
    done = []
    for method in of:
        with counted() as calls:
            if method is of[-1]:
                report = run_method(Point(), method, options(out))
            else:
                make_run(Point(), method, options(out)).run_test(tested_scenarios("point", 10, 2))
        done.append(calls)
    return Finished(out, report, done)


@functools.cache
def tested_scenarios(name: str, *numbers: int) -> Scenarios:
    """Scenarios are drawn once for all cells: they see the robot and two numbers alone."""
    return scenarios(Point(), *numbers)


def files(directory: Path) -> dict[str, bytes]:
    paths = (p for p in sorted(directory.rglob("*")) if p.is_file())
    return {str(p.relative_to(directory)): p.read_bytes() for p in paths}


def arrays(stage: Path) -> dict[str, bytes]:
    return {n: x for n, x in files(stage).items() if n.endswith(".npy") and "checkpoint" not in n}


def stage_of(out: Path, name: str) -> Path:
    return next((out / "point").glob(f"{name}-*"))


def command(out: Path, *flags: str, robot: type[Point] = Point, method: Method = LR) -> None:
    """The command line of a cell, at the scale of these tests."""
    test = ("--test.max-steps", "40", "--test.num-envs", "16", "--test.chunk", "10")
    start = ("cell", "--scale", "0.5", "--episodes", "2", "--run-dir", str(out), *test)
    with pytest.MonkeyPatch.context() as m:
        m.setattr(sys, "argv", [*start, *flags])
        command_module.main(robot, method)
