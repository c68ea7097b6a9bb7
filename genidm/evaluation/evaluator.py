"""The compiled program of the test: a lane takes the next scenario when its episode ends.

Every device has its own queue of scenarios, so that no lane waits for the longest episode
of a batch.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from genidm import devices
from genidm.checks import check, count, number
from genidm.errors import BadInput
from genidm.evaluation.scenarios import Scenarios
from genidm.paper import protocol
from genidm.progress import compile_ahead
from genidm.robots.base import Robot, State, select
from genidm.rollout import Move, rollout
from genidm.symmetry import horizontal_norm

# Bounds of the memory: steps of an episode (its trace), and of a program call (its outputs).
MOST_STEPS = 10**5
MOST_AT_ONCE = 10**4

# (s [B, S], relative goal [B, 3]) → a [B, A]. If it is a tree of arrays, one compiled program
# serves every controller of the same shape.
ControllerFn = Callable[[jax.Array, jax.Array], jax.Array]
# State [B] → a tree of arrays [B, ...], which a trace keeps of each state.
Record = Callable[[State], Any]


# Errors of jax if a user's function reads the value of a traced array.
_NOT_TRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def ask(name: str, function: Callable[..., Any], shape: tuple[int, ...], *args: Any) -> jax.Array:
    """Call a user's function inside a compiled program, and check the array that it returns.

    Args:
      name: name of the function in error messages.
      function: the user's function.
      shape: exact shape that the result must have.
      args: arguments of the function.

    Raises:
      BadInput: the result is not an array of numbers of this shape, or the function cannot
        be traced.
    """
    try:
        result = function(*args)
    except _NOT_TRACEABLE:
        raise BadInput(
            f"{name} is called inside a compiled program: it must compute with jax.numpy, and "
            "branch with jnp.where"
        ) from None
    wanted = f"{name} must return an array of numbers of shape {shape}, one row per robot"
    if not isinstance(result, jax.Array | np.ndarray):
        raise BadInput(f"{wanted}, not {result!r:.40}")
    if result.shape != shape or not (
        jnp.issubdtype(result.dtype, jnp.floating) or jnp.issubdtype(result.dtype, jnp.integer)
    ):
        raise BadInput(f"{wanted}, not {result.dtype}{list(result.shape)}")
    return jnp.asarray(result)


def as_tree(controller: ControllerFn) -> Any:
    """Make a controller an argument of a program; one that is not a tree becomes a constant.

    One compiled program serves all controllers that are trees of the same shape.
    """
    is_leaf = jax.tree.leaves(controller) == [controller]
    return jax.tree_util.Partial(controller) if is_leaf else controller


def steered(robot: Robot, controller: ControllerFn, robots: State, target: jax.Array) -> jax.Array:
    """Compute the controller's actions `[B, A]` for robots `[B]` and `target [B, 3]`, metres.

    Raises:
      BadInput: the controller does not return an array `[B, A]`.
    """
    s, relative_goal = robots.observation, target - robots.position
    shape = (len(s), robot.action.size)
    return ask("the controller", controller, shape, s, relative_goal).astype(s.dtype)


def position(state: State) -> jax.Array:
    """Keep o `[B, 3]`: the trace is the episode's trajectory."""
    return state.position


@dataclasses.dataclass(frozen=True)
class EvaluationSettings:
    """Settings of the test (A.1.3).

    Attributes:
      max_steps: maximum number of steps of an episode (A.1.3: 1000).
      goal_radius: metres; an episode ends when the target is this near.
      num_envs: robots to step at once, on all devices; see `Robot.max_parallel_envs`.
      chunk: steps per program call.
    """

    max_steps: int = protocol.MAX_STEPS
    goal_radius: float = 0.1
    num_envs: int = 512
    chunk: int = 50

    def __post_init__(self) -> None:
        steps, chunk = count(1, MOST_STEPS), count(1, MOST_AT_ONCE)
        check(self, max_steps=steps, num_envs=count(), chunk=chunk, goal_radius=number(0))


class EpisodeResults(flax.struct.PyTreeNode):
    """Results of each episode `[N]` so far; see `Episodes`."""

    closest: jax.Array
    start: jax.Array
    reached: jax.Array
    fell: jax.Array
    diverged: jax.Array
    steps: jax.Array
    path_length: jax.Array


class Running(flax.struct.PyTreeNode):
    """The lanes `[L]` of one device.

    Attributes:
      robots: State `[L]`.
      target: `[L, 3]`, metres.
      episode: `[L]` int32, index of the lane's episode among the device's n; n if idle.
      now: EpisodeResults `[L]` of the running episodes.
      taken: `[1]` int32, number of episodes that lanes have taken.
    """

    robots: State
    target: jax.Array
    episode: jax.Array
    now: EpisodeResults
    taken: jax.Array


class EvaluationState(flax.struct.PyTreeNode):
    """One device's share of the test: its lanes, and the results of its n episodes.

    Attributes:
      running: the lanes.
      ended: EpisodeResults `[n]` of the episodes that have ended.
      traces: tree `[m, max_steps + 1, ...]`, traces of the first m episodes.
    """

    running: Running
    ended: EpisodeResults
    traces: Any


class Share(NamedTuple):
    """The episodes of one device's queue.

    Attributes:
      robots: State `[n]` at the start of each.
      target: `[n, 3]`, metres.
    """

    robots: State
    target: jax.Array


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """Runs a test whose scenarios are divided among the devices.

    Attributes:
      robot: robot to control.
      scenarios: scenarios `[N]`.
      settings: settings of the test.
      mesh: devices that share the lanes and scenarios.
      traced: number of the first episodes to trace.
      record: what a trace keeps of each state.
    """

    robot: Robot
    scenarios: Scenarios
    settings: EvaluationSettings
    mesh: Mesh
    traced: int = 0
    record: Record = position

    @property
    def total(self) -> int:
        """N, number of scenarios."""
        return self.scenarios.yaw.shape[0]

    @property
    def share(self) -> int:
        """n, scenarios per device; the last scenario is repeated where a share is not full."""
        return -(-self.total // self.mesh.size)

    def start(self) -> EvaluationState:
        """Make the state before the first step, on the devices: all lanes are idle."""
        count, share = self.mesh.size, self.share
        lanes = count * min(
            -(-self.robot.max_parallel_envs(self.settings.num_envs) // count), share
        )
        running = Running(
            robots=jax.tree.map(
                lambda x: jnp.zeros((lanes, *x.shape[1:]), x.dtype), self._shares.robots
            ),
            target=jnp.zeros((lanes, 3), jnp.float32),
            episode=jnp.full(lanes, share, jnp.int32),
            now=_no_results(lanes),
            taken=jnp.zeros(count, jnp.int32),
        )
        state = EvaluationState(running, _no_results(share * count), self._no_traces())
        return devices.put(state, self.mesh)

    def _no_traces(self) -> Any:
        """Traces that hold the starts only."""
        count, share, steps = self.mesh.size, self.share, self.settings.max_steps
        # At least one per device: jax loses the sharding of an array without elements.
        each = max(1, -(-self.traced // count))

        def first(x: jax.Array) -> jax.Array:
            starts = x.reshape(count, share, *x.shape[1:])[:, :each].reshape(-1, *x.shape[1:])
            trace = jnp.zeros((len(starts), steps + 1, *x.shape[1:]), x.dtype)
            return trace.at[:, 0].set(starts)

        return jax.tree.map(first, self.record(jax.tree.map(np.asarray, self._shares.robots)))

    def prepare(
        self, controller: ControllerFn, state: EvaluationState
    ) -> Callable[[EvaluationState], EvaluationState]:
        """Compile `settings.chunk` steps of every lane; the function donates its argument."""
        controller = devices.put(as_tree(controller), self.mesh, None)
        shares = self._shares
        body = functools.partial(_chunk, self.robot, self.settings, self.record)
        sharded = devices.over_lanes(body, self.mesh, [None, 0, 0], 0)
        jitted = jax.jit(sharded, donate_argnums=1)
        program = compile_ahead("evaluation", jitted, controller, state, shares)
        return lambda state: program(controller, state, shares)

    def ended(self, state: EvaluationState) -> int:
        """Number of episodes that have ended, without those that fill a share."""
        return int((self._in_order(state.ended.steps)[: self.total] > 0).sum())

    def useful(self, state: EvaluationState, calls: int) -> float:
        """Fraction of the lane-steps of `calls` calls in which a lane had an episode."""
        steps = np.asarray(state.ended.steps).sum() + self._under_way(state).sum()
        return float(steps / (calls * self.settings.chunk * state.running.episode.shape[0]))

    def longest(self, state: EvaluationState) -> int:
        """Steps so far of the longest running episode: progress before any episode ends."""
        return int(self._under_way(state).max())

    def _under_way(self, state: EvaluationState) -> np.ndarray:
        """Steps `[lanes]` so far of each lane's episode; 0 for an idle lane."""
        return np.where(np.asarray(state.running.episode) < self.share, state.running.now.steps, 0)

    def results(self, state: EvaluationState) -> EpisodeResults:
        """Results `[N]`, in the order of the scenarios."""
        return jax.tree.map(lambda x: self._in_order(x)[: self.total], state.ended)

    def traces(self, state: EvaluationState) -> list[Any]:
        """Trace of each traced episode, a tree `[steps + 1, ...]`."""
        steps = self._in_order(state.ended.steps)
        kept = jax.tree.map(self._in_order, state.traces)
        return [jax.tree.map(lambda x, i=i: x[i, : steps[i] + 1], kept) for i in range(self.traced)]

    @functools.cached_property
    def _shares(self) -> Share:
        """Episodes `[devices × n]`; device i of D has the scenarios i, i + D, i + 2 D and so on."""
        count, share = self.mesh.size, self.share
        dealt = np.minimum(np.arange(share * count), self.total - 1)
        dealt = dealt.reshape(share, count).T.reshape(-1)
        scenarios = devices.put(jax.tree.map(lambda x: x[dealt], self.scenarios), self.mesh)
        start = jax.jit(devices.over_lanes(self.robot.reset, self.mesh, [0, 0], 0))
        return Share(start(scenarios.keys, scenarios.yaw), scenarios.target)

    def _in_order(self, x: jax.Array) -> np.ndarray:
        """Bring `[devices × n, ...]` back into the order of the scenarios."""
        dealt = np.asarray(x)
        rows = dealt.reshape(self.mesh.size, -1, *dealt.shape[1:])
        return rows.swapaxes(0, 1).reshape(dealt.shape)


def _no_results(count: int) -> EpisodeResults:
    def zeros(kind: Any = jnp.float32) -> jax.Array:
        return jnp.zeros(count, kind)  # one array per field, because all are donated

    return EpisodeResults(
        zeros(), zeros(), zeros(bool), zeros(bool), zeros(bool), zeros(jnp.int32), zeros()
    )


class _Outputs(NamedTuple):
    """Outputs of one step of L lanes.

    Attributes:
      episode: `[L]`, index of the lane's episode among the n; n if idle.
      over: `[L]` bool, the episode has ended.
      now: EpisodeResults `[L]` so far.
      kept: `[L, ...]`, what a trace keeps of the state after the step.
    """

    episode: jax.Array
    over: jax.Array
    now: EpisodeResults
    kept: Any


def _chunk(
    robot: Robot,
    settings: EvaluationSettings,
    keep: Record,
    controller: ControllerFn,
    state: EvaluationState,
    shares: Share,
) -> EvaluationState:
    """Step one device's lanes `settings.chunk` times, then store their results and traces."""

    def act(lanes: Running, _: None) -> tuple[State, jax.Array, Running]:
        lanes = _take_next(lanes, shares)
        return lanes.robots, steered(robot, controller, lanes.robots, lanes.target), lanes

    def watch(_: Running, move: Move) -> tuple[Running, _Outputs]:
        lanes: Running = move.notes
        now = _update(lanes.now, move, lanes.target, settings.goal_radius)
        over = now.reached | now.fell | now.diverged | (now.steps >= settings.max_steps)
        over &= lanes.episode < len(shares.target)
        seen = _Outputs(lanes.episode, over, now, keep(move.after))
        idle = jnp.where(over, len(shares.target), lanes.episode)
        return lanes.replace(robots=move.after, episode=idle, now=now), seen

    running, seen = rollout(robot, act, watch, state.running, steps=settings.chunk)
    return _store(state.replace(running=running), seen)


def _take_next(lanes: Running, shares: Share) -> Running:
    """Give the next episodes of the queue, if any are left, to the idle lanes."""
    total = len(shares.target)
    idle = lanes.episode >= total
    rank = lanes.taken + jnp.cumsum(idle, dtype=jnp.int32) - 1
    takes = idle & (rank < total)
    episode = jnp.where(takes, rank, lanes.episode).astype(jnp.int32)
    new = jax.tree.map(lambda x: x[jnp.minimum(episode, total - 1)], shares)
    distance = horizontal_norm(new.target - new.robots.position).astype(jnp.float32)
    fresh = _no_results(episode.shape[0]).replace(closest=distance, start=distance)
    return Running(
        robots=select(takes, new.robots, lanes.robots),
        target=select(takes, new.target, lanes.target),
        episode=episode,
        now=select(takes, fresh, lanes.now),
        taken=lanes.taken + takes.sum(dtype=jnp.int32),
    )


def _update(
    now: EpisodeResults, move: Move, target: jax.Array, goal_radius: float
) -> EpisodeResults:
    """Update the results with one step."""
    o, o_next = move.before.position, move.after.position
    distance = horizontal_norm(target - o_next).astype(jnp.float32)
    return EpisodeResults(
        closest=jnp.minimum(now.closest, distance),
        start=now.start,
        reached=distance <= goal_radius,
        fell=move.after.fallen,
        diverged=move.after.diverged,
        steps=now.steps + 1,
        path_length=now.path_length + horizontal_norm(o_next - o).astype(jnp.float32),
    )


def _store(state: EvaluationState, seen: _Outputs) -> EvaluationState:
    """Store the results and traces of steps `[T, L]`."""
    slot = jnp.where(seen.over, seen.episode, len(state.ended.steps))

    def keep(kept: jax.Array, x: jax.Array) -> jax.Array:
        return kept.at[slot].set(x, mode="drop")

    def extend(trace: jax.Array, x: jax.Array) -> jax.Array:
        return trace.at[seen.episode, seen.now.steps].set(x, mode="drop")

    return state.replace(
        ended=jax.tree.map(keep, state.ended, seen.now),
        traces=jax.tree.map(extend, state.traces, seen.kept),
    )
