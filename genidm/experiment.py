"""A cell of Table 1, end to end: what the commands in `experiments` run."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from genidm import controller, devices
from genidm.agents.frozen import Frozen
from genidm.agents.off_policy import OffPolicy
from genidm.agents.ppo import PPO
from genidm.cells import Cell, DirectCell, InverseCell
from genidm.checkpoints import requested_seconds
from genidm.checks import check, count, optional
from genidm.config import plain
from genidm.errors import BadInput
from genidm.evaluate import Steering, Test
from genidm.methods import Direct, Inverse, literal
from genidm.robots import Robot, by_name
from genidm.scale import Scale, scale_of
from genidm.scenarios import Scenarios, scenarios
from genidm.store import Stage


@dataclasses.dataclass(frozen=True)
class Options:
    """What every cell takes.

    Attributes:
      scale: "paper" (A.1.2: all interactions, 10 seeds × 1000 episodes), "quick" (minutes),
        or a number: that share of the paper's interactions, updates and episodes.
      seed: training seed: of the experience, the replay and the fit. The test's are fixed.
      engine: what steps the robot: "mjx", or "mujoco" for MuJoCo in C; MJX on an accelerator
        and MuJoCo in C on a CPU, unless given. The Minitaur has "bullet" alone.
      out: where runs are kept. The same command again goes on where it was.
      literal: the paper's letter instead of our settings: h = 1, whole-episode replay,
        λ = 0.25, mean latents, constant learning rate.
      episodes: test episodes a seed; as the scale says, unless given.
      results: also write the table and the figures to this directory, under the robot's name.
      video: also film three episodes of the test: a page and a gif, beside the controller.
      test: the test (A.1.3).
    """

    scale: str = "paper"
    seed: int = 0
    engine: str | None = None
    out: Path = Path("runs")
    literal: bool = False
    episodes: int | None = None
    results: Path | None = None
    video: bool = False
    test: Test = dataclasses.field(default_factory=Test)

    def __post_init__(self) -> None:
        # A seed has 32 bits: jax would take 2³² for 0.
        check(self, seed=count(0, 2**32 - 1), episodes=optional(count()))


def resolve(robot: Robot, method: Direct | Inverse, options: Options) -> Direct | Inverse:
    """A method as the scale, the machine and the robot's engine have it.

    On the command line this is what the flags of a method start from, so that what the user
    sets stands, also where it equals a default.

    Raises:
      BadInput: the scale is none, or the paper has no other settings for the method.
    """
    scale = scale_of(options.scale, robot.paper_interactions)
    if isinstance(method.agent, PPO) and method.agent == PPO(hidden=method.agent.hidden):
        agent = dataclasses.replace(scale.ppo, hidden=method.agent.hidden)
        method = dataclasses.replace(method, agent=agent)
    if devices.memory() is not None and isinstance(method.agent, OffPolicy | Frozen):
        wide: Any = method.agent.wide()  # of the method's own type
        method = dataclasses.replace(method, agent=wide)
    if isinstance(method, Direct):
        if options.literal:
            raise BadInput(f"{method.name} has no settings that the paper's letter would change")
        return method
    method = _fitting(literal(method) if options.literal else method, scale)
    if method.generalize:
        method = dataclasses.replace(method, generalize=method.generalize.on(robot))
    return method


def _fitting(method: Inverse, scale: Scale) -> Inverse:
    """The method as far as a scale's record is long enough for it."""
    agent = method.agent
    if isinstance(agent, Frozen):
        agent = dataclasses.replace(agent, share=max(agent.share, scale.learning))
    updates = max(1, round(method.fit.updates * scale.updates))
    return dataclasses.replace(
        method,
        agent=agent,
        look_ahead=min(method.look_ahead, scale.look_ahead),
        share=max(method.share, scale.share),
        fit=dataclasses.replace(method.fit, updates=updates),
    )


def cell(robot: Robot, method: Direct | Inverse, options: Options) -> Cell[Any]:
    """The cell of a method as scale and machine have it (`resolve`)."""
    return cell_of(robot, resolve(robot, method, options), options)


def cell_of(robot: Robot, method: Direct | Inverse, options: Options) -> Cell[Any]:
    """The cell of a method exactly as it is given."""
    if options.video:
        robot.drawing()  # what cannot be filmed is said before anything is computed
    given: dict[str, Any] = dict(
        robot=robot, scale=scale_of(options.scale, robot.paper_interactions), seed=options.seed,
        root=options.out / robot.name, test=options.test,
    )  # fmt: skip
    kind: Any = DirectCell if isinstance(method, Direct) else InverseCell
    return kind(method=method, **given)


def run_cell(robot: Robot, method: Direct | Inverse, options: Options) -> Path:
    """Runs the cell of a method, as scale and machine have it, and writes the report.

    Returns:
      the directory of the report of all cells beside it.
    """
    return run_to_the_end(cell(robot, method, options), options)


def run_to_the_end(this: Cell[Any], options: Options) -> Path:
    """Runs a cell and writes the report of all cells beside it: its directory is returned."""
    announce(this.robot, options.engine)
    tested = bank_of(this, options)
    this.episodes(tested)
    if options.video:
        film_cell(this)
    return write_report(this, tested, options)


def saved(
    runs: Sequence[Path], engine: str | None = None
) -> tuple[Robot, dict[str, tuple[Steering, dict[str, Any]]]]:
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
        raise BadInput("give the directory of a run: METHOD-SEED-… under --out of a cell")
    robots: dict[str, Robot] = {}
    models: dict[str, tuple[Steering, dict[str, Any]]] = {}
    for run in runs:
        summary = Stage(run).summary()
        kind, name = summary["robot"], summary["method"]
        robots.setdefault(kind, by_name(kind, engine))
        model = controller.load(run, robots[kind])
        models[f"{name}, {run.resolve().name}" if name in models else name] = (model, summary)
    if len(robots) > 1:
        raise BadInput(f"runs of one robot can be compared, not of {', '.join(sorted(robots))}")
    (robot,) = robots.values()
    announce(robot, engine)
    return robot, models


def film_cell(this: Cell[Any]) -> None:
    """Films a cell's test, beside its controller.

    `video.html` and, where a picture can be drawn, `video.gif`.
    """
    from genidm import video  # nor is this

    stage = this.controller_stage
    made = video.film_run(stage.directory, robot=this.robot)
    video.write(made, stage.path("video.html"))
    try:
        video.write(made, stage.path("video.gif"))
    except BadInput as error:
        print(f"no gif: {error}", file=sys.stderr)
    print(f"Video in {stage.directory}", file=sys.stderr)


def bank_of(this: Cell[Any], options: Options) -> Scenarios:
    """The scenarios that a cell is tested on, as its scale or the user says."""
    episodes = this.scale.episodes if options.episodes is None else options.episodes
    return scenarios(this.robot, this.scale.seeds, episodes)


def write_report(this: Cell[Any], bank: Scenarios, options: Options) -> Path:
    """The report of all cells that lie beside one, and were tested on `bank`.

    Returns:
      the directory of the report.
    """
    from genidm.report.write import report  # drawing is not needed before the end

    return report(this.robot, this.root, bank, this.scale.name, options.test, options.results)


def announce(robot: Robot, engine: str | None) -> None:
    """Says on stderr what steps a robot and, if the user named no `engine`, why."""
    if robot.engine:
        where = "an accelerator" if devices.accelerated() else "no accelerator"
        others = " or ".join(name for name in robot.engines if name != robot.engine.name)
        why = f": jax has {where}; --engine {others} instead" if engine is None and others else ""
        print(f"{robot.name} on {robot.engine}{why}", file=sys.stderr)


def main(robot: Callable[..., Robot], method: Direct | Inverse) -> None:
    """The command line of a cell: `python -m experiments.ant_lr`.

    The flags are read twice. The first time scale and engine; what they choose is what the flags
    of the method start from the second time.
    """
    description = f"{method.name} on the {robot.__name__}: one cell of Table 1, end to end."
    with in_sentences():
        if {"-h", "--help"} & set(sys.argv[1:]):
            _parse(_settings(method), description)
            return
        early, _ = _parse(_early, description, return_unknown_args=True)
        made = robot(**({} if early.engine is None else {"engine": early.engine}))
        chosen = resolve(made, method, early)
        options, given = _parse(_settings(chosen), description)
        tell(method, chosen, given)
        report = run_to_the_end(cell_of(made, given, options), options)
        print((report / "table.txt").read_text(encoding="utf-8"))


def _early(options: Annotated[Options, tyro.conf.arg(name="")] = Options()) -> Options:
    return options


def _settings(method: Direct | Inverse) -> Callable[..., tuple[Options, Direct | Inverse]]:
    """A function whose parameters are the flags of a cell."""

    def both(
        options: Annotated[Options, tyro.conf.arg(name="")] = Options(),
        method: Direct | Inverse = method,
    ) -> tuple[Options, Direct | Inverse]:
        return options, method

    return both


def tell(method: Direct | Inverse, chosen: Direct | Inverse, given: Direct | Inverse) -> None:
    """Says on stderr which settings are not those of the method, who set them, and the paper's.

    Args:
      method: with its defaults for the robot.
      chosen: as scale, engine and machine have it.
      given: as it is run.
    """
    papers = literal(method) if isinstance(method, Inverse) and given.name == method.name else given
    for who, before, after in (
        ("chosen for this scale and machine", method, chosen),
        ("set by you", chosen, given),
        ("not the paper's (--literal has those)", papers, given),
    ):
        changes = [c for c in differences(before, after) if not c.startswith("name ")]
        if changes:
            print(f"{given.name}, {who}: {', '.join(changes)}", file=sys.stderr)


def differences(before: Any, after: Any) -> list[str]:
    """Settings that differ, as "name value (value before)"."""
    was, now = (_dotted(plain(x)) for x in (before, after))
    return [
        f"{name} {now.get(name, 'absent')} ({was.get(name, 'absent')})"
        for name in sorted(was.keys() | now.keys())
        if was.get(name) != now.get(name)
    ]


def _dotted(tree: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict):
        return {prefix.removesuffix("."): tree}
    return {
        k: x for name, part in tree.items() for k, x in _dotted(part, f"{prefix}{name}.").items()
    }


def guarded(command: Callable[..., None], description: str) -> None:
    """Runs a command line; bad input, or Ctrl-C, ends in one sentence on stderr."""
    with in_sentences():
        _parse(command, description)


def _parse(command: Callable[..., Any], description: str, **how: Any) -> Any:
    """Calls a function with what the command line says."""
    return tyro.cli(command, description=description, config=(tyro.conf.AvoidSubcommands,), **how)


@contextlib.contextmanager
def in_sentences() -> Iterator[None]:
    """Ends the program in one sentence on stderr where its input is bad, or at Ctrl-C.

    The exit status is 2 for bad input and 130, as a shell has it, for Ctrl-C.
    """
    warnings.showwarning = _warn
    inherited = os.environ.get("MPLBACKEND")
    # Files are written, no window is opened: not even where Jupyter's backend is inherited.
    os.environ["MPLBACKEND"] = "Agg"
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # "≤" on a terminal that has none
    try:
        devices.requested()
        requested_seconds()
        yield
    except BadInput as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except MemoryError as error:
        print(f"error: not enough memory: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # what reads the output has ended: `… | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped: the same command goes on where it was", file=sys.stderr)
        sys.exit(130)
    finally:
        os.environ.pop("MPLBACKEND")
        if inherited is not None:
            os.environ["MPLBACKEND"] = inherited


def _warn(
    message: Warning | str, category: Any, filename: str, lineno: int, file: Any = None,
    line: str | None = None,
) -> None:  # fmt: skip
    """A warning as a user wants it: what is the matter, not which line of ours said so."""
    print(f"warning: {message}", file=sys.stderr)
