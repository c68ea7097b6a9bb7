"""LR with the settings of the author's code, in its own test: `python -m experiments.authors`.

One row: gym's Ant-v2, 𝒢 by whole episodes, the author's networks and losses, and targets in a box
of which no reaching ends an episode. docs/authors.md compares it with the paper and with our LR.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from genidm.checks import check, count, positive
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.scenarios import BOX_EPISODES, box_scenarios
from genidm.paper import protocol
from genidm.paper.author import EPOCHS, author_settings
from genidm.paper.methods import LR, InverseDynamics
from genidm.paper.protocol import FRACTION
from genidm.robots import AntV2, Robot
from genidm.runs.cell import announce, make_run, print_notes, render_run, write_report
from genidm.runs.command import run_cli
from genidm.runs.resolve import Options


@dataclasses.dataclass(frozen=True)
class Authors(Options):
    """Settings of the row.

    Attributes:
      episodes: test episodes per test seed.
      test: settings of the test; with a goal radius of 0, reaching ends no episode.
      epochs: passes over the pairs.
      fraction: fraction of the record, from its start, that makes the pairs. The paper's is 0.5
        (1 M pairs). The default arguments of the author's code read half as many.
    """

    episodes: int | None = BOX_EPISODES
    test: EvaluationSettings = dataclasses.field(
        default_factory=lambda: EvaluationSettings(goal_radius=0.0)
    )
    epochs: int = EPOCHS
    fraction: float = FRACTION["LR"]

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, epochs=count(), fraction=positive(1))
        if self.paper_settings:
            raise BadInput("the author's settings contain --paper-settings: leave it out")


def row(robot: Robot, method: InverseDynamics, options: Authors) -> InverseDynamics:
    """The method of the row; its name has the settings that are not the author's."""
    chosen = author_settings(method, robot, options.epochs, options.fraction)
    own = {"epochs": (options.epochs, EPOCHS), "fraction": (options.fraction, FRACTION["LR"])}
    named = [f" {name} {value:g}" for name, (value, usual) in own.items() if value != usual]
    return dataclasses.replace(chosen, name="".join([chosen.name, *named]))


def run(robot: Robot, method: InverseDynamics, options: Authors) -> Path:
    """Runs whatever is not finished, up to the test.

    Returns:
      the directory of the report, which covers all rows with this test under `options.run_dir`.
    """
    this = make_run(robot, row(robot, method, options), options)
    announce(robot, options.engine)
    print_notes(this.notes)
    tested = box_scenarios(robot, this.scale.seeds, options.episodes or BOX_EPISODES)
    stage = this.run_test(tested)
    if options.video:
        render_run(this)
    return write_report(this, tested, options, [stage])


def beside_the_paper() -> str:
    """The paper's number, for the end of the table."""
    mean, std = protocol.TABLE1["ant"]["LR"]
    low, high = protocol.TARGET_DISTANCE["ant"]
    return (
        f"The paper's Ant, LR: {mean:.3f} ± {std:.3f} m over {protocol.TEST_SEEDS} × "
        f"{protocol.TEST_EPISODES} episodes of another test: targets {low:g}–{high:g} m away, "
        "within ±45° of the heading."
    )


def main(options: Annotated[Authors, tyro.conf.arg(name="")] = Authors()) -> None:
    """Runs the row and prints its table beside the paper's number."""
    engine: dict[str, Any] = {} if options.engine is None else {"engine": options.engine}
    report = run(AntV2(**engine), LR, options)
    print((report / "table.txt").read_text(encoding="utf-8"))
    print(beside_the_paper())


if __name__ == "__main__":
    run_cli(main, "LR on gym's Ant-v2 with the settings of the author's code, in its own test.")
