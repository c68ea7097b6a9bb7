"""Tests saved controllers again: `python -m experiments.evaluate runs/ant/LR-0-…`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from genidm.evaluation import sanity
from genidm.evaluation.evaluate import EvaluationSettings, evaluate
from genidm.evaluation.scenarios import scenarios
from genidm.provenance import code_of, command, environment
from genidm.report import Row, origin, results, text
from genidm.runs.cell import saved
from genidm.runs.command import run_cli


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    seeds: int = 10,
    episodes: int = 1000,
    first_seed: int = 0,
    engine: str | None = None,
    test: EvaluationSettings = EvaluationSettings(),
) -> None:
    """The paper's test (A.1.3) of controllers, on as many scenarios as you like; keeps nothing.

    Args:
      runs: directories of fits or baselines (METHOD-SEED-…), as cells leave them under --run-dir.
      seeds: test seeds.
      episodes: episodes a seed.
      first_seed: the first of the test seeds; another one gives unseen scenarios.
      engine: "mjx" or "mujoco"; MJX on an accelerator, MuJoCo in C on a CPU, unless given.
      test: settings of the test.

    Raises:
      BadInput: runs of different robots, or none.
    """
    robot, models = saved(runs, engine)
    test_scenarios, rows = scenarios(robot, seeds, episodes, first_seed), []
    here = {**environment(), "command": command()}
    tested = origin(code_of("genidm.evaluation.evaluate", robot, robot.engine), [here])
    for name, (model, fitted) in models.items():
        outcome = evaluate(robot, model, test_scenarios, test)
        sanity.walked(name, outcome)
        told = {key: fitted[key] for key in ("interactions", "replayed", "settings")}
        rows.append(Row(method=name, episodes=outcome, made={"test": tested}, **told))
    written = results(
        rows,
        robot=robot.name,
        engine=robot.engine,
        scale="test",
        scenarios=test_scenarios.digest(),
    )
    print(text(written))


if __name__ == "__main__":
    run_cli(main, "Tests saved controllers again.")
