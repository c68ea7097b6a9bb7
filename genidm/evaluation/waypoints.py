"""Through waypoints (§5.3, Fig. 7): a planner says where to go, the controller goes there."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from genidm import devices
from genidm.checks import check, count, positive
from genidm.errors import BadInput
from genidm.evaluation.evaluator import MOST_AT_ONCE, ControllerFn, as_tree, ask, steered
from genidm.progress import Progress, compile_ahead
from genidm.robots.base import Robot, State, select
from genidm.rollout import Move, rollout
from genidm.symmetry import horizontal_norm, wrap

# (o [B, 3], waypoints [B, W, 3], which of them are left [B, W] bool) → where to go now [B, 3],
# metres, world frame; asked anew at each step.
Planner = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]


def first_unreached(o: jax.Array, waypoints: jax.Array, left: jax.Array) -> jax.Array:
    """Straight to the first waypoint that is left; to the last one when none is."""
    first = jnp.where(left.any(-1), jnp.argmax(left, axis=-1), waypoints.shape[1] - 1)
    return jnp.take_along_axis(waypoints, first[:, None, None], axis=1)[:, 0]


# State [B] → a tree of arrays [B, ...]: what is kept of every state on the way.
Record = Callable[[State], Any]


def nothing(_: State) -> tuple[()]:
    """Keeps positions and headings alone."""
    return ()


@dataclasses.dataclass(frozen=True)
class WaypointSettings:
    """Settings of a journey.

    Attributes:
      max_steps: it ends after this many steps.
      goal_radius: metres, horizontal; a waypoint is reached when it is this near and its turn.
      chunk: steps a program call.
    """

    max_steps: int = 2000
    goal_radius: float = 0.25
    chunk: int = 50

    def __post_init__(self) -> None:
        steps, chunk = count(1, 10**6), count(1, MOST_AT_ONCE)
        check(self, max_steps=steps, chunk=chunk, goal_radius=positive())


@dataclasses.dataclass(frozen=True)
class WaypointRuns:
    """B journeys through W waypoints, over T steps at most.

    Attributes:
      waypoints: `[B, W, 3]`, metres.
      position: `[B, T + 1, 3]`, metres; of a journey that is over, where it ended.
      heading: `[B, T + 1]`, radians.
      steps: `[B]`, that were made.
      arrival: `[B, W]`, step at which a waypoint was reached; −1 where it was not.
      fell: `[B]` bool; ended by a fall, or by physics that diverged.
      dt: seconds.
      recorded: tree of arrays `[B, T + 1, ...]`, that was asked for beside.
    """

    waypoints: np.ndarray
    position: np.ndarray
    heading: np.ndarray
    steps: np.ndarray
    arrival: np.ndarray
    fell: np.ndarray
    dt: float
    recorded: Any = ()

    @property
    def made(self) -> np.ndarray:
        """`[B, T + 1]` bool, whether the journey was still going on."""
        return np.arange(self.position.shape[1]) <= self.steps[:, None]

    @property
    def times(self) -> np.ndarray:
        """Seconds to each waypoint `[B, W]`; NaN where it was not reached."""
        return np.where(self.arrival < 0, np.nan, self.arrival * self.dt)

    @property
    def cross_track_error(self) -> np.ndarray:
        """Metres `[B, T + 1]` from the leg that the robot was on; NaN after the end.

        A leg is the straight line from the last waypoint, at first the start, to the next.
        """
        corners = self._corners()
        begin, end = (np.take_along_axis(corners, self._leg(k), axis=1) for k in (0, 1))
        way, along = self.position[..., :2] - begin, end - begin
        length = np.maximum((along**2).sum(-1), 1e-12)
        share = np.clip((way * along).sum(-1) / length, 0.0, 1.0)
        apart = np.linalg.norm(way - share[..., None] * along, axis=-1)
        return np.where(self.made, apart, np.nan)

    @property
    def heading_error(self) -> np.ndarray:
        """Radians `[B, T]` between the heading and the motion; NaN where there is none."""
        motion = np.diff(self.position[..., :2], axis=1)
        course = np.arctan2(motion[..., 1], motion[..., 0])
        angle = np.abs(wrap(jnp.asarray(self.heading[:, :-1] - course)))
        moves = self.made[:, 1:] & (np.linalg.norm(motion, axis=-1) > 1e-3)
        return np.where(moves, angle, np.nan)

    def summary(self) -> dict[str, Any]:
        """Means over the journeys: metres, seconds, radians, shares of the journeys."""
        reached, heading_error = self.arrival >= 0, self.heading_error
        times = [t[np.isfinite(t)] for t in self.times.T]
        return {
            "runs": len(self.steps),
            "cross_track_error": float(np.nanmean(self.cross_track_error)),
            "heading_error": float(np.nanmean(heading_error))
            if np.isfinite(heading_error).any()
            else None,
            "reached": reached.mean(0).tolist(),
            "seconds": [float(t.mean()) if len(t) else None for t in times],
            "fell": float(self.fell.mean()),
        }

    def _corners(self) -> np.ndarray:
        """The start and the waypoints `[B, W + 1, 2]`."""
        return np.concatenate([self.position[:, :1, :2], self.waypoints[..., :2]], axis=1)

    def _leg(self, end: int) -> np.ndarray:
        """Index `[B, T + 1, 1]` of a leg's beginning (0) or end (1) among the corners."""
        step = np.arange(self.position.shape[1])
        arrived = (self.arrival[:, None] >= 0) & (self.arrival[:, None] < step[:, None])
        return np.minimum(arrived.sum(-1), self.waypoints.shape[1] - 1)[..., None] + end


class Walker(flax.struct.PyTreeNode):
    """Robots on their way: where to, when they arrived there, and whether they go on.

    Attributes:
      robots: State `[B]`.
      waypoints: `[B, W, 3]`, metres.
      arrival: `[B, W]`, step at which a waypoint was reached; −1 where it was not.
      steps: `[B]`, made so far.
      going: `[B]` bool.
    """

    robots: State
    waypoints: jax.Array
    arrival: jax.Array
    steps: jax.Array
    going: jax.Array


def follow_waypoints(
    robot: Robot,
    controller: ControllerFn,
    waypoints: np.ndarray,
    keys: jax.Array,
    yaw: jax.Array,
    planner: Planner = first_unreached,
    settings: WaypointSettings | None = None,
    *,
    record: Record = nothing,
    mesh: Mesh | None = None,
    quiet: bool = False,
) -> WaypointRuns:
    """Leads robots through waypoints, each in its turn.

    Args:
      robot: what walks.
      controller: what steers it; it is given the way to where the planner says.
      waypoints: `[W, 2]` or `[W, 3]`, metres, or for each robot its own, `[B, W, 2]` or
        `[B, W, 3]`; without a height they have a standing robot's.
      keys: `[B]`, of the starts.
      yaw: `[B]`, radians, that the starts are turned by.
      planner: where to go next; straight to the next waypoint, unless given.
      settings: length of a journey, goal radius.
      record: what to keep of every state beside position and heading; nothing, unless given.
      mesh: devices to share the robots among; as their engine wants, unless given.
      quiet: no progress bar.

    Raises:
      BadInput: no waypoints, or not of two or three finite numbers each; not a yaw a key; no
        robots; planner or controller answer something else than they should.
    """
    settings, mesh = settings or WaypointSettings(), mesh or robot.mesh()
    if jnp.ndim(keys) != 1 or jnp.shape(yaw) != keys.shape:
        raise BadInput(f"keys [B] and yaw [B] are of {jnp.shape(keys)} and {jnp.shape(yaw)}")
    if not len(keys):
        raise BadInput("there are no robots to lead: keys [B] is empty")
    points = _checked(waypoints, len(keys), robot.standing_height)
    walker = _start(robot, points, keys, yaw, mesh)
    controller = devices.put(as_tree(controller), mesh, None)
    look = functools.partial(_seen, record)
    body = functools.partial(_chunk, robot, planner, settings, look)
    sharded = devices.over_lanes(body, mesh, [None, 0], (0, 1))
    step = compile_ahead("waypoints", jax.jit(sharded, donate_argnums=1), controller, walker)
    seen = [jax.tree.map(lambda x: np.asarray(x)[None], look(walker.robots))]
    with Progress("waypoints", settings.max_steps, "steps", quiet=quiet) as bar:
        for made in range(0, settings.max_steps, settings.chunk):
            walker, way = step(controller, walker)
            seen.append(jax.tree.map(np.asarray, way))
            bar.advance(min(settings.chunk, settings.max_steps - made))
            if not np.asarray(walker.going).any():
                break
    return _waypoint_runs(robot, walker, seen, len(yaw))


def in_twos(numbers: Sequence[float]) -> np.ndarray:
    """Waypoints `[W, 2]` from x and y, x and y, …, as a command line gives them.

    Raises:
      BadInput: a number is left over.
    """
    if len(numbers) % 2:
        raise BadInput(f"waypoints are x and y of each: an even number, not {len(numbers)}")
    return np.reshape(numbers, (-1, 2))


def _start(robot: Robot, points: np.ndarray, keys: jax.Array, yaw: jax.Array, mesh: Mesh) -> Walker:
    """Robots at their starts; some twice, where the devices could not share them evenly."""
    fill = np.arange(-(-len(yaw) // mesh.size) * mesh.size) % len(yaw)
    walker = Walker(
        robots=jax.jit(robot.reset)(keys[fill], jnp.asarray(yaw, jnp.float32)[fill]),
        waypoints=jnp.asarray(points, jnp.float32)[fill],
        arrival=jnp.full((len(fill), points.shape[1]), -1, jnp.int32),
        steps=jnp.zeros(len(fill), jnp.int32),
        going=jnp.ones(len(fill), bool),
    )
    return devices.put(walker, mesh)


def _seen(record: Record, robots: State) -> tuple[jax.Array, jax.Array, Any]:
    return robots.position, robots.heading, record(robots)


def _waypoint_runs(robot: Robot, walker: Walker, seen: list[Any], count: int) -> WaypointRuns:
    """What has become of the first `count` robots, seen `[steps, B, ...]` again and again."""
    steps = np.asarray(walker.steps)[:count]
    end = steps.max() + 1  # the last chunk may go on beyond it

    def join(*parts: Any) -> np.ndarray:
        return np.concatenate(parts).swapaxes(0, 1)[:count, :end]

    position, heading, recorded = jax.tree.map(join, *seen)
    robots = walker.robots
    return WaypointRuns(
        waypoints=np.asarray(walker.waypoints)[:count],
        position=position,
        heading=heading,
        steps=steps,
        arrival=np.asarray(walker.arrival)[:count],
        fell=np.asarray(robots.fallen | robots.diverged)[:count],
        dt=robot.dt,
        recorded=recorded,
    )


def _checked(waypoints: Any, count: int, height: float) -> np.ndarray:
    """Waypoints `[B, W, 3]` of so many robots; raises BadInput for what is none."""
    try:
        points = np.asarray(waypoints, float)
    except ValueError:
        raise BadInput("waypoints are rows of two or three numbers, each of as many") from None
    shaped = points.ndim in (2, 3) and points.shape[-1] in (2, 3) and points.shape[-2] > 0
    if not shaped or (points.ndim == 3 and len(points) != count):
        raise BadInput(
            f"waypoints are rows of two or three numbers, for all robots or for each of the "
            f"{count}, not of shape {points.shape}"
        )
    if not np.isfinite(points).all():
        raise BadInput("waypoints must be finite numbers")
    level = np.full((*points.shape[:-1], 3 - points.shape[-1]), height)
    points = np.concatenate([points, level], axis=-1)
    return np.broadcast_to(points, (count, *points.shape[-2:]))


def _chunk(
    robot: Robot,
    planner: Planner,
    settings: WaypointSettings,
    look: Record,
    controller: ControllerFn,
    walker: Walker,
) -> tuple[Walker, Any]:
    """`settings.chunk` steps; and what is seen `[chunk, B, ...]` after each.

    Robots that have ended stay as they are.
    """
    points = walker.waypoints

    def act(walker: Walker, _: None) -> tuple[State, jax.Array, None]:
        robots = walker.robots
        o = robots.position
        target = ask("the planner", planner, o.shape, o, points, walker.arrival < 0)
        target = target.astype(o.dtype)
        return robots, steered(robot, controller, robots, target), None

    def watch(walker: Walker, move: Move) -> tuple[Walker, Any]:
        after, steps, left = move.after, walker.steps + 1, walker.arrival < 0
        turn = left & (jnp.cumsum(left, axis=-1) == 1)  # the first that is left
        near = horizontal_norm(points - after.position[:, None]) <= settings.goal_radius
        arrival = jnp.where(turn & near, steps[:, None], walker.arrival)
        through = (arrival >= 0).all(-1)
        over = after.fallen | after.diverged | through | (steps >= settings.max_steps)
        walker = select(walker.going, Walker(after, points, arrival, steps, ~over), walker)
        return walker, look(walker.robots)

    return rollout(robot, act, watch, walker, steps=settings.chunk)
