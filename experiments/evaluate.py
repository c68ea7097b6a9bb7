"""Tests saved controllers again: `python -m experiments.evaluate runs/ant/LR-0-…`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from genidm.config import environment
from genidm.evaluate import Test, evaluate
from genidm.experiment import guarded, saved
from genidm.report import Row, results, text
from genidm.scenarios import scenarios


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    seeds: int = 10,
    episodes: int = 1000,
    first_seed: int = 0,
    engine: str | None = None,
    test: Test = Test(),
) -> None:
    """The paper's test (A.1.3) of controllers, on as many scenarios as you like; keeps nothing.

    Args:
      runs: directories of fits or baselines (METHOD-SEED-…), as cells leave them under --out.
      seeds: test seeds.
      episodes: episodes a seed.
      first_seed: the first of the test seeds; another one gives unseen scenarios.
      engine: "mjx" or "mujoco"; MJX on an accelerator, MuJoCo in C on a CPU, unless given.
      test: settings of the test.

    Raises:
      BadInput: runs of different robots, or none.
    """
    robot, models = saved(runs, engine)
    bank = scenarios(robot, seeds, episodes, first_seed)
    rows = [
        Row(
            method=name,
            episodes=evaluate(robot, model, bank, test),
            interactions=fitted["interactions"],
            replayed=fitted["replayed"],
            settings=fitted["settings"],
        )
        for name, (model, fitted) in models.items()
    ]
    written = results(
        rows,
        robot=robot.name,
        engine=robot.engine,
        scale="test",
        scenarios=bank.digest(),
        environment=environment(),
    )
    print(text(written))


if __name__ == "__main__":
    guarded(main, "Tests saved controllers again.")
