"""The test inside its program: lanes that take the next scenario as soon as theirs has ended.

Every device has its own share of the scenarios in a queue; a lane whose episode ends
takes the next, so that no lane waits for the longest episode of a batch.
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
from genidm.progress import compile_ahead
from genidm.robots.base import Robot, State, select
from genidm.rollout import Move, rollout
from genidm.symmetry import horizontal_norm

# Steps of an episode, which a trace holds, and of a program call, which holds what each leaves.
MOST_STEPS = 10**5
MOST_AT_ONCE = 10**4

# (s [B, S], target − o [B, 3]) → a [B, A]; a tree of arrays, so that one compiled
# program serves every controller of the same shape.
ControllerFn = Callable[[jax.Array, jax.Array], jax.Array]
# State [B] → a tree of arrays [B, ...]: what is kept of each state of a traced episode.
Record = Callable[[State], Any]


# What jax raises where a function of the user's looks at numbers that are not there yet.
_NOT_TRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def ask(who: str, asked: Callable[..., Any], shape: tuple[int, ...], *args: Any) -> jax.Array:
    """What a function of the user's answers inside a program, if it is an array of this shape.

    Args:
      who: what an error calls it.
      asked: the function.
      shape: that its answer must have; one that would only be broadcast is refused, too.
      args: what it is asked with.

    Raises:
      BadInput: the answer is something else, or cannot be computed inside a program.
    """
    try:
        answer = asked(*args)
    except _NOT_TRACEABLE:
        raise BadInput(
            f"{who} is asked inside a compiled program: it must compute with jax.numpy, and "
            "choose with jnp.where"
        ) from None
    wanted = f"{who} must answer an array of numbers of shape {shape}, a row a robot"
    if not isinstance(answer, jax.Array | np.ndarray):
        raise BadInput(f"{wanted}, not {answer!r:.40}")
    if answer.shape != shape or not (
        jnp.issubdtype(answer.dtype, jnp.floating) or jnp.issubdtype(answer.dtype, jnp.integer)
    ):
        raise BadInput(f"{wanted}, not {answer.dtype}{list(answer.shape)}")
    return jnp.asarray(answer)


def as_tree(controller: ControllerFn) -> Any:
    """A controller as a program takes it: a tree of arrays as it is, other functions as constants.

    One compiled program serves every controller that is a tree, of the same shape.
    """
    alone = jax.tree.leaves(controller) == [controller]
    return jax.tree_util.Partial(controller) if alone else controller


def steered(robot: Robot, controller: ControllerFn, robots: State, target: jax.Array) -> jax.Array:
    """Actions `[B, A]` for robots `[B]` on their way to `target [B, 3]`, metres.

    Raises:
      BadInput: the controller answers something else.
    """
    s, way = robots.observation, target - robots.position
    return ask("the controller", controller, (len(s), robot.action.size), s, way).astype(s.dtype)


def position(state: State) -> jax.Array:
    """Keeps o `[B, 3]`: an episode's way."""
    return state.position


@dataclasses.dataclass(frozen=True)
class EvaluationSettings:
    """Settings of the test.

    Attributes:
      max_steps: an episode ends after this many steps (A.1.3: 1000).
      goal_radius: metres; an episode ends when the target is this near.
      num_envs: robots at once, over all devices; see `Robot.max_parallel_envs`.
      chunk: steps a program call.
    """

    max_steps: int = 1000
    goal_radius: float = 0.1
    num_envs: int = 512
    chunk: int = 50

    def __post_init__(self) -> None:
        steps, chunk = count(1, MOST_STEPS), count(1, MOST_AT_ONCE)
        check(self, max_steps=steps, num_envs=count(), chunk=chunk, goal_radius=number(0))


class EpisodeResults(flax.struct.PyTreeNode):
    """What is known of each episode `[N]`, ended or not; see `Episodes`."""

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
      target: `[L, 3]`.
      episode: `[L]` int32, which of the device's n episodes the lane is at; n when it has none.
      now: EpisodeResults `[L]` of the running episodes.
      taken: `[1]` int32, episodes handed out.
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
      traces: tree `[m, max_steps + 1, ...]`, what is kept of the first m episodes.
    """

    running: Running
    ended: EpisodeResults
    traces: Any


class Share(NamedTuple):
    """The episodes of one device's queue.

    Attributes:
      robots: State `[n]` at their starts.
      target: `[n, 3]`, metres.
    """

    robots: State
    target: jax.Array


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """A test at work: scenarios shared out over the devices.

    Attributes:
      robot: what is steered.
      scenarios: scenarios `[N]`.
      settings: of the test.
      mesh: devices that the lanes and scenarios are shared among.
      traced: how many of the first episodes leave a trace in the queue.
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
        """Scenarios in all, N."""
        return self.scenarios.yaw.shape[0]

    @property
    def share(self) -> int:
        """Scenarios of a device, n; the last of them is repeated to fill them up to n a device."""
        return -(-self.total // self.mesh.size)

    def start(self) -> EvaluationState:
        """Queues whose lanes are all idle, on the devices."""
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
            now=_nothing(lanes),
            taken=jnp.zeros(count, jnp.int32),
        )
        queue = EvaluationState(running, _nothing(share * count), self._no_traces())
        return devices.put(queue, self.mesh)

    def _no_traces(self) -> Any:
        """Traces that hold the starts alone."""
        count, share, steps = self.mesh.size, self.share, self.settings.max_steps
        # One a device at least: jax forgets how an array without elements is shared out.
        each = max(1, -(-self.traced // count))

        def first(x: jax.Array) -> jax.Array:
            starts = x.reshape(count, share, *x.shape[1:])[:, :each].reshape(-1, *x.shape[1:])
            trace = jnp.zeros((len(starts), steps + 1, *x.shape[1:]), x.dtype)
            return trace.at[:, 0].set(starts)

        return jax.tree.map(first, self.record(jax.tree.map(np.asarray, self._shares.robots)))

    def prepare(
        self, controller: ControllerFn, queue: EvaluationState
    ) -> Callable[[EvaluationState], EvaluationState]:
        """The compiled program of `settings.chunk` steps of every lane; it donates the queue."""
        controller = devices.put(as_tree(controller), self.mesh, None)
        shares = self._shares
        body = functools.partial(_chunk, self.robot, self.settings, self.record)
        sharded = devices.over_lanes(body, self.mesh, [None, 0, 0], 0)
        jitted = jax.jit(sharded, donate_argnums=1)
        program = compile_ahead("evaluation", jitted, controller, queue, shares)
        return lambda queue: program(controller, queue, shares)

    def ended(self, queue: EvaluationState) -> int:
        """Episodes that have ended, those that fill up a share not counted."""
        return int((self._in_order(queue.ended.steps)[: self.total] > 0).sum())

    def useful(self, queue: EvaluationState, calls: int) -> float:
        """Share of the lane-steps of so many calls that were spent in episodes."""
        steps = np.asarray(queue.ended.steps).sum() + self._under_way(queue).sum()
        return float(steps / (calls * self.settings.chunk * queue.running.episode.shape[0]))

    def longest(self, queue: EvaluationState) -> int:
        """Steps of the longest episode under way; until it ends there may be none to count."""
        return int(self._under_way(queue).max())

    def _under_way(self, queue: EvaluationState) -> np.ndarray:
        """Steps `[lanes]` of the episode that each lane is at; 0 for one that has none."""
        return np.where(np.asarray(queue.running.episode) < self.share, queue.running.now.steps, 0)

    def results(self, queue: EvaluationState) -> EpisodeResults:
        """Outcomes `[N]`, in the order of the scenarios."""
        return jax.tree.map(lambda x: self._in_order(x)[: self.total], queue.ended)

    def traces(self, queue: EvaluationState) -> list[Any]:
        """What was kept of each traced episode, tree `[steps + 1, ...]`."""
        steps = self._in_order(queue.ended.steps)
        kept = jax.tree.map(self._in_order, queue.traces)
        return [jax.tree.map(lambda x, i=i: x[i, : steps[i] + 1], kept) for i in range(self.traced)]

    @functools.cached_property
    def _shares(self) -> Share:
        """Episodes `[devices × n]`, dealt out to the devices in turn, short shares filled up."""
        count, share = self.mesh.size, self.share
        dealt = np.minimum(np.arange(share * count), self.total - 1)
        dealt = dealt.reshape(share, count).T.reshape(-1)
        scenarios = devices.put(jax.tree.map(lambda x: x[dealt], self.scenarios), self.mesh)
        start = jax.jit(devices.over_lanes(self.robot.reset, self.mesh, [0, 0], 0))
        return Share(start(scenarios.keys, scenarios.yaw), scenarios.target)

    def _in_order(self, x: jax.Array) -> np.ndarray:
        """Undoes the dealing out: `[devices × n, ...]` in the order of the scenarios."""
        dealt = np.asarray(x)
        rows = dealt.reshape(self.mesh.size, -1, *dealt.shape[1:])
        return rows.swapaxes(0, 1).reshape(dealt.shape)


def _nothing(count: int) -> EpisodeResults:
    def zeros(kind: Any = jnp.float32) -> jax.Array:
        return jnp.zeros(count, kind)  # an array of its own, as it is donated

    return EpisodeResults(
        zeros(), zeros(), zeros(bool), zeros(bool), zeros(bool), zeros(jnp.int32), zeros()
    )


class _Seen(NamedTuple):
    """What a step of L lanes leaves to be written down.

    Attributes:
      episode: `[L]`, which of the n episodes the lane was at; n if at none.
      over: `[L]` bool, it has ended.
      now: its EpisodeResults `[L]` so far.
      kept: what a trace keeps `[L, ...]` of the state after the step.
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
    queue: EvaluationState,
    shares: Share,
) -> EvaluationState:
    """`settings.chunk` steps of one device's lanes, then what they leave is written down."""

    def act(lanes: Running, _: None) -> tuple[State, jax.Array, Running]:
        lanes = _take(lanes, shares)
        return lanes.robots, steered(robot, controller, lanes.robots, lanes.target), lanes

    def watch(_: Running, move: Move) -> tuple[Running, _Seen]:
        lanes: Running = move.notes
        now = _observe(lanes.now, move, lanes.target, settings.goal_radius)
        over = now.reached | now.fell | now.diverged | (now.steps >= settings.max_steps)
        over &= lanes.episode < len(shares.target)
        seen = _Seen(lanes.episode, over, now, keep(move.after))
        idle = jnp.where(over, len(shares.target), lanes.episode)
        return lanes.replace(robots=move.after, episode=idle, now=now), seen

    running, seen = rollout(robot, act, watch, queue.running, steps=settings.chunk)
    return _written(queue.replace(running=running), seen)


def _take(lanes: Running, shares: Share) -> Running:
    """Idle lanes take the next episodes of the queue, while there are any."""
    total = len(shares.target)
    idle = lanes.episode >= total
    rank = lanes.taken + jnp.cumsum(idle, dtype=jnp.int32) - 1
    takes = idle & (rank < total)
    episode = jnp.where(takes, rank, lanes.episode).astype(jnp.int32)
    new = jax.tree.map(lambda x: x[jnp.minimum(episode, total - 1)], shares)
    distance = horizontal_norm(new.target - new.robots.position).astype(jnp.float32)
    fresh = _nothing(episode.shape[0]).replace(closest=distance, start=distance)
    return Running(
        robots=select(takes, new.robots, lanes.robots),
        target=select(takes, new.target, lanes.target),
        episode=episode,
        now=select(takes, fresh, lanes.now),
        taken=lanes.taken + takes.sum(dtype=jnp.int32),
    )


def _observe(
    now: EpisodeResults, move: Move, target: jax.Array, goal_radius: float
) -> EpisodeResults:
    """The outcomes so far, with one more step in them."""
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


def _written(queue: EvaluationState, seen: _Seen) -> EvaluationState:
    """The queue with what some steps `[T, L]` have left: results and traces."""
    slot = jnp.where(seen.over, seen.episode, len(queue.ended.steps))

    def keep(kept: jax.Array, x: jax.Array) -> jax.Array:
        return kept.at[slot].set(x, mode="drop")

    def follow(trace: jax.Array, x: jax.Array) -> jax.Array:
        return trace.at[seen.episode, seen.now.steps].set(x, mode="drop")

    return queue.replace(
        ended=jax.tree.map(keep, queue.ended, seen.now),
        traces=jax.tree.map(follow, queue.traces, seen.kept),
    )
