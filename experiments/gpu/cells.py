"""Cells of Table 1: a tiny one that shows that all of it runs, and those of the paper's scale."""

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
from genidm.runs.resolve import Options
from genidm.runs.run import InverseDynamicsRun, Run
from genidm.store import Stage

# Interactions of the tiny cell: an off-policy learner makes its first updates before they end.
# The programs that collect are those of the paper's scale, and lie in the cache afterwards.
INTERACTIONS = 20_000
EPISODES = 2
TEST = EvaluationSettings(max_steps=40, chunk=10)
# An agent that has just begun falls before it has come farther.
GOAL_HORIZON = 5


def trial(robot: Robot) -> dict[str, Any]:
    """LR, end to end, at a tiny scale; seconds in all, and in XLA's compiler."""
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
      name: what is done in it.
      stage: name of its directory, or what stands for it in results.
      done: whether there is nothing to do.
      work: does it.
    """

    name: str
    stage: str
    done: bool
    work: Callable[[], Any]


def run(robot: Robot, method: str, options: Options, results: Results) -> dict[str, Any]:
    """A cell, part by part; each has a row while it is under way and when it is done.

    Args:
      robot: what is steered.
      method: by its name.
      options: scale and place.
      results: where the parts' rows go.

    Returns:
      what its test came to, and the seconds that its parts took, over all calls.
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
    """The parts of a cell, in the order that they need each other."""

    def part(name: str, stage: Stage, work: Callable[[], Any]) -> Part:
        return Part(name, stage.directory.name, stage.done, work)

    if isinstance(this, InverseDynamicsRun):
        share = this.method.fraction
        yield part("collecting", this.experience_stage, this.experience)
        if this.replay_stage:

            def again() -> Any:
                return this.replay(this.experience().first_fraction(share))

            yield part("𝒢", this.replay_stage, again)
    learning = part("learning", this.controller_stage, this.controller)
    yield learning
    # Its stage is known once it is done; to ask for it again costs nothing.
    yield Part("testing", f"test of {learning.stage}", False, lambda: this.run_test(scenarios))


def _do(results: Results, names: dict[str, Any], part: Part) -> None:
    """Does a part, unless it is done, and adds the seconds that it took to those before."""
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
    """What a test came to."""
    tree, _ = files.load_arrays(stage.path("episodes"))
    closest, fell = (np.asarray(tree["episodes"][name]) for name in ("closest", "fell"))
    return {
        "closest": round(float(closest.mean()), 4),
        "std": round(float(closest.std()), 4),
        "near": round(float((closest <= 0.25).mean()), 4),
        "falls": round(float(fell.mean()), 4),
        "episodes": closest.size,
    }
