"""Tests a saved controller again: `python -m experiments.evaluate runs/ant/LR-0-…`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from genidm import controller
from genidm.config import environment
from genidm.evaluate import Test, evaluate
from genidm.experiment import guarded
from genidm.report import Row, results, text
from genidm.scenarios import scenarios
from genidm.store import Stage


def main(
    run: Annotated[Path, tyro.conf.Positional],
    seeds: int = 10,
    episodes: int = 1000,
    first_seed: int = 0,
    test: Test = Test(),  # noqa: B008
) -> None:
    """The paper's test of one controller (A.1.3), on as many scenarios as you like.

    Args:
      run: directory of a fit (METHOD-SEED-…), as a cell leaves it under --out.
      seeds: test seeds.
      episodes: episodes a seed.
      first_seed: the first of the test seeds; another one gives unseen scenarios.
      test: settings of the test.
    """
    fitted = Stage(run).summary()
    model = controller.load(run)
    bank = scenarios(model.robot, seeds, episodes, first_seed)
    row = Row(
        method=fitted["method"],
        episodes=evaluate(model.robot, model, bank, test),
        interactions=fitted["interactions"],
        replayed=fitted["replayed"],
        settings=fitted["settings"],
    )
    written = results(
        [row], robot=model.robot.name, scale="test", scenarios=bank.digest(),
        environment=environment(),
    )  # fmt: skip
    print(text(written))


if __name__ == "__main__":
    guarded(main, "Tests a saved controller again.")
