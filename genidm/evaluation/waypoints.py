"""Waypoints (§5.3, Fig. 7): a planner gives the next target, and the controller walks to it."""

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
from genidm.evaluation.planners import Planner, first_unreached, with_heading
from genidm.progress import Progress, compile_ahead
from genidm.robots.base import Robot, State, select
from genidm.rollout import Move, rollout
from genidm.symmetry import horizontal_norm, wrap

# Seconds over which walking speed and direction are measured: about one stride.
SPAN = 0.5
# m/s; a slower robot has no walking direction.
STILL = 0.02

# State [B] → a tree of arrays [B, ...], which is kept of every state.
Record = Callable[[State], Any]


def nothing(_: State) -> tuple[()]:
    """Keep positions and headings only."""
    return ()


@dataclasses.dataclass(frozen=True)
class WaypointSettings:
    """Settings of a run through waypoints.

    Attributes:
      max_steps: maximum number of steps.
      goal_radius: metres, horizontal; at this distance, the first unreached waypoint is reached.
      chunk: steps per program call.
    """

    max_steps: int = 2000
    goal_radius: float = 0.25
    chunk: int = 50

    def __post_init__(self) -> None:
        steps, chunk = count(1, 10**6), count(1, MOST_AT_ONCE)
        check(self, max_steps=steps, chunk=chunk, goal_radius=positive())


@dataclasses.dataclass(frozen=True)
class WaypointRuns:
    """B runs through W waypoints, with T steps in the longest.

    Attributes:
      waypoints: `[B, W, 3]`, metres.
      position: `[B, T + 1, 3]`, metres; constant after the end of a run.
      heading: `[B, T + 1]`, radians.
      steps: `[B]`, number of steps.
      arrival: `[B, W]`, step at which a waypoint was reached; −1 if it was not.
      fell: `[B]` bool; a fall or diverged physics ended the run.
      dt: seconds per step.
      recorded: tree of arrays `[B, T + 1, ...]`, what `record` kept.
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
        """`[B, T + 1]` bool, False after the end of a run."""
        return np.arange(self.position.shape[1]) <= self.steps[:, None]

    @property
    def times(self) -> np.ndarray:
        """Seconds to each waypoint `[B, W]`; NaN if it was not reached."""
        return np.where(self.arrival < 0, np.nan, self.arrival * self.dt)

    @property
    def cross_track_error(self) -> np.ndarray:
        """Distance `[B, T + 1]` from the current leg, metres; NaN after the end.

        A leg is the straight line from the last waypoint (at first the start) to the next.
        """
        corners = self._corners()
        begin, end = (np.take_along_axis(corners, self._leg(k), axis=1) for k in (0, 1))
        offset, leg = self.position[..., :2] - begin, end - begin
        squared_length = np.maximum((leg**2).sum(-1), 1e-12)
        fraction = np.clip((offset * leg).sum(-1) / squared_length, 0.0, 1.0)
        distance = np.linalg.norm(offset - fraction[..., None] * leg, axis=-1)
        return np.where(self.made, distance, np.nan)

    @property
    def speed(self) -> np.ndarray:
        """Walking speed `[B, T + 1]`, m/s, without the sway of the gait; NaN after the end.

        It is the distance between the positions a quarter of a second before and after, by time.
        """
        return np.where(self.made, np.linalg.norm(self._velocity, axis=-1), np.nan)

    @property
    def heading_error(self) -> np.ndarray:
        """Angle `[B, T + 1]` between heading and walking direction, radians; NaN without motion.

        The walking direction is that of the displacement of which `speed` is the length.
        """
        course = np.arctan2(self._velocity[..., 1], self._velocity[..., 0])
        angle = np.abs(wrap(jnp.asarray(self.heading - course)))
        return np.where(self.speed > STILL, angle, np.nan)

    @property
    def leg_speed(self) -> np.ndarray:
        """Mean speed on each leg `[W]`, m/s, over the steps of all runs; NaN if there are none."""
        speed, leg = self.speed, self._leg(0)[..., 0]
        found = (speed[self.made & (leg == i)] for i in range(self.waypoints.shape[1]))
        return np.asarray([x.mean() if len(x) else np.nan for x in found])

    @property
    def typical(self) -> int:
        """Index of the median run: by the waypoints that it reached, then by its duration."""
        order = np.lexsort((self.steps, -(self.arrival >= 0).sum(1)))
        return int(order[len(order) // 2])

    def summary(self) -> dict[str, Any]:
        """Means over the runs: metres, seconds, m/s, radians, fractions of the runs.

        `reached`, `seconds` (from the start) and `leg_speed` have a value for each waypoint;
        `all` is the fraction of the runs that reached every waypoint. A mean of nothing is None.
        """
        reached, times = self.arrival >= 0, self.times.T
        return {
            "runs": len(self.steps),
            "cross_track_error": _mean(self.cross_track_error),
            "heading_error": _mean(self.heading_error),
            "speed": _mean(self.speed),
            "leg_speed": [_mean(x) for x in self.leg_speed],
            "reached": reached.mean(0).tolist(),
            "all": float(reached.all(1).mean()),
            "seconds": [_mean(t) for t in times],
            "fell": float(self.fell.mean()),
        }

    @functools.cached_property
    def _velocity(self) -> np.ndarray:
        """Displacement `[B, T + 1, 2]` from 0.25 s before to 0.25 s after, by time, m/s."""
        side, step = max(1, round(SPAN / 2 / self.dt)), np.arange(self.position.shape[1])
        after = np.minimum(step + side, self.steps[:, None])
        before = np.minimum(np.maximum(step - side, 0), after)
        run, seconds = np.arange(len(after))[:, None], self.dt * np.maximum(after - before, 1)
        moved = self.position[run, after, :2] - self.position[run, before, :2]
        return moved / seconds[..., None]

    def _corners(self) -> np.ndarray:
        """The start and the waypoints `[B, W + 1, 2]`."""
        return np.concatenate([self.position[:, :1, :2], self.waypoints[..., :2]], axis=1)

    def _leg(self, end: int) -> np.ndarray:
        """Corner `[B, T + 1, 1]` at the start (`end` = 0) or the end (`end` = 1) of the leg."""
        step = np.arange(self.position.shape[1])
        arrived = (self.arrival[:, None] >= 0) & (self.arrival[:, None] < step[:, None])
        return np.minimum(arrived.sum(-1), self.waypoints.shape[1] - 1)[..., None] + end


def _mean(x: np.ndarray) -> float | None:
    """The mean of the finite numbers; None if there are none."""
    finite = np.asarray(x)[np.isfinite(x)]
    return float(finite.mean()) if len(finite) else None


class Walker(flax.struct.PyTreeNode):
    """State of B runs between two steps.

    Attributes:
      robots: State `[B]`.
      waypoints: `[B, W, 3]`, metres.
      arrival: `[B, W]`, step at which a waypoint was reached; −1 if it is not reached.
      steps: `[B]`, number of steps so far.
      going: `[B]` bool, False after the end of a run.
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
    """Make robots walk through waypoints in order (§5.3).

    Args:
      robot: robot to control.
      controller: (s, relative goal) → a; the goal is the planner's target.
      waypoints: `[W, 2]` or `[W, 3]`, metres, or different ones per robot, `[B, W, 2]` or
        `[B, W, 3]`; the default height is that of a standing robot.
      keys: random keys `[B]` of the starts.
      yaw: `[B]`, rotations of the starts, radians.
      planner: (o `[B, 3]`, waypoints `[B, W, 3]`, unreached `[B, W]`) → the target `[B, 3]` to walk
        to now, in the world's frame, at each step; the default is the next waypoint. A planner
        with an argument `heading` also gets the headings `[B]`, radians.
      settings: length of a run, goal radius.
      record: what to keep of every state with position and heading; by default nothing.
      mesh: devices that share the robots; None takes those of the robot's engine.
      quiet: do not show a progress bar.

    Raises:
      BadInput: waypoints are empty, or are not two or three finite numbers each; keys and yaw
        have different shapes; there are no robots; planner or controller return a wrong shape.
    """
    settings, mesh = settings or WaypointSettings(), mesh or robot.mesh()
    if jnp.ndim(keys) != 1 or jnp.shape(yaw) != keys.shape:
        raise BadInput(f"keys [B] and yaw [B] have shapes {jnp.shape(keys)} and {jnp.shape(yaw)}")
    if not len(keys):
        raise BadInput("there are no robots: keys [B] is empty")
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
            walker, kept = step(controller, walker)
            seen.append(jax.tree.map(np.asarray, kept))
            bar.advance(min(settings.chunk, settings.max_steps - made))
            if not np.asarray(walker.going).any():
                break
    return _waypoint_runs(robot, walker, seen, len(yaw))


def in_twos(numbers: Sequence[float]) -> np.ndarray:
    """Make waypoints `[W, 2]` from the numbers x, y, x, y, … of a command line.

    Raises:
      BadInput: the number of numbers is odd.
    """
    if len(numbers) % 2:
        raise BadInput(f"waypoints are x and y, x and y, …: an even number, not {len(numbers)}")
    return np.reshape(numbers, (-1, 2))


def _start(robot: Robot, points: np.ndarray, keys: jax.Array, yaw: jax.Array, mesh: Mesh) -> Walker:
    """Reset the robots; repeat some, so that the devices share them evenly."""
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
    """Make the runs of the first `count` robots from parts `[steps, B, ...]`."""
    steps = np.asarray(walker.steps)[:count]
    end = steps.max() + 1  # the last chunk may be longer

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
    """Waypoints `[B, W, 3]` of `count` robots; raises BadInput if they are invalid."""
    try:
        points = np.asarray(waypoints, float)
    except ValueError:
        raise BadInput(
            "waypoints are rows of two or three numbers, all of the same length"
        ) from None
    shaped = points.ndim in (2, 3) and points.shape[-1] in (2, 3) and points.shape[-2] > 0
    if not shaped or (points.ndim == 3 and len(points) != count):
        raise BadInput(
            f"waypoints are rows of two or three numbers, for all robots or for each of the "
            f"{count}, not of shape {points.shape}"
        )
    if not np.isfinite(points).all():
        raise BadInput("waypoints must be finite numbers")
    z = np.full((*points.shape[:-1], 3 - points.shape[-1]), height)
    points = np.concatenate([points, z], axis=-1)
    return np.broadcast_to(points, (count, *points.shape[-2:]))


def _chunk(
    robot: Robot,
    planner: Planner,
    settings: WaypointSettings,
    look: Record,
    controller: ControllerFn,
    walker: Walker,
) -> tuple[Walker, Any]:
    """Step the robots `settings.chunk` times; return what is kept, `[chunk, B, ...]`.

    The state of a run does not change after its end.
    """
    points = walker.waypoints

    def act(walker: Walker, _: None) -> tuple[State, jax.Array, None]:
        robots = walker.robots
        o = robots.position
        plan = with_heading(planner, robots.heading)
        target = ask("the planner", plan, o.shape, o, points, walker.arrival < 0)
        target = target.astype(o.dtype)
        return robots, steered(robot, controller, robots, target), None

    def watch(walker: Walker, move: Move) -> tuple[Walker, Any]:
        after, steps, unreached = move.after, walker.steps + 1, walker.arrival < 0
        first = unreached & (jnp.cumsum(unreached, axis=-1) == 1)
        near = horizontal_norm(points - after.position[:, None]) <= settings.goal_radius
        arrival = jnp.where(first & near, steps[:, None], walker.arrival)
        finished = (arrival >= 0).all(-1)
        over = after.fallen | after.diverged | finished | (steps >= settings.max_steps)
        walker = select(walker.going, Walker(after, points, arrival, steps, ~over), walker)
        return walker, look(walker.robots)

    return rollout(robot, act, watch, walker, steps=settings.chunk)
