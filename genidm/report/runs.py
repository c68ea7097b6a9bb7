"""The finished tests of a robot, found where their stages lie."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from genidm import files
from genidm.config import to_json
from genidm.errors import BadInput
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.scenarios import Scenarios
from genidm.paper.methods import ORDER
from genidm.report.rows import Row, origin
from genidm.robots import Robot
from genidm.store import DONE, MADE, Stage


@dataclasses.dataclass(frozen=True)
class Tested:
    """A finished test, as its stage holds it.

    Attributes:
      directory: of the stage.
      summary: what it was finished with.
    """

    __test__ = False  # not a test case for pytest

    directory: Path
    summary: dict[str, Any]

    @functools.cached_property
    def _tree(self) -> dict[str, Any]:
        return files.load_arrays(self.directory / "episodes")[0]

    @property
    def episodes(self) -> Episodes:
        """The outcome."""
        return Episodes(**self._tree["episodes"])

    @property
    def trajectories(self) -> list[np.ndarray]:
        """Positions `[steps + 1, 3]` in the episodes of Fig. 8, metres."""
        trajectories = self._tree.get("trajectories", {})
        return [trajectories[str(i)] for i in range(len(trajectories))]

    @property
    def made(self) -> dict[str, dict[str, Any]]:
        """Stage → what made it, the test last; stages that are no longer there are left out."""
        root = self.directory.parent
        stages = [Stage(root / name) for name in self.summary.get("stages", [])]
        there = [s for s in (*stages, Stage(self.directory)) if s.path(MADE).exists()]
        return {stage.directory.name: origin(stage.code, stage.made) for stage in there}

    @property
    def controller(self) -> Path:
        """Where the controller lies that was tested."""
        return self.directory.parent / self.summary["fit"] / "controller"


@dataclasses.dataclass(frozen=True)
class Runs:
    """All that a report is made from.

    Attributes:
      robot: whose report it is.
      root: where its stages lie.
      scenarios: the scenarios of the table.
      found: method → its tests, one a training seed, in the order of the rows; the table's
        own test, on the scenarios, is the first.
    """

    robot: Robot
    root: Path
    scenarios: Scenarios
    found: dict[str, list[Tested]]

    def row(self, name: str, invariance: float | None = None) -> Row:
        """The row of a method."""
        tests = self.found[name]
        return Row(
            method=name,
            episodes=tests[0].episodes,
            interactions=tests[0].summary["interactions"],
            replayed=tests[0].summary["replayed"],
            settings=tests[0].summary["settings"],
            collecting_seeds={test.summary["seed"]: test.episodes for test in tests},
            invariance=invariance,
            made=tests[0].made,
        )

    @property
    def records(self) -> list[Path]:
        """The stages of the records that the rows learned from, as far as they are finished."""
        tests = (test for found in self.found.values() for test in found)
        names = {t.summary["experience"] for t in tests if "experience" in t.summary}
        return [self.root / name for name in sorted(names) if Stage(self.root / name).done]

    def last_chunk(self) -> Path | None:
        """The last part of the record that a row learned from: the lowest that has one here."""
        for tests in reversed(self.found.values()):
            stage = tests[0].summary.get("experience")
            chunks = sorted(self.root.glob(f"{stage}/experience/chunk_*")) if stage else []
            if chunks:
                return chunks[-1]
        return None


def find(
    robot: Robot,
    root: Path,
    scenarios: Scenarios,
    scale: str,
    settings: EvaluationSettings,
    own: Sequence[Path] = (),
) -> Runs:
    """The tests of every method that was tested on some scenarios.

    A method's row is its newest test with the lowest training seed; its newest tests with
    the other seeds, on whatever part of the scenarios, give the spread. Tests in `own` count as the
    newest.

    Args:
      robot: whose they are.
      root: where its stages lie.
      scenarios: the scenarios of the table.
      scale: the scale that the methods were run at.
      settings: of the test.
      own: directories of the tests that the caller asked for.
    """
    done = _finished(robot, root, scale, settings, own)
    return Runs(robot, root, scenarios, _by_method(done, scenarios.digest()))


def _finished(
    robot: Robot, root: Path, scale: str, settings: EvaluationSettings, own: Sequence[Path]
) -> Iterator[Tested]:
    """All finished tests at a scale, on the robot's engine, oldest first."""
    done = sorted(
        root.glob(f"test-*/{DONE}"), key=lambda path: (path.parent in own, path.stat().st_mtime)
    )
    asked = (scale, to_json(settings), robot.engine_name)
    for path in done:
        try:
            summary = files.load_json(path)
            found = (summary["scale"], summary["test"], summary["engine"])
        except (BadInput, KeyError, TypeError):
            # Of an older version, or of something else: no reason to have no report at all.
            print(f"warning: {path} is no summary of a test, and is left out", file=sys.stderr)
            continue
        if found == asked:
            yield Tested(path.parent, summary)


def _by_method(done: Iterator[Tested], digest: str) -> dict[str, list[Tested]]:
    """Method → its newest test of each training seed, the one on the scenarios first."""
    newest: dict[str, dict[int, Tested]] = {}
    for test in done:
        seeds = newest.setdefault(test.summary["method"], {})
        kept = seeds.get(test.summary["seed"])
        # A test on another part of the scenarios does not stand in for one on the scenarios.
        if not kept or kept.summary["scenarios"] != digest or test.summary["scenarios"] == digest:
            _warn_of_another(kept, test)
            seeds[test.summary["seed"]] = test
    rows = {}
    for name in sorted(newest, key=lambda n: (ORDER.index(n) if n in ORDER else len(ORDER), n)):
        order = sorted(
            newest[name].values(),
            key=lambda t: (t.summary["scenarios"] != digest, t.summary["seed"]),
        )
        if order[0].summary["scenarios"] == digest:
            rows[name] = order
    return rows


def _warn_of_another(kept: Tested | None, test: Tested) -> None:
    """Says so where a row is replaced by one of the same name that was made otherwise."""
    if kept and kept.summary["settings"] != test.summary["settings"]:
        name = test.summary["method"]
        print(
            f"warning: the row {name} is of {test.summary['fit']} and no longer of "
            f"{kept.summary['fit']}, made with other settings; "
            "--method.name gives each a row of its own",
            file=sys.stderr,
        )
