"""A cell of Table 1: made from a method, run to its row, filmed and reported."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from genidm import controller, devices, files
from genidm.checks import shown
from genidm.errors import BadInput
from genidm.evaluation.evaluate import ControllerFn
from genidm.evaluation.scenarios import Scenarios, scenarios
from genidm.paper.methods import GoalConditioned, InverseDynamics
from genidm.robots import Robot, by_name
from genidm.runs.resolve import Options, resolve, who_set_what
from genidm.runs.run import GoalConditionedRun, InverseDynamicsRun, Run
from genidm.runs.scale import scale_of
from genidm.store import Stage


def make_run(robot: Robot, method: GoalConditioned | InverseDynamics, options: Options) -> Run[Any]:
    """The cell of a method as scale and machine have it (`resolve`)."""
    chosen = resolve(robot, method, options)
    return make_exact_run(robot, chosen, options, who_set_what(method, chosen, chosen))


def make_exact_run(
    robot: Robot,
    method: GoalConditioned | InverseDynamics,
    options: Options,
    notes: tuple[str, ...] = (),
) -> Run[Any]:
    """The cell of a method exactly as it is given; `notes` say who set what."""
    if options.video:
        robot.visual_model()  # what cannot be rendered is said before anything is computed
    for directory in (options.run_dir, options.report_dir):
        if directory is not None:
            files.check_writable(directory, directory=True)
    given: dict[str, Any] = dict(
        robot=robot, scale=scale_of(options.scale, robot.paper_interactions), seed=options.seed,
        root=options.run_dir / robot.name, test=options.test,
        notes=notes, other_code=options.other_code,
    )  # fmt: skip
    kind: Any = GoalConditionedRun if isinstance(method, GoalConditioned) else InverseDynamicsRun
    return kind(method=method, **given)


def run_method(robot: Robot, method: GoalConditioned | InverseDynamics, options: Options) -> Path:
    """Runs the cell of a method, as scale and machine have it, and writes the report.

    Returns:
      the directory of the report of all cells beside it.
    """
    return execute(make_run(robot, method, options), options)


def execute(this: Run[Any], options: Options) -> Path:
    """Runs a cell and writes the report of all cells beside it: its directory is returned."""
    announce(this.robot, options.engine)
    say(this.notes)
    tested = scenarios_of(this, options)
    stage = this.run_test(tested)
    if options.video:
        render_run(this)
    return write_report(this, tested, options, [stage])


def saved(
    runs: Sequence[Path], engine: str | None = None
) -> tuple[Robot, dict[str, tuple[ControllerFn, dict[str, Any]]]]:
    """Controllers to be compared, from the directories of their runs.

    Args:
      runs: the directories.
      engine: to step their robot with; chosen by what jax runs on, unless given.

    Returns:
      their robot; and by the method's name, or where two runs have the same also the run's,
      the controller and what the run says of it.

    Raises:
      BadInput: there are none, one is no finished run, or they are of different robots.
    """
    if not runs:
        raise BadInput("give the directory of a run: METHOD-SEED-… under --run-dir of a cell")
    robots: dict[str, Robot] = {}
    models: dict[str, tuple[ControllerFn, dict[str, Any]]] = {}
    for run in runs:
        stage = Stage(run)
        summary = stage.summary()
        if not isinstance(summary, dict) or not {"robot", "method"} <= summary.keys():
            raise BadInput(
                f"{run} is no run of a controller: METHOD-SEED-… under --run-dir of a cell"
            )
        kind, name = str(summary["robot"]), shown(summary["method"])
        robots.setdefault(kind, by_name(kind, engine))
        model = stage.read(controller.load, ".", robots[kind])
        models[f"{name}, {run.resolve().name}" if name in models else name] = (model, summary)
    if len(robots) > 1:
        raise BadInput(f"runs of one robot can be compared, not of {', '.join(sorted(robots))}")
    (robot,) = robots.values()
    announce(robot, engine)
    return robot, models


def render_run(this: Run[Any]) -> None:
    """Renders a cell's test, beside its controller.

    `video.html` and, where a picture can be drawn, `video.gif`.
    """
    from genidm import video  # nor is this

    stage = this.controller_stage
    made = video.render_run(stage.directory, robot=this.robot)
    video.write(made, stage.path("video.html"))
    try:
        video.write(made, stage.path("video.gif"))
    except BadInput as error:
        print(f"no gif: {error}", file=sys.stderr)
    print(f"Video in {stage.directory}", file=sys.stderr)


def scenarios_of(this: Run[Any], options: Options) -> Scenarios:
    """The scenarios that a cell is tested on, as its scale or the user says."""
    episodes = this.scale.episodes if options.episodes is None else options.episodes
    return scenarios(this.robot, this.scale.seeds, episodes)


def write_report(
    this: Run[Any], test_scenarios: Scenarios, options: Options, own: Iterable[Stage] = ()
) -> Path:
    """The report of all cells that lie beside one, and were tested on some scenarios.

    Args:
      this: a cell of the report.
      test_scenarios: the scenarios of the table.
      options: scale, test, places.
      own: tests that this command asked for: they are its rows, also where there are newer
        tests of methods with the same names.

    Returns:
      the directory of the report.
    """
    from genidm.report.write import report  # drawing is not needed before the end

    return report(
        this.robot, this.root, test_scenarios, this.scale.name, options.test, options.report_dir,
        own=[stage.directory for stage in own],
    )  # fmt: skip


def say(notes: Iterable[str]) -> None:
    """Says on stderr who set what."""
    for note in notes:
        print(note, file=sys.stderr)


def announce(robot: Robot, engine: str | None) -> None:
    """Says on stderr what steps a robot and, if the user named no `engine`, why."""
    if robot.engine:
        where = "an accelerator" if devices.accelerated() else "no accelerator"
        others = " or ".join(name for name in robot.engines if name != robot.engine.name)
        why = f": jax has {where}; --engine {others} instead" if engine is None and others else ""
        print(f"{robot.name} on {robot.engine}{why}", file=sys.stderr)
