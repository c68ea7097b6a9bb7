"""Tests saved controllers: `python -m experiments.evaluate runs/ant/LR-0-…`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from genidm.evaluation import sanity
from genidm.evaluation.evaluate import EvaluationSettings, evaluate
from genidm.evaluation.scenarios import scenarios
from genidm.report import Row, results, text
from genidm.report.rows import origin_now
from genidm.runs.cell import load_runs
from genidm.runs.command import run_cli
from genidm.runs.run import TEST


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    seeds: int = 10,
    episodes: int = 1000,
    first_seed: int = 0,
    engine: str | None = None,
    test: EvaluationSettings = EvaluationSettings(),
) -> None:
    """Tests controllers as in the paper (A.1.3), prints a table, and writes no files.

    Args:
      runs: directories of fits or baselines (METHOD-SEED-…) under --run-dir.
      seeds: number of test seeds.
      episodes: episodes per test seed.
      first_seed: the first test seed; another value gives unseen scenarios.
      engine: "mjx" or "mujoco"; default: MJX on an accelerator, MuJoCo in C on a CPU.
      test: settings of the test.

    Raises:
      BadInput: no runs, or runs of different robots.
    """
    robot, models = load_runs(runs, engine)
    test_scenarios, rows = scenarios(robot, seeds, episodes, first_seed), []
    tested = origin_now(*TEST, robot, robot.engine)
    for name, (model, fitted) in models.items():
        outcome = evaluate(robot, model, test_scenarios, test)
        sanity.walked(name, outcome)
        reported = {key: fitted[key] for key in ("interactions", "replayed", "settings")}
        rows.append(Row(method=name, episodes=outcome, made={"test": tested}, **reported))
    written = results(
        rows,
        robot=robot.name,
        engine=robot.engine,
        scale="test",
        scenarios=test_scenarios.digest(),
    )
    print(text(written))


if __name__ == "__main__":
    run_cli(main, "Tests saved controllers.")
