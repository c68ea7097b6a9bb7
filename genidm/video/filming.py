"""A film: journeys of one robot, with the pose that it was in at every step."""

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

from genidm import checks, controller
from genidm.checks import check_value, count
from genidm.errors import BadInput
from genidm.evaluation.evaluate import Steering, Test
from genidm.evaluation.scenarios import scenarios
from genidm.evaluation.waypoints import Follow, Journeys, follow
from genidm.files import MANIFEST, Torn, load_arrays, load_json
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
class Take:
    """One journey, up to its end: t states, the start among them.

    Attributes:
      qpos: `[t, nq]`, of the drawing.
      position: `[t, 3]`, of the base, metres.
      waypoints: `[W, 3]`, metres.
      arrival: `[W]`, step at which a waypoint was reached; −1 where it was not.
      fell: whether it ended in a fall, or in physics that diverged.
      control_step: seconds from one state to the next.
    """

    qpos: np.ndarray
    position: np.ndarray
    waypoints: np.ndarray
    arrival: np.ndarray
    fell: bool
    control_step: float

    @property
    def times(self) -> np.ndarray:
        """Seconds since the start `[t]`."""
        return self.control_step * np.arange(len(self.qpos))

    @property
    def seconds(self) -> float:
        """How long it took."""
        return float(self.times[-1])

    @property
    def arrivals(self) -> np.ndarray:
        """Seconds to each waypoint `[W]`; infinite where it was not reached."""
        return np.where(self.arrival < 0, np.inf, self.control_step * self.arrival)

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
        before = np.clip(seconds // self.control_step, 0, len(self.qpos) - 2).astype(int)
        share = seconds / self.control_step - before
        way, poses = np.zeros(model.nv), self.qpos[before].astype(float)
        for pose, after, part in zip(poses, self.qpos[before + 1], share, strict=True):
            mujoco.mj_differentiatePos(model, way, 1.0, pose, after.astype(float))
            mujoco.mj_integratePos(model, pose, way, part)
        return poses


@dataclasses.dataclass(frozen=True)
class Film:
    """Takes of one robot.

    Attributes:
      title: what the film is of.
      drawing: what the robot looks like.
      takes: its journeys.
      reach: metres; a waypoint is reached when the robot is this near.
    """

    title: str
    drawing: mujoco.MjSpec
    takes: list[Take]
    reach: float


def between(x: np.ndarray, times: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """`x [t, n]`, known at some times `[t]`, at others `[m]`: `[m, n]`, on straight lines."""
    return np.stack([np.interp(seconds, times, column) for column in x.T], axis=-1)


def film(
    robot: Robot,
    steering: Steering,
    waypoints: Any,
    keys: jax.Array,
    yaw: jax.Array,
    settings: Follow | None = None,
    title: str = "",
    *,
    quiet: bool = False,
) -> Film:
    """Leads robots through waypoints, and keeps every pose.

    Args:
      robot: what walks.
      steering: its controller.
      waypoints: `[W, 2]` or `[W, 3]`, metres, or for each robot its own, `[B, W, 2]`.
      keys: `[B]`, of the starts.
      yaw: `[B]`, radians, that the starts are turned by.
      settings: length of a journey, reach.
      title: what the film is of; the robot's name, unless given.
      quiet: no progress bar.

    Raises:
      BadInput: the robot has no drawing, or the waypoints are none.
    """
    settings, drawing = settings or Follow(), robot.drawing()
    fill = np.arange(-(-len(keys) // LANES) * LANES) % len(keys)
    points = np.asarray(waypoints)
    made = follow(
        robot, steering, points[fill] if points.ndim == 3 else points, keys[fill], yaw[fill],
        settings=settings, watch=operator.attrgetter("physics"), quiet=quiet,
    )  # fmt: skip
    takes = list(_takes(made, robot.posture(made.watched)))[: len(keys)]
    return Film(title or robot.name, drawing, takes, settings.reach)


def film_test(
    robot: Robot,
    steering: Steering,
    episodes: Sequence[int] = EPISODES,
    seed: int = 0,
    seconds: float = LONGEST,
    title: str = "",
    *,
    quiet: bool = False,
) -> Film:
    """Episodes of the test (A.1.3), from the same starts to the same targets.

    It walks anew. Float sums depend on how many robots walk at once, and walking is chaotic:
    after some seconds a film may go another way than the test went (see `film_tested`).

    Args:
      robot: what walks.
      steering: its controller.
      episodes: their numbers in the test seed, from 0 on.
      seed: of the test.
      seconds: a longer episode ends here.
      title: what the film is of; the robot's name, unless given.
      quiet: no progress bar.

    Raises:
      BadInput: the robot has no drawing, or there is no such episode.
    """
    robot.drawing()  # before anything is computed
    bank, test = scenarios(robot, 1, count_to(episodes, seed), first_seed=seed), Test()
    settings = Follow(steps(robot, seconds, test.max_steps), test.reach)
    keys, yaw, target = (x[0, np.asarray(episodes)] for x in (bank.keys, bank.yaw, bank.target))
    return film(robot, steering, target[:, None], keys, yaw, settings, title, quiet=quiet)


def film_tested(
    robot: Robot,
    test: Path | str,
    episodes: Sequence[int] = (),
    seconds: float = LONGEST,
    title: str = "",
) -> Film:
    """Episodes of a test as they went: the recordings that the test has kept.

    Args:
      robot: what walked.
      test: the directory of a finished test (test-METHOD-SEED-…).
      episodes: their numbers in its first seed; all that it has recorded, unless given.
      seconds: a longer episode is cut here.
      title: what the film is of; the robot's name, unless given.

    Raises:
      BadInput: the robot has no drawing, or the test has not recorded the episodes.
    """
    drawing, settings = robot.drawing(), _said(test, "test")
    tree, _ = load_arrays(Path(test) / "episodes")
    recordings, outcome = tree.get("recordings", {}), tree["episodes"]
    most, takes = steps(robot, seconds, settings["max_steps"]), list[Take]()
    for i in episodes or sorted(map(int, recordings)) or EPISODES:
        if str(i) not in recordings:
            raise BadInput(f"{test} has no recording of episode {i}")
        made = recordings[str(i)]
        last = len(made["qpos"]) - 1
        reached, fell = (bool(outcome[name][0, i]) and last <= most for name in ("reached", "fell"))
        takes.append(
            Take(
                qpos=made["qpos"][: most + 1],
                position=made["position"][: most + 1],
                waypoints=made["target"][None],
                arrival=np.asarray([last if reached else -1]),
                fell=fell,
                control_step=robot.control_step,
            )
        )
    return Film(title or robot.name, drawing, takes, settings["reach"])


def film_run(
    run: Path | str,
    episodes: Sequence[int] = (),
    waypoints: Any = None,
    seed: int = 0,
    seconds: float = LONGEST,
    reach: float = Follow.reach,
    engine: str | None = None,
    robot: Robot | None = None,
) -> Film:
    """Films the controller that lies in a run's directory (METHOD-SEED-…).

    Args:
      run: the directory of a fit or a baseline, as cells leave it under --out.
      episodes: numbers of the test's episodes, or of the starts; `EPISODES` and 0, unless given.
      waypoints: `[W, 2]`, metres, to lead it through; None: the targets of the test, and where
        one of the run's tests has recorded the episodes, as they went.
      seed: of the test, or of the starts.
      seconds: a longer journey ends here.
      reach: metres; a given waypoint is reached when it is this near (the test has its own).
      engine: that steps the robot; the run's own, unless given.
      robot: what walks; as the run's config has it, unless given.

    Raises:
      BadInput: no controller lies there, its robot has no drawing, or a number cannot be.
    """
    starts = episodes or (EPISODES if waypoints is None else (0,))
    highest, robot = count_to(starts, seed), robot or robot_of(run, engine)
    title = f"{_said(run, 'method')}, {robot.name}"
    if waypoints is None:
        test = recorded(run, robot, episodes) if seed == 0 else None
        if test:
            return film_tested(robot, test, episodes, seconds, title)
        return film_test(robot, controller.load(run, robot), starts, seed, seconds, title)
    check_value("seed", seed, checks.seed())
    keys = jax.random.split(jax.random.key(seed), highest)[np.asarray(starts)]
    settings = Follow(steps(robot, seconds, Follow.max_steps), reach)
    steering = controller.load(run, robot)
    return film(robot, steering, waypoints, keys, jnp.zeros(len(keys)), settings, title)


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
            continue  # somebody else's: no reason to have no film at all
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
    check_value("the seed of a film", seed, count(0, 2**32 - 1))
    if not episodes:
        raise BadInput("a film is of at least one episode")
    for i in episodes:
        check_value("the number of an episode", i, count(0, MOST_EPISODES - 1))
    return max(episodes) + 1


def steps(robot: Robot, seconds: float, most: int) -> int:
    """Control steps in so many seconds, at most `most`.

    Raises:
      BadInput: not a step fits into them.
    """
    if not seconds >= robot.control_step:
        raise BadInput(f"a film of the {robot.name} takes at least {robot.control_step} s")
    return int(min(seconds / robot.control_step, most))


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
        except Torn:
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


def _takes(made: Journeys, qpos: np.ndarray) -> Iterator[Take]:
    for i, states in enumerate(made.steps + 1):
        yield Take(
            qpos=qpos[i, :states],
            position=made.position[i, :states],
            waypoints=made.waypoints[i],
            arrival=made.arrival[i],
            fell=bool(made.fell[i]),
            control_step=made.control_step,
        )
