"""The paper's test (A.1.3): closest distance to the target, over a bank of scenarios.

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
from genidm.episodes import Episodes
from genidm.errors import BadInput
from genidm.progress import Progress, compiled
from genidm.robots.base import Robot, State, select
from genidm.rollout import Move, rollout
from genidm.scenarios import Scenarios
from genidm.store import Stage
from genidm.symmetry import horizontal

# (s [B, S], target − o [B, 3]) → a [B, A]; a tree of arrays, so that one compiled
# program serves every controller of the same shape.
Steering = Callable[[jax.Array, jax.Array], jax.Array]


@dataclasses.dataclass(frozen=True)
class Test:
    """Settings of the test.

    Attributes:
      max_steps: an episode ends after this many steps (A.1.3: 1000).
      reach: metres; an episode ends when the target is this near.
      lanes: robots at once, over all devices; see `Robot.at_once`.
      chunk: steps a program call.
    """

    __test__ = False  # not a test case for pytest

    max_steps: int = 1000
    reach: float = 0.1
    lanes: int = 512
    chunk: int = 50

    def __post_init__(self) -> None:
        if self.max_steps < 1 or self.lanes < 1 or self.chunk < 1 or self.reach < 0:
            raise BadInput("a test needs max_steps, lanes, chunk ≥ 1 and reach ≥ 0")


class Outcome(flax.struct.PyTreeNode):
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
      now: Outcome `[L]` of the running episodes.
      taken: `[1]` int32, episodes handed out.
    """

    robots: State
    target: jax.Array
    episode: jax.Array
    now: Outcome
    taken: jax.Array


class Queue(flax.struct.PyTreeNode):
    """One device's share of the test: its lanes, and the results of its n episodes.

    Attributes:
      running: the lanes.
      ended: Outcome `[n]` of the episodes that have ended.
      ways: `[m, max_steps + 1, 3]`, positions in the first m episodes, which are traced.
    """

    running: Running
    ended: Outcome
    ways: jax.Array


class Share(NamedTuple):
    """The episodes of one device's queue.

    Attributes:
      robots: State `[n]` at their starts.
      target: `[n, 3]`, metres.
    """

    robots: State
    target: jax.Array


def evaluate(
    robot: Robot,
    controller: Steering,
    bank: Scenarios,
    settings: Test | None = None,
    *,
    mesh: Mesh | None = None,
    stage: Stage | None = None,
    quiet: bool = False,
) -> Episodes:
    """Runs every scenario to its end.

    The controller is asked anew at each step (A.1.3: "we replan at each step").

    Args:
      robot: what is steered.
      controller: what steers it.
      bank: scenarios `[seeds, episodes]`.
      settings: length of an episode, reach radius, lanes.
      mesh: devices to share the lanes among; as the robot's engine wants, unless given.
      stage: where checkpoints and metrics go; nowhere, unless given.
      quiet: no progress bar.
    """
    outcome, _ = run(
        robot, controller, flatten(bank), settings, mesh=mesh, stage=stage, quiet=quiet
    )
    return episodes(outcome, bank.shape)


def trace(
    robot: Robot, controller: Steering, bank: Scenarios, settings: Test | None = None
) -> tuple[Episodes, list[np.ndarray]]:
    """`evaluate`, and the way of every episode: positions `[steps + 1, 3]`, in the bank's order."""
    outcome, ways = run(
        robot, controller, flatten(bank), settings, traced=bank.yaw.size, quiet=True
    )
    return episodes(outcome, bank.shape), ways


def walking_speed(robot: Robot, policy: Steering, episodes: int = 100, seed: int = 0) -> np.ndarray:
    """Speed towards +x of a policy that learned to walk there, `[episodes]`, m/s.

    Each episode starts as in training and ends with a fall, or after 1000 steps.
    """
    keys = jax.random.split(jax.random.key(seed), (1, episodes))
    # A target that is out of reach: what is gained on it is the way walked.
    target = jnp.broadcast_to(jnp.asarray([1e4, 0.0, 0.0]), (1, episodes, 3))
    outcome = evaluate(robot, policy, Scenarios(keys, jnp.zeros((1, episodes)), target))
    return (outcome.start - outcome.closest)[0] / (outcome.steps[0] * robot.control_step)


def run(
    robot: Robot,
    controller: Steering,
    bank: Scenarios,
    settings: Test | None = None,
    *,
    traced: int = 0,
    mesh: Mesh | None = None,
    stage: Stage | None = None,
    quiet: bool = False,
) -> tuple[Outcome, list[np.ndarray]]:
    """`evaluate` on scenarios `[N]`, the first of them traced.

    Args:
      robot: what is steered.
      controller: what steers it.
      bank: scenarios `[N]` (`flatten`).
      settings: length of an episode, reach radius, lanes.
      traced: how many of the first episodes to give the ways of.
      mesh: devices to share the lanes among; as the robot's engine wants, unless given.
      stage: where checkpoints and metrics go; nowhere, unless given.
      quiet: no progress bar.

    Returns:
      outcomes `[N]`, and for each traced episode its positions `[steps + 1, 3]`.
    """
    testing = Testing(robot, bank, settings or Test(), mesh or robot.mesh(), traced)
    queue, calls = testing.start(), 0
    # Its queues belong to the devices: on others the test begins anew.
    here = f"{testing.mesh.size}_devices_{queue.running.episode.size}_lanes"
    checkpoints = stage.checkpoints(here) if stage else None
    found = checkpoints.latest(queue) if checkpoints else None
    if found:
        calls, queue = found[0], devices.put(found[1], testing.mesh)
    step = testing.prepare(controller, queue)
    done = testing.ended(queue)
    directory = stage.directory if stage else None
    with Progress("evaluate", testing.total, "episodes", directory, done, quiet) as bar:
        while done < testing.total:
            queue, calls = step(queue), calls + 1
            before, done = done, testing.ended(queue)
            useful, longest = testing.useful(queue, calls), testing.longest(queue)
            bar.advance(done - before, useful=useful, longest=longest)
            if checkpoints and checkpoints.due():
                checkpoints.save(calls, queue)
    return testing.outcome(queue), testing.ways(queue)


def flatten(*banks: Scenarios) -> Scenarios:
    """Banks `[seeds, episodes]` one after another, as scenarios `[N]`."""

    def join(*parts: Any) -> Any:
        return jnp.concatenate([x.reshape(-1, *x.shape[2:]) for x in parts])

    return jax.tree.map(join, *banks)


def episodes(outcome: Outcome, shape: tuple[int, int]) -> Episodes:
    """Outcomes `[seeds × episodes]` as Episodes `[seeds, episodes]`."""
    names = [f.name for f in dataclasses.fields(Outcome)]
    return Episodes(**{name: np.asarray(getattr(outcome, name)).reshape(shape) for name in names})


@dataclasses.dataclass(frozen=True)
class Testing:
    """A test at work: a bank of scenarios shared out over the devices.

    Attributes:
      robot: what is steered.
      bank: scenarios `[N]`.
      settings: of the test.
      mesh: devices that the lanes and scenarios are shared among.
      traced: how many of the first episodes leave their ways in the queue.
    """

    __test__ = False  # not a test case for pytest

    robot: Robot
    bank: Scenarios
    settings: Test
    mesh: Mesh
    traced: int = 0

    @property
    def total(self) -> int:
        """Episodes in the bank, N."""
        return self.bank.yaw.shape[0]

    @property
    def share(self) -> int:
        """Scenarios of a device, n; the bank is filled up to n a device."""
        return -(-self.total // self.mesh.size)

    def start(self) -> Queue:
        """Queues whose lanes are all idle, on the devices."""
        count, share = self.mesh.size, self.share
        lanes = count * min(-(-self.robot.at_once(self.settings.lanes) // count), share)
        # One a device at least: jax forgets how an array without elements is shared out.
        rows = count * max(1, -(-self.traced // count))
        shapes = jax.eval_shape(
            self.robot.reset, jax.random.split(jax.random.key(0), lanes), jnp.zeros(lanes)
        )
        running = Running(
            robots=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes),
            target=jnp.zeros((lanes, 3)),
            episode=jnp.full(lanes, share, jnp.int32),
            now=_nothing(lanes),
            taken=jnp.zeros(count, jnp.int32),
        )
        ways = jnp.zeros((rows, self.settings.max_steps + 1, 3))
        queue = Queue(running, _nothing(share * count), ways)
        return devices.put(queue, self.mesh)

    def prepare(self, controller: Steering, queue: Queue) -> Callable[[Queue], Queue]:
        """The compiled program of `settings.chunk` steps of every lane; it donates the queue."""
        controller = devices.put(controller, self.mesh, None)
        shares = self._shares()
        body = functools.partial(_chunk, self.robot, self.settings)
        sharded = devices.over_lanes(body, self.mesh, [None, 0, 0], 0)
        jitted = jax.jit(sharded, donate_argnums=1)
        program = compiled("evaluation", jitted, controller, queue, shares)
        return lambda queue: program(controller, queue, shares)

    def ended(self, queue: Queue) -> int:
        """Episodes that have ended, those that fill up a share not counted."""
        return int((self._in_order(queue.ended.steps)[: self.total] > 0).sum())

    def useful(self, queue: Queue, calls: int) -> float:
        """Share of the lane-steps of so many calls that were spent in episodes."""
        steps = np.asarray(queue.ended.steps).sum() + self._under_way(queue).sum()
        return float(steps / (calls * self.settings.chunk * queue.running.episode.shape[0]))

    def longest(self, queue: Queue) -> int:
        """Steps of the longest episode under way; until it ends there may be none to count."""
        return int(self._under_way(queue).max())

    def _under_way(self, queue: Queue) -> np.ndarray:
        """Steps `[lanes]` of the episode that each lane is at; 0 for one that has none."""
        return np.where(np.asarray(queue.running.episode) < self.share, queue.running.now.steps, 0)

    def outcome(self, queue: Queue) -> Outcome:
        """Outcomes `[N]`, in the order of the bank."""
        return jax.tree.map(lambda x: self._in_order(x)[: self.total], queue.ended)

    def ways(self, queue: Queue) -> list[np.ndarray]:
        """Positions `[steps + 1, 3]` in each traced episode, metres."""
        steps, ways = self._in_order(queue.ended.steps), self._in_order(queue.ways)
        return [ways[i, : steps[i] + 1] for i in range(self.traced)]

    def _shares(self) -> Share:
        """Episodes `[devices × n]`, dealt out to the devices in turn, short shares filled up."""
        count, share = self.mesh.size, self.share
        dealt = np.minimum(np.arange(share * count), self.total - 1)
        dealt = dealt.reshape(share, count).T.reshape(-1)
        bank = devices.put(jax.tree.map(lambda x: x[dealt], self.bank), self.mesh)
        start = jax.jit(devices.over_lanes(self.robot.reset, self.mesh, [0, 0], 0))
        return Share(start(bank.keys, bank.yaw), bank.target)

    def _in_order(self, x: jax.Array) -> np.ndarray:
        """Undoes the dealing out: `[devices × n, ...]` in the order of the bank."""
        dealt = np.asarray(x)
        rows = dealt.reshape(self.mesh.size, -1, *dealt.shape[1:])
        return rows.swapaxes(0, 1).reshape(dealt.shape)


def _nothing(count: int) -> Outcome:
    def zeros(kind: type = float) -> jax.Array:
        return jnp.zeros(count, kind)  # an array of its own, as it is donated

    return Outcome(
        zeros(), zeros(), zeros(bool), zeros(bool), zeros(bool), zeros(jnp.int32), zeros()
    )


class _Seen(NamedTuple):
    """What a step of L lanes leaves to be written down.

    Attributes:
      episode: `[L]`, which of the n episodes the lane was at; n if at none.
      over: `[L]` bool, it has ended.
      now: its Outcome `[L]` so far.
      position: `[L, 3]` after the step.
    """

    episode: jax.Array
    over: jax.Array
    now: Outcome
    position: jax.Array


def _chunk(
    robot: Robot, settings: Test, controller: Steering, queue: Queue, shares: Share
) -> Queue:
    """`settings.chunk` steps of one device's lanes, then what they leave is written down."""

    def act(lanes: Running, _: None) -> tuple[State, jax.Array, Running]:
        lanes = _take(lanes, shares)
        o = lanes.robots.position
        return lanes.robots, controller(lanes.robots.observation, lanes.target - o), lanes

    def watch(_: Running, move: Move) -> tuple[Running, _Seen]:
        lanes: Running = move.notes
        now = _observe(lanes.now, move, lanes.target, settings.reach)
        over = now.reached | now.fell | now.diverged | (now.steps >= settings.max_steps)
        over &= lanes.episode < len(shares.target)
        seen = _Seen(lanes.episode, over, now, move.after.position)
        idle = jnp.where(over, len(shares.target), lanes.episode)
        return lanes.replace(robots=move.after, episode=idle, now=now), seen

    running, seen = rollout(robot, act, watch, queue.running, steps=settings.chunk)
    return _written(queue.replace(running=running), seen, shares)


def _take(lanes: Running, shares: Share) -> Running:
    """Idle lanes take the next episodes of the queue, while there are any."""
    total = len(shares.target)
    idle = lanes.episode >= total
    rank = lanes.taken + jnp.cumsum(idle) - 1
    takes = idle & (rank < total)
    episode = jnp.where(takes, rank, lanes.episode).astype(jnp.int32)
    new = jax.tree.map(lambda x: x[jnp.minimum(episode, total - 1)], shares)
    distance = horizontal(new.target - new.robots.position)
    fresh = _nothing(episode.shape[0]).replace(closest=distance, start=distance)
    return Running(
        robots=select(takes, new.robots, lanes.robots),
        target=select(takes, new.target, lanes.target),
        episode=episode,
        now=select(takes, fresh, lanes.now),
        taken=lanes.taken + takes.sum(),
    )


def _observe(now: Outcome, move: Move, target: jax.Array, reach: float) -> Outcome:
    """The outcomes so far, with one more step in them."""
    o, o_next = move.before.position, move.after.position
    distance = horizontal(target - o_next)
    return Outcome(
        closest=jnp.minimum(now.closest, distance),
        start=now.start,
        reached=distance <= reach,
        fell=move.after.fallen,
        diverged=move.after.diverged,
        steps=now.steps + 1,
        path_length=now.path_length + horizontal(o_next - o),
    )


def _written(queue: Queue, seen: _Seen, shares: Share) -> Queue:
    """The queue with what some steps `[T, L]` have left: results and ways."""
    total = len(shares.target)
    slot = jnp.where(seen.over, seen.episode, total)

    def keep(kept: jax.Array, x: jax.Array) -> jax.Array:
        return kept.at[slot].set(x, mode="drop")

    ways = queue.ways.at[seen.episode, seen.now.steps].set(seen.position, mode="drop")
    traced = min(len(ways), total)
    ways = ways.at[:traced, 0].set(shares.robots.position[:traced])
    return queue.replace(ended=jax.tree.map(keep, queue.ended, seen.now), ways=ways)
