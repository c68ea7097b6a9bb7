"""The report of a robot's runs: the table and the figures, from what lies on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from genidm import files, stats, symmetry
from genidm.config import environment, plain
from genidm.episodes import Episodes
from genidm.evaluate import Test
from genidm.methods import ORDER
from genidm.progress import METRICS, read_metrics
from genidm.report import figures, table
from genidm.report.paper import TABLE1
from genidm.report.table import Row
from genidm.robots import Robot
from genidm.scenarios import TOUR, UNSEEN_YAW, Scenarios, tours


@dataclasses.dataclass(frozen=True)
class Tested:
    """A finished test, as its stage holds it."""

    directory: Path
    summary: dict[str, Any]

    def load(self) -> tuple[Episodes, list[np.ndarray]]:
        """The outcome, and the ways of the tours (Fig. 8)."""
        tree, _ = files.load_arrays(self.directory / "episodes")
        ways = tree.get("ways", {})
        return Episodes(**tree["episodes"]), [ways[str(i)] for i in range(len(ways))]


def tests(root: Path, scale: str, settings: Test) -> Iterator[Tested]:
    """All finished tests of a robot at a scale, oldest first."""
    done = sorted(root.glob("test-*/done.json"), key=lambda path: path.stat().st_mtime)
    for path in done:
        summary = files.load_json(path)
        if summary["scale"] == scale and summary["test"] == plain(settings):
            yield Tested(path.parent, summary)


def report(
    robot: Robot,
    root: Path,
    bank: Scenarios,
    scale: str,
    settings: Test,
    results: Path | None = None,
) -> Path:
    """Writes the table and the figures of all methods that were tested on `bank`.

    A method's row is its newest test with the lowest collecting seed; its newest tests with
    the other collecting seeds, on whatever part of the bank, give the spread.

    Args:
      robot: whose report it is.
      root: where its stages lie.
      bank: the scenarios of the table.
      scale: the scale that the methods were run at.
      settings: of the test.
      results: also write `ROBOT.json` and the figures there.

    Returns:
      the directory of the report.
    """
    found = _by_method(tests(root, scale, settings), bank.digest())
    material = Material(robot, root, bank, found, [_row(*item) for item in found.items()])
    written = table.results(
        material.rows, robot=robot.name, scale=scale, scenarios=bank.digest(),
        environment=environment(),
    )  # fmt: skip
    here = root / f"report-{scale}"
    _write(here, "", "results.json", material, written)
    if results:
        _write(results, f"{robot.name}_", f"{robot.name}.json", material, written)
    return here


@dataclasses.dataclass(frozen=True)
class Material:
    """What a report is made from.

    Attributes:
      robot: whose report it is.
      root: where its stages lie.
      bank: the scenarios of the table.
      found: method → its tests, the table's own first.
      rows: the table's.
    """

    robot: Robot
    root: Path
    bank: Scenarios
    found: dict[str, list[Tested]]
    rows: list[Row]


def _by_method(done: Iterator[Tested], digest: str) -> dict[str, list[Tested]]:
    """Method → its newest test of each collecting seed, the one on the bank first."""
    newest: dict[str, dict[int, Tested]] = {}
    for test in done:
        seeds = newest.setdefault(test.summary["method"], {})
        kept = seeds.get(test.summary["seed"])
        # A test on another part of the bank does not stand in for one on the bank.
        if not kept or kept.summary["scenarios"] != digest or test.summary["scenarios"] == digest:
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


def _row(name: str, seeds: list[Tested]) -> Row:
    summary = seeds[0].summary
    outcomes = tuple(test.load()[0] for test in seeds)
    return Row(
        method=name,
        episodes=outcomes[0],
        interactions=summary["interactions"],
        replayed=summary["replayed"],
        settings=summary["settings"],
        collecting_seeds=outcomes if len(outcomes) > 1 else (),
    )


def _write(
    directory: Path, prefix: str, name: str, material: Material, written: dict[str, Any]
) -> None:
    """The table as JSON under `name`, as Markdown and text, and the figures."""
    paper = TABLE1.get(material.robot.name, {})
    closest = {row.method: stats.masked(row.episodes) for row in material.rows}
    heading, bearing = _angles(material.robot, material.bank)
    files.save_json(directory / name, written)
    files.save_text(directory / f"{prefix}table.md", table.markdown(written))
    figures.violins(material.rows, directory / f"{prefix}violins.png", paper)
    figures.paths(_panels(material), directory / f"{prefix}paths.png")
    figures.bearings(closest, bearing, heading, directory / f"{prefix}bearings.png")
    _curves(directory, prefix, material)
    names = sorted(p.name for p in directory.glob(f"{prefix}*.png"))
    text = f"{table.text(written)}\n\nFigures in {directory}: {', '.join(names)}\n"
    files.save_text(directory / f"{prefix}table.txt", text)


def _panels(material: Material) -> list[figures.Panel]:
    """Fig. 8: the ways of each method towards targets seen and unseen while learning."""
    target = np.asarray(tours(material.robot).target)
    walked = {name: seeds[0].load()[1] for name, seeds in material.found.items()}
    ways = {name: [w[:, :2] for w in ways] for name, ways in walked.items()}
    return [
        ("as learned", {n: w[:TOUR] for n, w in ways.items()}, target[0, :, :2], 0.0),
        ("turned 135°", {n: w[TOUR:] for n, w in ways.items()}, target[1, :, :2], UNSEEN_YAW),
    ]


def _angles(robot: Robot, bank: Scenarios) -> tuple[np.ndarray, np.ndarray]:
    """Heading at the start, and the target's bearing from it, `[seeds, episodes]`, radians."""

    def angles(keys: jax.Array, yaw: jax.Array, target: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = robot.reset(keys, yaw)
        way = target - state.position
        bearing = jax.numpy.arctan2(way[:, 1], way[:, 0]) - state.heading
        return state.heading, symmetry.wrap(bearing)

    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), bank)
    out = jax.jit(angles)(flat.keys, flat.yaw, flat.target)
    heading, bearing = (np.asarray(x).reshape(bank.shape) for x in out)
    return heading, bearing


def _curves(directory: Path, prefix: str, material: Material) -> None:
    """Learning curves of agents and fits, and the e.m.o. residual of every mode of 𝒢."""
    agents, modes = {}, {}
    for done in sorted(material.root.glob("experience-*/done.json")):
        _, agent, seed, _ = done.parent.name.split("-")
        agents[f"{agent}, seed {seed}"] = _metrics(done.parent)
    for done in sorted(material.root.glob("replay-*/done.json")):
        mode = done.parent.name.split("-")[1]
        modes[mode] = files.load_arrays(done.parent / "residual")[0]
    fits = {
        name: _metrics(material.root / seeds[0].summary["fit"])
        for name, seeds in material.found.items()
    }
    collecting, fitting = (directory / f"{prefix}{x}.png" for x in ("collecting", "fitting"))
    figures.learning_curves(agents, collecting, ["reward", "speed"], "interactions")
    figures.learning_curves(fits, fitting, ["loss_action", "loss_latent"], "updates")
    if modes:
        figures.residuals(modes, directory / f"{prefix}residual.png")


def _metrics(stage: Path) -> list[dict[str, Any]]:
    path = stage / METRICS
    return read_metrics(path) if path.exists() else []
