"""Videos as data: clips of one robot, with its pose after every step."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from genidm import checks
from genidm.checks import check_value, count
from genidm.controller import load as load_controller
from genidm.errors import BadInput
from genidm.evaluation.evaluate import ControllerFn, EvaluationSettings
from genidm.evaluation.scenarios import scenarios
from genidm.evaluation.waypoints import WaypointRuns, WaypointSettings, follow_waypoints
from genidm.files import MANIFEST, Corrupt, load_arrays, load_json
from genidm.robots import Robot, by_name, remade
from genidm.store import Stage

# The batch is a multiple of LANES, filled with copies: videos of any number of clips then share
# one compiled program, and equal float sums, whose order depends on the batch size.
LANES = 16
# Default episodes, by their numbers in a test seed.
EPISODES = (0, 1, 2)
MOST_EPISODES = 10**6  # of a test seed
# Seconds; a robot that has not arrived by then mostly walks in circles.
LONGEST = 20.0
# What `follow_waypoints` must record of each state for `render_walked`.
POSES = operator.attrgetter("physics")


@dataclasses.dataclass(frozen=True)
class Clip:
    """One episode as it is shown: t states, with the initial state.

    Attributes:
      qpos: `[t, nq]`, of the visual model.
      position: `[t, 3]`, of the base, metres.
      waypoints: `[W, 3]`, metres.
      arrival: `[W]`, step at which a waypoint was reached; −1 if it was not reached.
      fell: whether the episode ended in a fall, or with physics that diverged.
      dt: seconds between two states.
    """

    qpos: np.ndarray
    position: np.ndarray
    waypoints: np.ndarray
    arrival: np.ndarray
    fell: bool
    dt: float

    @property
    def times(self) -> np.ndarray:
        """Seconds since the start, of every state `[t]`."""
        return self.dt * np.arange(len(self.qpos))

    @property
    def seconds(self) -> float:
        """Duration in seconds."""
        return float(self.times[-1])

    @property
    def arrivals(self) -> np.ndarray:
        """Seconds until each waypoint was reached `[W]`; infinite if it was not reached."""
        return np.where(self.arrival < 0, np.inf, self.dt * self.arrival)

    def left(self, seconds: np.ndarray) -> np.ndarray:
        """Whether each waypoint is not yet reached, at times `[n]`: `[n, W]` bool."""
        return self.arrivals > seconds[:, None] + 1e-6

    def goal(self, seconds: np.ndarray) -> np.ndarray:
        """The waypoint that the robot is going to, at times `[n]`: `[n, 3]`, metres."""
        reached = (~self.left(seconds)).sum(-1)
        return self.waypoints[np.minimum(reached, len(self.waypoints) - 1)]

    def place(self, seconds: np.ndarray) -> np.ndarray:
        """Position of the base at times `[n]`: `[n, 3]`, metres."""
        return between(self.position, self.times, seconds)

    def at(self, model: mujoco.MjModel, seconds: np.ndarray) -> np.ndarray:
        """Poses `[n, nq]` at times `[n]`, interpolated between the states."""
        before = np.clip(seconds // self.dt, 0, len(self.qpos) - 2).astype(int)
        fractions = seconds / self.dt - before
        change, poses = np.zeros(model.nv), self.qpos[before].astype(float)
        for pose, after, fraction in zip(poses, self.qpos[before + 1], fractions, strict=True):
            mujoco.mj_differentiatePos(model, change, 1.0, pose, after.astype(float))
            mujoco.mj_integratePos(model, pose, change, fraction)
        return poses


@dataclasses.dataclass(frozen=True)
class Video:
    """Clips of one robot.

    Attributes:
      title: text in the caption.
      visual_model: the robot's appearance.
      clips: its episodes.
      goal_radius: metres; a waypoint is reached when the robot is this near.
    """

    title: str
    visual_model: mujoco.MjSpec
    clips: list[Clip]
    goal_radius: float


def between(x: np.ndarray, times: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Interpolates `x [t, n]` at `times [t]` linearly to the times `seconds [m]`: `[m, n]`."""
    return np.stack([np.interp(seconds, times, column) for column in x.T], axis=-1)


def render(
    robot: Robot,
    controller: ControllerFn,
    waypoints: Any,
    keys: jax.Array,
    yaw: jax.Array,
    settings: WaypointSettings | None = None,
    title: str = "",
    *,
    quiet: bool = False,
) -> Video:
    """Runs a controller through waypoints and records every pose.

    Args:
      robot: the robot.
      controller: its controller.
      waypoints: `[W, 2]` or `[W, 3]`, metres; or `[B, W, 2]`, different for each robot.
      keys: `[B]`, of the initial states.
      yaw: `[B]`, radians by which the initial states are rotated.
      settings: length of an episode, goal radius.
      title: text in the caption; default: the robot's name.
      quiet: no progress bar.

    Raises:
      BadInput: the robot has no visual model, or the waypoints are invalid.
    """
    robot.visual_model()  # raises its error before anything is computed
    settings, fill = settings or WaypointSettings(), np.arange(-(-len(keys) // LANES) * LANES)
    fill, points = fill % len(keys), np.asarray(waypoints)
    made = follow_waypoints(
        robot, controller, points[fill] if points.ndim == 3 else points, keys[fill], yaw[fill],
        settings=settings, record=POSES, quiet=quiet,
    )  # fmt: skip
    return render_walked(robot, made, range(len(keys)), settings.goal_radius, title)


def render_walked(
    robot: Robot, made: WaypointRuns, runs: Sequence[int], goal_radius: float, title: str = ""
) -> Video:
    """Shows runs through waypoints, exactly as they were.

    Args:
      robot: the robot of the runs.
      made: the runs of `follow_waypoints(…, record=POSES)`.
      runs: indices of the runs to show.
      goal_radius: metres; a waypoint was reached when the robot was this near.
      title: text in the caption; default: the robot's name.

    Raises:
      BadInput: the robot has no visual model.
    """
    qpos = {i: robot.visual_qpos(jax.tree.map(operator.itemgetter(i), made.recorded)) for i in runs}
    clips = [_clip(made, i, poses) for i, poses in qpos.items()]
    return Video(title or robot.name, robot.visual_model(), clips, goal_radius)


def render_test(
    robot: Robot,
    controller: ControllerFn,
    episodes: Sequence[int] = EPISODES,
    seed: int = 0,
    seconds: float = LONGEST,
    title: str = "",
    *,
    quiet: bool = False,
) -> Video:
    """Runs episodes of the test (A.1.3) again: the same initial states, the same targets.

    The result may differ from the test's after some seconds, because float sums depend on the
    batch size and walking is chaotic. `render_recorded` shows what the test has recorded.

    Args:
      robot: the robot.
      controller: its controller.
      episodes: their numbers in the test seed, from 0.
      seed: the test seed.
      seconds: longest duration of an episode.
      title: text in the caption; default: the robot's name.
      quiet: no progress bar.

    Raises:
      BadInput: the robot has no visual model, or an episode's number is out of range.
    """
    robot.visual_model()  # raises its error before anything is computed
    test_scenarios, test = (
        scenarios(robot, 1, count_to(episodes, seed), first_seed=seed),
        EvaluationSettings(),
    )
    settings = WaypointSettings(steps(robot, seconds, test.max_steps), test.goal_radius)
    keys, yaw, target = (
        x[0, np.asarray(episodes)]
        for x in (test_scenarios.keys, test_scenarios.yaw, test_scenarios.target)
    )
    return render(robot, controller, target[:, None], keys, yaw, settings, title, quiet=quiet)


def render_recorded(
    robot: Robot,
    test: Path | str,
    episodes: Sequence[int] = (),
    seconds: float = LONGEST,
    title: str = "",
) -> Video:
    """Shows episodes that a test has recorded, exactly as they were.

    Args:
      robot: the robot of the test.
      test: the directory of a finished test (test-METHOD-SEED-…).
      episodes: their numbers in its first seed; default: all recorded episodes.
      seconds: longest duration of an episode.
      title: text in the caption; default: the robot's name.

    Raises:
      BadInput: the robot has no visual model, or the test has not recorded the episodes.
    """
    visual_model, settings = robot.visual_model(), _summary_value(test, "test")
    tree, _ = load_arrays(Path(test) / "episodes")
    recordings, outcome = tree.get("recordings", {}), tree["episodes"]
    most, clips = steps(robot, seconds, settings["max_steps"]), list[Clip]()
    for i in episodes or sorted(map(int, recordings)) or EPISODES:
        if str(i) not in recordings:
            raise BadInput(f"{test} has not recorded episode {i}")
        made = recordings[str(i)]
        last = len(made["qpos"]) - 1
        reached, fell = (bool(outcome[name][0, i]) and last <= most for name in ("reached", "fell"))
        clips.append(
            Clip(
                qpos=made["qpos"][: most + 1],
                position=made["position"][: most + 1],
                waypoints=made["target"][None],
                arrival=np.asarray([last if reached else -1]),
                fell=fell,
                dt=robot.dt,
            )
        )
    return Video(title or robot.name, visual_model, clips, settings["goal_radius"])


def render_run(
    run: Path | str,
    episodes: Sequence[int] = (),
    waypoints: Any = None,
    seed: int = 0,
    seconds: float = LONGEST,
    goal_radius: float = WaypointSettings.goal_radius,
    engine: str | None = None,
    robot: Robot | None = None,
) -> Video:
    """Renders the controller of a run's directory (METHOD-SEED-…).

    Args:
      run: the directory of a fit or a baseline under --run-dir.
      episodes: numbers of episodes, from 0; default: `EPISODES`, or 0 with waypoints.
      waypoints: `[W, 2]`, metres. None: the targets of the test; if a test of the run has
        recorded the episodes, the recording is shown.
      seed: of the test, or of the initial states.
      seconds: longest duration of an episode.
      goal_radius: metres; a given waypoint is reached when it is this near (the test has its own).
      engine: name of the engine that steps the robot; default: the run's engine.
      robot: the robot; default: the robot of the run's config.

    Raises:
      BadInput: the directory has no controller, its robot has no visual model, or a number is out
        of range.
    """
    starts = episodes or (EPISODES if waypoints is None else (0,))
    highest, robot = count_to(starts, seed), robot or robot_of(run, engine)
    title = f"{_summary_value(run, 'method')}, {robot.name}"
    if waypoints is None:
        test = recorded(run, robot, episodes) if seed == 0 else None
        if test:
            return render_recorded(robot, test, episodes, seconds, title)
        return render_test(robot, load_controller(run, robot), starts, seed, seconds, title)
    check_value("seed", seed, checks.seed())
    keys = jax.random.split(jax.random.key(seed), highest)[np.asarray(starts)]
    settings = WaypointSettings(steps(robot, seconds, WaypointSettings.max_steps), goal_radius)
    controller = load_controller(run, robot)
    return render(robot, controller, waypoints, keys, jnp.zeros(len(keys)), settings, title)


def recorded(run: Path | str, robot: Robot, episodes: Sequence[int] = ()) -> Path | None:
    """Finds the newest test of a run, on the robot's engine, that has recorded the episodes.

    Args:
      run: the directory of a fit or a baseline.
      robot: the robot.
      episodes: the episodes that it must have recorded; default: any.

    Returns:
      the directory of the test, or None.
    """
    run = Path(run).resolve()
    done = sorted(run.parent.glob("test-*/done.json"), key=lambda p: p.stat().st_mtime)
    for test in (path.parent for path in reversed(done)):
        try:
            of = _summary_value(test, "fit"), _summary_value(test, "engine")
        except BadInput:
            continue  # an invalid test of another run must not prevent the video
        if of == (run.name, robot.engine_name):
            # File names suffice here: `load_arrays` finds corrupt files when it reads them.
            names = [name.split(".") for name in load_json(test / "episodes" / MANIFEST)]
            kept = {name[1] for name in names if name[0] == "recordings"}
            if kept and kept.issuperset(map(str, episodes)):
                return test
    return None


def count_to(episodes: Sequence[int], seed: int = 0) -> int:
    """The number of episodes to draw, so that all of `episodes` are among them.

    Raises:
      BadInput: a number or the seed is out of range, or `episodes` is empty.
    """
    check_value("the seed of a video", seed, count(0, 2**32 - 1))
    if not episodes:
        raise BadInput("a video needs at least one episode")
    for i in episodes:
        check_value("the number of an episode", i, count(0, MOST_EPISODES - 1))
    return max(episodes) + 1


def steps(robot: Robot, seconds: float, most: int) -> int:
    """Control steps in `seconds`, at most `most`.

    Raises:
      BadInput: `seconds` is shorter than one step.
    """
    if not seconds >= robot.dt:
        raise BadInput(f"a video of the {robot.name} must last at least {robot.dt} s")
    return int(min(seconds / robot.dt, most))


def robot_of(run: Path | str, engine: str | None = None) -> Robot:
    """Makes the robot of a run's controller, with the settings of the run.

    The settings are in the run's config, or for a fit in the config of its experience. If that is
    missing, the robot has its default settings.

    Args:
      run: the directory of a fit or a baseline.
      engine: name of the engine; default: the run's engine.

    Raises:
      BadInput: it is not the directory of a finished run, or the robot rejects the settings.
    """
    run, name = Path(run), _summary_value(run, "robot")
    experience = Stage(run).summary().get("experience")
    for stage in (run, run.parent / experience) if experience else (run,):
        try:
            settings = load_json(stage / "config.json")["config"].get("robot")
        except Corrupt:
            continue
        if settings:
            return remade(settings | ({"engine": engine} if engine else {}))
    return by_name(name, engine)


def _summary_value(directory: Path | str, name: str) -> Any:
    """A value of a finished stage's summary; BadInput if it is missing."""
    summary = Stage(Path(directory)).summary()
    if not isinstance(summary, dict) or name not in summary:
        raise BadInput(f"{directory} cannot be rendered: its done.json has no {name!r}")
    return summary[name]


def _clip(made: WaypointRuns, run: int, qpos: np.ndarray) -> Clip:
    states = made.steps[run] + 1
    return Clip(
        qpos=qpos[:states],
        position=made.position[run, :states],
        waypoints=made.waypoints[run],
        arrival=made.arrival[run],
        fell=bool(made.fell[run]),
        dt=made.dt,
    )
