"""Find the finished tests of a robot among its stages on disk."""

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
from genidm.offline.methods import EXTENDED
from genidm.paper.held_out import FILE
from genidm.paper.methods import ORDER
from genidm.report.rows import Row, origin
from genidm.robots import Robot
from genidm.store import DONE, MADE, Stage


@dataclasses.dataclass(frozen=True)
class Tested:
    """A finished test on disk.

    Attributes:
      directory: directory of its stage.
      summary: summary of its stage (`Stage.summary`).
    """

    __test__ = False  # not a test case for pytest

    directory: Path
    summary: dict[str, Any]

    @functools.cached_property
    def _tree(self) -> dict[str, Any]:
        return files.load_arrays(self.directory / "episodes")[0]

    @property
    def episodes(self) -> Episodes:
        """Results of the test, arrays `[seeds, episodes]`."""
        return Episodes(**self._tree["episodes"])

    @property
    def trajectories(self) -> list[np.ndarray]:
        """Positions `[steps + 1, 3]` in the episodes of Fig. 8, metres."""
        trajectories = self._tree.get("trajectories", {})
        return [trajectories[str(i)] for i in range(len(trajectories))]

    @property
    def made(self) -> dict[str, dict[str, Any]]:
        """Stage → what made it (`origin`), the test last; deleted stages are left out."""
        root = self.directory.parent
        stages = [Stage(root / name) for name in self.summary.get("stages", [])]
        there = [s for s in (*stages, Stage(self.directory)) if s.path(MADE).exists()]
        return {stage.directory.name: origin(stage.code, stage.made) for stage in there}

    @property
    def held_out(self) -> dict[str, Any] | None:
        """Error of the fit by bearing and heading (`genidm.paper.held_out.HeldOut`), or None."""
        path = self.controller.with_name(FILE)
        found: dict[str, Any] | None = files.load_json(path) if path.exists() else None
        return found

    @property
    def controller(self) -> Path:
        """Path of the tested controller."""
        return self.directory.parent / self.summary["fit"] / "controller"


@dataclasses.dataclass(frozen=True)
class Runs:
    """The tests of a report.

    Attributes:
      robot: the robot.
      root: directory that contains the stages.
      scenarios: scenarios of the table.
      found: method → its tests, one per training seed, in the order of the rows. The first is
        the table's own test, on `scenarios`.
    """

    robot: Robot
    root: Path
    scenarios: Scenarios
    found: dict[str, list[Tested]]

    def row(self, name: str, invariance: float | None = None) -> Row:
        """The table row of a method."""
        tests = self.found[name]
        return Row(
            method=name,
            episodes=tests[0].episodes,
            interactions=tests[0].summary["interactions"],
            replayed=tests[0].summary["replayed"],
            settings=tests[0].summary["settings"],
            training_seeds={test.summary["seed"]: test.episodes for test in tests},
            invariance=invariance,
            made=tests[0].made,
            held_out=tests[0].summary.get("held_out"),
            bearings=tests[0].summary.get("bearings"),
        )

    @property
    def records(self) -> list[Path]:
        """Finished stages of the records that the rows learned from."""
        tests = (test for found in self.found.values() for test in found)
        names = {t.summary["experience"] for t in tests if "experience" in t.summary}
        return [self.root / name for name in sorted(names) if Stage(self.root / name).done]

    def last_chunk(self) -> Path | None:
        """The last chunk of the record of the lowest row that has one on disk, or None."""
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
    """Finds the tests of every method that was tested on some scenarios.

    A method's row is its newest test with the lowest training seed. Its newest tests with other
    seeds, on any part of the scenarios, give the spread. Tests in `own` count as newest.

    Args:
      robot: the robot.
      root: directory that contains the stages.
      scenarios: scenarios of the table.
      scale: scale of the runs.
      settings: settings of the test.
      own: directories of tests that count as newest.
    """
    done = _finished(robot, root, scale, settings, own)
    return Runs(robot, root, scenarios, _by_method(done, scenarios.digest()))


def _finished(
    robot: Robot, root: Path, scale: str, settings: EvaluationSettings, own: Sequence[Path]
) -> Iterator[Tested]:
    """Finished tests with this scale, these settings and the robot's engine, oldest first."""
    done = sorted(
        root.glob(f"test-*/{DONE}"), key=lambda path: (path.parent in own, path.stat().st_mtime)
    )
    wanted = (scale, to_json(settings), robot.engine_name)
    for path in done:
        try:
            summary = files.load_json(path)
            found = (summary["scale"], summary["test"], summary["engine"])
            test = Tested(path.parent, summary)
            if found == wanted:
                # The table reads all of these: one that cannot be read is left out here.
                _ = test.episodes, *(summary[name] for name in ("method", "seed", "scenarios"))
        except (BadInput, KeyError, TypeError):
            # One file of an older version, or of another program, must not prevent the report.
            print(f"warning: {path} is not the summary of a test; left out", file=sys.stderr)
            continue
        if found == wanted:
            yield test


def _by_method(done: Iterator[Tested], digest: str) -> dict[str, list[Tested]]:
    """Method → its newest test of each training seed, tests on the scenarios first."""
    newest: dict[str, dict[int, Tested]] = {}
    for test in done:
        seeds = newest.setdefault(test.summary["method"], {})
        kept = seeds.get(test.summary["seed"])
        # A test on other scenarios never replaces a test on the table's scenarios.
        if not kept or kept.summary["scenarios"] != digest or test.summary["scenarios"] == digest:
            _warn_of_another(kept, test)
            seeds[test.summary["seed"]] = test
    rows = {}
    known = (*ORDER, *EXTENDED)
    for name in sorted(newest, key=lambda n: (known.index(n) if n in known else len(known), n)):
        order = sorted(
            newest[name].values(),
            key=lambda t: (t.summary["scenarios"] != digest, t.summary["seed"]),
        )
        if order[0].summary["scenarios"] == digest:
            rows[name] = order
    return rows


def _warn_of_another(kept: Tested | None, test: Tested) -> None:
    """Warns if a row is replaced by one of the same name with other settings."""
    if kept and kept.summary["settings"] != test.summary["settings"]:
        name = test.summary["method"]
        print(
            f"warning: the row {name} now shows {test.summary['fit']} instead of "
            f"{kept.summary['fit']}, which has other settings; "
            "use --method.name to give each its own row",
            file=sys.stderr,
        )
