"""Write the report of a robot's runs: the table and the figures, from files on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from genidm import files
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.invariance import ANGLES
from genidm.evaluation.scenarios import Scenarios
from genidm.paper.protocol import TABLE1
from genidm.report import figures, table
from genidm.report.held_out_figure import draw_held_out
from genidm.report.rows import Row, results
from genidm.report.runs import Runs, find
from genidm.report.shown import Shown, gather
from genidm.robots import Robot
from genidm.store import alone


def report(
    robot: Robot,
    root: Path,
    scenarios: Scenarios,
    scale: str,
    settings: EvaluationSettings,
    results: Path | None = None,
    own: Sequence[Path] = (),
) -> Path:
    """Writes the table and the figures of all methods that were tested on some scenarios.

    Args:
      robot: the robot.
      root: directory that contains the stages.
      scenarios: scenarios of the table.
      scale: scale of the runs.
      settings: settings of the test.
      results: also write the table, its numbers and the figures to this directory. The names
        begin with the robot, the engine (if the robot has several) and the scale (unless
        "paper").
      own: directories of tests that become rows even if another test of the same method is
        newer.

    Returns:
      the directory of the report.

    Raises:
      BadInput: no method was tested on the scenarios.
    """
    runs = find(robot, root, scenarios, scale, settings, own)
    if not runs.found:
        raise BadInput(f"no method in {root} has been tested on these scenarios")
    shown = gather(runs)
    rows = [runs.row(name, shown.invariance(name)) for name in runs.found]
    written = _document(runs, rows, scale)
    here = root / "-".join(["report", scale, *robot.engine_in_names])
    _write(here, "", "results.json", written, rows, shown)
    if results:
        name = "_".join(
            [robot.name, *robot.engine_in_names, *([scale] if scale != "paper" else [])]
        )
        _write(results, f"{name}_", f"{name}.json", written, rows, shown)
    return here


def _document(runs: Runs, rows: list[Row], scale: str) -> dict[str, Any]:
    return results(
        rows, robot=runs.robot.name, engine=runs.robot.engine, scale=scale,
        scenarios=runs.scenarios.digest(),
    )  # fmt: skip


def _write(
    directory: Path, prefix: str, name: str, written: dict[str, Any], rows: list[Row], shown: Shown
) -> None:
    """Writes the table, as JSON under `name`, as Markdown and as text, and the figures."""
    with files.disk(directory):
        directory.mkdir(parents=True, exist_ok=True)
    with alone(directory):  # another command may write the same report
        _write_alone(directory, prefix, name, written, rows, shown)


def _write_alone(
    directory: Path, prefix: str, name: str, written: dict[str, Any], rows: list[Row], shown: Shown
) -> None:
    files.save_json(directory / name, written)
    files.save_text(directory / f"{prefix}table.md", table.markdown(written))
    drawn = _draw(directory, prefix, rows, shown, TABLE1.get(written["robot"]))
    text = f"{table.text(written)}\n\nFigures in {directory}: {', '.join(drawn)}"
    if not shown.changes:
        text += "\nNo invariance figure: there is no record to sample states from."
    files.save_text(directory / f"{prefix}table.txt", f"{text}\n")


def _draw(
    directory: Path,
    prefix: str,
    rows: list[Row],
    shown: Shown,
    paper: Mapping[str, tuple[float, float]] | None,
) -> list[str]:
    """Draws the figures that have data; returns their file names in alphabetical order."""
    drawn = []

    def at(name: str) -> Path:
        drawn.append(f"{prefix}{name}.png")
        return directory / drawn[-1]

    figures.bearings(shown.closest, shown.bearing, shown.heading, at("bearings"))
    if shown.collecting:
        keys = ["reward", "speed"]
        figures.learning_curves(shown.collecting, at("collecting"), keys, "interactions")
    if shown.fitting:
        keys = ["loss_action", "loss_latent"]
        figures.learning_curves(shown.fitting, at("fitting"), keys, "updates")
    if shown.held_out:
        ranges = {row.method: row.bearings for row in rows if row.bearings is not None}
        draw_held_out(shown.held_out, ranges, at("held_out"))
    if shown.changes:
        figures.invariance(shown.changes, ANGLES, at("invariance"))
    if shown.learning:
        keys = ["speed", "reached"]
        figures.learning_curves(shown.learning, at("learning"), keys, "interactions")
    figures.paths(shown.panels, at("paths"))
    if shown.residuals:
        figures.residuals(shown.residuals, at("residual"))
    figures.violins(rows, at("violins"), paper)
    return drawn
