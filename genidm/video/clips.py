"""A video: journeys of one robot, with the pose that it was in at every step."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Iterator, Sequence
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

# Robots that walk at once, filled up with some of them again: a program is then compiled once
# for films of however many, and float sums, which depend on that number, come out alike.
LANES = 16
# By their numbers in a test seed.
EPISODES = (0, 1, 2)
MOST_EPISODES = 10**6  # of a test seed
# Seconds; who has not arrived by then goes round and round.
LONGEST = 20.0


@dataclasses.dataclass(frozen=True)
class Clip:
    """One journey, up to its end: t states, the start among them.

    Attributes:
      qpos: `[t, nq]`, of the visual model.
      position: `[t, 3]`, of the base, metres.
      waypoints: `[W, 3]`, metres.
      arrival: `[W]`, step at which a waypoint was reached; −1 where it was not.
      fell: whether it ended in a fall, or in physics that diverged.
      dt: seconds from one state to the next.
    """

    qpos: np.ndarray
    position: np.ndarray
    waypoints: np.ndarray
    arrival: np.ndarray
    fell: bool
    dt: float

    @property
    def times(self) -> np.ndarray:
        """Seconds since the start `[t]`."""
        return self.dt * np.arange(len(self.qpos))

    @property
    def seconds(self) -> float:
        """How long it took."""
        return float(self.times[-1])

    @property
    def arrivals(self) -> np.ndarray:
        """Seconds to each waypoint `[W]`; infinite where it was not reached."""
        return np.where(self.arrival < 0, np.inf, self.dt * self.arrival)

    def left(self, seconds: np.ndarray) -> np.ndarray:
        """Which waypoints are left at some times `[n]`: `[n, W]` bool."""
        return self.arrivals > seconds[:, None] + 1e-6

    def goal(self, seconds: np.ndarray) -> np.ndarray:
        """The waypoint that it is on its way to at some times `[n]`: `[n, 3]`, metres."""
        reached = (~self.left(seconds)).sum(-1)
        return self.waypoints[np.minimum(reached, len(self.waypoints) - 1)]

    def place(self, seconds: np.ndarray) -> np.ndarray:
        """Where the base is at some times `[n]`: `[n, 3]`, metres."""
        return between(self.position, self.times, seconds)

    def at(self, model: mujoco.MjModel, seconds: np.ndarray) -> np.ndarray:
        """Poses `[n, nq]` at some times `[n]`, between the steps on the straight way."""
        before = np.clip(seconds // self.dt, 0, len(self.qpos) - 2).astype(int)
        share = seconds / self.dt - before
        way, poses = np.zeros(model.nv), self.qpos[before].astype(float)
        for pose, after, part in zip(poses, self.qpos[before + 1], share, strict=True):
            mujoco.mj_differentiatePos(model, way, 1.0, pose, after.astype(float))
            mujoco.mj_integratePos(model, pose, way, part)
        return poses


@dataclasses.dataclass(frozen=True)
class Video:
    """Clips of one robot.

    Attributes:
      title: what the video is of.
      visual_model: what the robot looks like.
      clips: its journeys.
      goal_radius: metres; a waypoint is reached when the robot is this near.
    """

    title: str
    visual_model: mujoco.MjSpec
    clips: list[Clip]
    goal_radius: float


def between(x: np.ndarray, times: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """`x [t, n]`, known at some times `[t]`, at others `[m]`: `[m, n]`, on straight lines."""
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
    """Leads robots through waypoints, and keeps every pose.

    Args:
      robot: what walks.
      controller: its controller.
      waypoints: `[W, 2]` or `[W, 3]`, metres, or for each robot its own, `[B, W, 2]`.
      keys: `[B]`, of the starts.
      yaw: `[B]`, radians, that the starts are turned by.
      settings: length of a journey, goal radius.
      title: what the video is of; the robot's name, unless given.
      quiet: no progress bar.

    Raises:
      BadInput: the robot has no visual model, or the waypoints are none.
    """
    settings, visual_model = settings or WaypointSettings(), robot.visual_model()
    fill = np.arange(-(-len(keys) // LANES) * LANES) % len(keys)
    points = np.asarray(waypoints)
    made = follow_waypoints(
        robot, controller, points[fill] if points.ndim == 3 else points, keys[fill], yaw[fill],
        settings=settings, record=operator.attrgetter("physics"), quiet=quiet,
    )  # fmt: skip
    clips = list(_clips(made, robot.visual_qpos(made.recorded)))[: len(keys)]
    return Video(title or robot.name, visual_model, clips, settings.goal_radius)


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
    """Episodes of the test (A.1.3), from the same starts to the same targets.

    It walks anew. Float sums depend on how many robots walk at once, and walking is chaotic:
    after some seconds a video may go another way than the test went (see `render_recorded`).

    Args:
      robot: what walks.
      controller: its controller.
      episodes: their numbers in the test seed, from 0 on.
      seed: of the test.
      seconds: a longer episode ends here.
      title: what the video is of; the robot's name, unless given.
      quiet: no progress bar.

    Raises:
      BadInput: the robot has no visual model, or there is no such episode.
    """
    robot.visual_model()  # before anything is computed
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
    """Episodes of a test as they went: the recordings that the test has kept.

    Args:
      robot: what walked.
      test: the directory of a finished test (test-METHOD-SEED-…).
      episodes: their numbers in its first seed; all that it has recorded, unless given.
      seconds: a longer episode is cut here.
      title: what the video is of; the robot's name, unless given.

    Raises:
      BadInput: the robot has no visual model, or the test has not recorded the episodes.
    """
    visual_model, settings = robot.visual_model(), _said(test, "test")
    tree, _ = load_arrays(Path(test) / "episodes")
    recordings, outcome = tree.get("recordings", {}), tree["episodes"]
    most, clips = steps(robot, seconds, settings["max_steps"]), list[Clip]()
    for i in episodes or sorted(map(int, recordings)) or EPISODES:
        if str(i) not in recordings:
            raise BadInput(f"{test} has no recording of episode {i}")
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
    """Renders the controller that lies in a run's directory (METHOD-SEED-…).

    Args:
      run: the directory of a fit or a baseline, as cells leave it under --run-dir.
      episodes: numbers of the test's episodes, or of the starts; `EPISODES` and 0, unless given.
      waypoints: `[W, 2]`, metres, to lead it through; None: the targets of the test, and where
        one of the run's tests has recorded the episodes, as they went.
      seed: of the test, or of the starts.
      seconds: a longer journey ends here.
      goal_radius: metres; a given waypoint is reached when it is this near (the test has its own).
      engine: that steps the robot; the run's own, unless given.
      robot: what walks; as the run's config has it, unless given.

    Raises:
      BadInput: no controller lies there, its robot has no visual model, or a number cannot be.
    """
    starts = episodes or (EPISODES if waypoints is None else (0,))
    highest, robot = count_to(starts, seed), robot or robot_of(run, engine)
    title = f"{_said(run, 'method')}, {robot.name}"
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
    """The newest test of a run, on the robot's engine, that has recorded some episodes.

    Args:
      run: the directory of a fit or a baseline.
      robot: what walks.
      episodes: those that it must have recorded; any, unless given.
    """
    run = Path(run).resolve()
    done = sorted(run.parent.glob("test-*/done.json"), key=lambda p: p.stat().st_mtime)
    for test in (path.parent for path in reversed(done)):
        try:
            of = _said(test, "fit"), _said(test, "engine")
        except BadInput:
            continue  # somebody else's: no reason to have no video at all
        if of == (run.name, robot.engine_name):
            # By its files' names: who reads them sees whether they are whole.
            names = [name.split(".") for name in load_json(test / "episodes" / MANIFEST)]
            kept = {name[1] for name in names if name[0] == "recordings"}
            if kept and kept.issuperset(map(str, episodes)):
                return test
    return None


def count_to(episodes: Sequence[int], seed: int = 0) -> int:
    """How many there must be, so that there are episodes of these numbers.

    Raises:
      BadInput: there is no such episode, none is named, or there is no such seed.
    """
    check_value("the seed of a video", seed, count(0, 2**32 - 1))
    if not episodes:
        raise BadInput("a video is of at least one episode")
    for i in episodes:
        check_value("the number of an episode", i, count(0, MOST_EPISODES - 1))
    return max(episodes) + 1


def steps(robot: Robot, seconds: float, most: int) -> int:
    """Control steps in so many seconds, at most `most`.

    Raises:
      BadInput: not a step fits into them.
    """
    if not seconds >= robot.dt:
        raise BadInput(f"a video of the {robot.name} takes at least {robot.dt} s")
    return int(min(seconds / robot.dt, most))


def robot_of(run: Path | str, engine: str | None = None) -> Robot:
    """The robot that a run's controller was made for, with the settings it had.

    A fit's config leaves them to the experience beside it; where that is gone, the robot is
    taken as it comes. `engine` takes the place of the run's own.

    Raises:
      BadInput: it is not the directory of a finished run, or no robot can be made so.
    """
    run, name = Path(run), _said(run, "robot")
    experience = Stage(run).summary().get("experience")
    for stage in (run, run.parent / experience) if experience else (run,):
        try:
            settings = load_json(stage / "config.json")["config"].get("robot")
        except Corrupt:
            continue
        if settings:
            return remade(settings | ({"engine": engine} if engine else {}))
    return by_name(name, engine)


def _said(directory: Path | str, name: str) -> Any:
    """What the summary of a finished stage says; BadInput where it does not say it."""
    summary = Stage(Path(directory)).summary()
    if not isinstance(summary, dict) or name not in summary:
        raise BadInput(f"{directory} cannot be filmed: its done.json names no {name}")
    return summary[name]


def _clips(made: WaypointRuns, qpos: np.ndarray) -> Iterator[Clip]:
    for i, states in enumerate(made.steps + 1):
        yield Clip(
            qpos=qpos[i, :states],
            position=made.position[i, :states],
            waypoints=made.waypoints[i],
            arrival=made.arrival[i],
            fell=bool(made.fell[i]),
            dt=made.dt,
        )
