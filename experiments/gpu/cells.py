"""Cells of Table 1 (a method on a robot): a tiny one as a test, and those of the paper's scale."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.benchmark.starting import compiling
from experiments.gpu.results import Results
from genidm import files
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.scenarios import Scenarios
from genidm.paper.methods import InverseDynamics, by_name
from genidm.robots import Robot
from genidm.runs.cell import make_run, run_method, scenarios_of
from genidm.runs.fitting import InverseDynamicsRun
from genidm.runs.resolve import Options
from genidm.runs.run import Run
from genidm.store import Stage

# Interactions of the tiny cell: enough for the first updates of an off-policy learner. It compiles
# the same collecting programs as the paper's scale, and so fills the cache.
INTERACTIONS = 20_000
EPISODES = 2
TEST = EvaluationSettings(max_steps=40, chunk=10)
# Steps; an agent that has learned so little falls early.
GOAL_HORIZON = 5


def trial(robot: Robot) -> dict[str, Any]:
    """Runs LR end to end at a tiny scale; returns the seconds in total and of compilation."""
    method = by_name("LR", robot.name)
    assert isinstance(method, InverseDynamics)
    method = dataclasses.replace(method, goal_horizon=GOAL_HORIZON)
    with tempfile.TemporaryDirectory(prefix="genidm-") as out, compiling() as counted:
        scale = str(INTERACTIONS / robot.paper_interactions)
        options = Options(scale=scale, run_dir=Path(out), episodes=EPISODES, test=TEST)
        print((run_method(robot, method, options) / "table.txt").read_text(encoding="utf-8"))
    return {"seconds": round(counted["wall"], 1), "compiling": round(counted["seconds"], 1)}


class Part(NamedTuple):
    """A part of a cell.

    Attributes:
      name: name of the work.
      stage: name of its directory, or a substitute for it in the results.
      done: whether the part is finished.
      work: does the part.
    """

    name: str
    stage: str
    done: bool
    work: Callable[[], Any]


def run(robot: Robot, method: str, options: Options, results: Results) -> dict[str, Any]:
    """Runs a cell part by part; each part has a row while it runs and when it is done.

    Args:
      robot: the robot.
      method: name of the method.
      options: scale and directory of the run.
      results: where the rows of the parts are written.

    Returns:
      the results of the test, and the seconds of all parts over all calls.
    """
    this = make_run(robot, by_name(method, robot.name), options)
    scenarios = scenarios_of(this, options)
    parts = list(_parts(this, scenarios))
    for part in parts:
        _do(results, {"robot": robot.name, "method": method}, part)
    rows = (results.find("stages", {"robot": robot.name, "stage": p.stage}) for p in parts)
    seconds = sum(row["seconds"] for row in rows if row)
    return _outcome(this.run_test(scenarios)) | {"seconds": round(seconds, 1)}


def _parts(this: Run[Any], scenarios: Scenarios) -> Iterator[Part]:
    """Yields the parts of a cell; each depends on those before it."""

    def part(name: str, stage: Stage, work: Callable[[], Any]) -> Part:
        return Part(name, stage.directory.name, stage.done, work)

    if isinstance(this, InverseDynamicsRun):
        share = this.method.fraction
        yield part("collecting", this.experience_stage, this.experience)
        if this.replay_stage:

            def again() -> Any:
                return this.replay(this.experience().part(share))

            yield part("𝒢", this.replay_stage, again)
    learning = part("learning", this.controller_stage, this.controller)
    yield learning
    # The test's stage skips its work if it is done, so `done` may always be False here.
    yield Part("testing", f"test of {learning.stage}", False, lambda: this.run_test(scenarios))


def _do(results: Results, names: dict[str, Any], part: Part) -> None:
    """Does a part, unless it is done, and adds its seconds to those of earlier calls."""
    if part.done:
        return
    row = names | {"stage": part.stage, "part": part.name}
    before = (results.find("stages", row) or {"seconds": 0.0})["seconds"]
    results.put("stages", row | {"done": False, "seconds": before, "began": time.time()})
    began = time.perf_counter()
    part.work()
    seconds = round(before + time.perf_counter() - began, 1)
    results.put("stages", row | {"done": True, "seconds": seconds})


def _outcome(stage: Stage) -> dict[str, Any]:
    """The results of a test: distances in metres, fractions of episodes."""
    tree, _ = files.load_arrays(stage.path("episodes"))
    closest, fell = (np.asarray(tree["episodes"][name]) for name in ("closest", "fell"))
    return {
        "closest": round(float(closest.mean()), 4),
        "std": round(float(closest.std()), 4),
        "near": round(float((closest <= 0.25).mean()), 4),
        "falls": round(float(fell.mean()), 4),
        "episodes": closest.size,
    }
