"""One cell of Table 1 (a method on a robot): make the run, test it, render it, report it."""

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
from genidm.offline.methods import AnyMethod, OfflineGoalConditioned
from genidm.paper.methods import AgentTurned, GoalConditioned, InverseDynamics
from genidm.robots import Robot, by_name
from genidm.runs.fitting import InverseDynamicsRun
from genidm.runs.offline import OfflineRun
from genidm.runs.policies import AgentTurnedRun, GoalConditionedRun
from genidm.runs.resolve import Options, resolve, who_set_what
from genidm.runs.run import Run
from genidm.runs.scale import scale_of
from genidm.store import Stage

# Type of method → type of its run.
RUNS: dict[type[Any], Any] = {
    InverseDynamics: InverseDynamicsRun,
    GoalConditioned: GoalConditionedRun,
    AgentTurned: AgentTurnedRun,
    OfflineGoalConditioned: OfflineRun,
}


def make_run(robot: Robot, method: AnyMethod, options: Options) -> Run[Any]:
    """Makes the run of a method, with its settings adapted to scale and machine (`resolve`)."""
    chosen = resolve(robot, method, options)
    return make_exact_run(robot, chosen, options, who_set_what(robot, method, chosen, chosen))


def make_exact_run(
    robot: Robot,
    method: AnyMethod,
    options: Options,
    notes: tuple[str, ...] = (),
) -> Run[Any]:
    """Makes the run of a method with exactly the given settings.

    Args:
      robot: the robot.
      method: the method, used as it is.
      options: options of the run.
      notes: lines that say where settings come from (`who_set_what`).

    Raises:
      BadInput: the robot cannot be rendered, or a directory cannot be written.
    """
    if options.video:
        robot.visual_model()  # a robot that cannot be rendered is an error before the computation
    for directory in (options.run_dir, options.report_dir):
        if directory is not None:
            files.check_writable(directory, directory=True)
    given: dict[str, Any] = dict(
        robot=robot, scale=scale_of(options.scale, robot.paper_interactions), seed=options.seed,
        root=options.run_dir / robot.name, test=options.test,
        notes=notes, other_code=options.other_code,
    )  # fmt: skip
    return RUNS[type(method)](method=method, **given)


def run_method(robot: Robot, method: AnyMethod, options: Options) -> Path:
    """Runs a method, with its settings adapted to scale and machine, and writes the report.

    Returns:
      the directory of the report, which covers all runs of the robot under `options.run_dir`.
    """
    return execute(make_run(robot, method, options), options)


def execute(this: Run[Any], options: Options) -> Path:
    """Tests a run, renders it if asked, writes the report; returns the report's directory."""
    announce(this.robot, options.engine)
    print_notes(this.notes)
    tested = scenarios_of(this, options)
    stage = this.run_test(tested)
    if options.video:
        render_run(this)
    return write_report(this, tested, options, [stage])


def load_runs(
    runs: Sequence[Path], engine: str | None = None
) -> tuple[Robot, dict[str, tuple[ControllerFn, dict[str, Any]]]]:
    """Loads the controllers of finished runs, for a comparison.

    Args:
      runs: directories of the runs.
      engine: engine that steps the robot; by default chosen from jax's device.

    Returns:
      the robot; and name → (controller, the run's summary). The name is the method's; if two
      runs have the same method, the name of the run's directory follows.

    Raises:
      BadInput: no directory is given, a directory is not a finished run, or the runs are of
        different robots.
    """
    if not runs:
        raise BadInput("give the directory of a run: METHOD-SEED-… in its --run-dir")
    robots: dict[str, Robot] = {}
    models: dict[str, tuple[ControllerFn, dict[str, Any]]] = {}
    for run in runs:
        stage = Stage(run)
        summary = stage.summary()
        if not isinstance(summary, dict) or not {"robot", "method"} <= summary.keys():
            raise BadInput(
                f"{run} is not the run of a controller; give METHOD-SEED-… in its --run-dir"
            )
        kind, name = str(summary["robot"]), shown(summary["method"])
        robots.setdefault(kind, by_name(kind, engine))
        model = stage.read(controller.load, ".", robots[kind])
        models[f"{name}, {run.resolve().name}" if name in models else name] = (model, summary)
    if len(robots) > 1:
        raise BadInput(f"the runs must be of one robot, not of {', '.join(sorted(robots))}")
    (robot,) = robots.values()
    announce(robot, engine)
    return robot, models


def render_run(this: Run[Any]) -> None:
    """Renders the test of a run to `video.html`, and to `video.gif` if frames can be drawn.

    Both lie in the directory of the controller.
    """
    from genidm import video  # slow to import, and needed only here

    stage = this.controller_stage
    made = video.render_run(stage.directory, robot=this.robot)
    video.write(made, stage.path("video.html"))
    try:
        video.write(made, stage.path("video.gif"))
    except BadInput as error:
        print(f"no gif: {error}", file=sys.stderr)
    print(f"Video in {stage.directory}", file=sys.stderr)


def scenarios_of(this: Run[Any], options: Options) -> Scenarios:
    """The scenarios of a run's test; `options.episodes` overrides the scale."""
    episodes = this.scale.episodes if options.episodes is None else options.episodes
    return scenarios(this.robot, this.scale.seeds, episodes)


def write_report(
    this: Run[Any], test_scenarios: Scenarios, options: Options, own: Iterable[Stage] = ()
) -> Path:
    """Writes the report of all runs in the same directory that have this test.

    Args:
      this: a run of the report.
      test_scenarios: scenarios of the table.
      options: scale, test settings, directories.
      own: tests of this command. They become rows even if another test of the same method is
        newer.

    Returns:
      the directory of the report.
    """
    from genidm.report.write import report  # slow to import (Matplotlib), needed at the end

    return report(
        this.robot, this.root, test_scenarios, this.scale.name, options.test, options.report_dir,
        own=[stage.directory for stage in own],
    )  # fmt: skip


def print_notes(notes: Iterable[str]) -> None:
    """Prints notes on stderr."""
    for note in notes:
        print(note, file=sys.stderr)


def announce(robot: Robot, engine: str | None) -> None:
    """Prints the robot's engine on stderr and, if the user gave no `engine`, the reason."""
    if robot.engine:
        where = "has an accelerator" if devices.accelerated() else "has no accelerator"
        others = " or ".join(name for name in robot.engines if name != robot.engine.name)
        why = f" (jax {where}; --engine {others} overrides)" if engine is None and others else ""
        print(f"{robot.name} on {robot.engine}{why}", file=sys.stderr)
