"""The loop that SAC and DDPG share: step, remember, learn from a replay buffer.

An iteration is two programs, as PPO's: in the first every device steps its own lanes; in
the second the buffer takes the steps in and `updates` minibatches are learned from, on one
device. What differs between learners is an `Algorithm`.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Self

import flax.struct
import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.types import Transition
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.alternating import Alternates, Alternating, Learner
from genidm.agents.base import Metrics
from genidm.agents.buffer import (
    Buffer,
    Memory,
    draw,
    empty,
    insert,
    look_up,
    remember,
    steps_left,
)  # fmt: skip
from genidm.agents.her import HER
from genidm.agents.policy import Activation, no_statistics
from genidm.agents.walking import walk
from genidm.checks import check, count, layers, number, positive
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.robots.base import Robot
from genidm.tasks import GoToGoal, Lanes, Step, Task, Verdict, input_size, inputs, outlook


class Algorithm(NamedTuple):
    """What a learner is made of.

    Attributes:
      start: key → networks and their optimizers, a tree whose `policy` acts.
      draw: key → the random numbers that an action of one robot takes.
      act: (statistics, policy, inputs `[B, I]`, random numbers `[B, ...]`) → actions `[B, A]`,
        with exploration.
      update: (tree, statistics, Transition `[N, ...]`, key) → (tree, losses).
    """

    start: Callable[[jax.Array], Any]
    draw: Callable[[jax.Array], Any]
    act: Callable[[RunningStatisticsState, Any, jax.Array, Any], jax.Array]
    update: Callable[..., tuple[Any, Metrics]]


class TrainingState(flax.struct.PyTreeNode):
    """What learns: networks with their optimizers, statistics of the inputs, the buffer, a key."""

    networks: Any
    statistics: RunningStatisticsState
    buffer: Buffer
    key: jax.Array

    @property
    def chosen(self) -> tuple[RunningStatisticsState, Any]:
        """What chooses actions."""
        return self.statistics, self.networks.policy


@dataclasses.dataclass(frozen=True)
class OffPolicy(Alternates):
    """Settings that off-policy learners share.

    Attributes:
      lanes: robots at once.
      unroll: steps an iteration.
      updates: minibatches an iteration.
      batch: steps a minibatch.
      capacity: steps that the buffer holds.
      warmup: steps before the first update.
      learning_rate: of Adam.
      discount: of rewards, a step.
      tau: share of the networks in their targets, an update.
      reward_scale: rewards are multiplied by it.
      hidden: layers of the policy (Table 2: 64×64).
      critic_hidden: layers of the critics.
      her: relabelling; None learns from the task's own goals and rewards.
    """

    activation: ClassVar[Activation] = "relu"

    lanes: int = 128
    unroll: int = 8
    updates: int = 128
    batch: int = 256
    capacity: int = 1_000_000
    warmup: int = 10_000
    learning_rate: float = 1e-3
    discount: float = 0.98
    tau: float = 0.005
    reward_scale: float = 1.0
    hidden: tuple[int, ...] = (64, 64)
    critic_hidden: tuple[int, ...] = (256, 256)
    her: HER | None = None

    def __post_init__(self) -> None:
        check(
            self, lanes=count(), unroll=count(), updates=count(), batch=count(),
            capacity=count(), warmup=count(0), learning_rate=positive(),
            discount=number(0, 1, above=True, below=True), tau=positive(1),
            reward_scale=positive(), hidden=layers, critic_hidden=layers,
        )  # fmt: skip
        size = self.lanes * self.unroll
        if self.warmup > self.capacity // size * size:
            room = f"a buffer for {self.capacity} steps"
            raise BadInput(f"{room} never holds the {self.warmup} of the warmup")

    def wide(self) -> Self:
        """The same with one step of many robots an iteration, which an accelerator makes at once.

        As many steps lie between updates as before, and the policy that makes them is newer.
        """
        return dataclasses.replace(self, lanes=self.lanes * self.unroll, unroll=1)

    @abc.abstractmethod
    def algorithm(self, robot: Robot, size: int) -> Algorithm:
        """The learner's networks and losses, for inputs of this size."""

    def programs(self, robot: Robot, task: Task, mesh: Mesh) -> Alternating:
        """The two programs of an iteration.

        Raises:
          BadInput: there is HER, and the task has no goals.
        """
        if self.her and not isinstance(task, GoToGoal):
            raise BadInput("HER relabels goals, and this task has none")
        algorithm = self.algorithm(robot, input_size(robot, task))
        walk = functools.partial(_walk, robot, task, algorithm, self.unroll)
        learn = functools.partial(self._learn, robot, task, algorithm)

        def start(key: jax.Array) -> Learner:
            keys = jax.random.split(key, 3)
            lanes = task.start(robot, jax.random.split(keys[0], self.lanes))
            networks = algorithm.start(keys[1])
            statistics = no_statistics(input_size(robot, task))
            part = jax.eval_shape(walk, statistics, networks.policy, lanes)[2]
            buffer = empty(part, self.capacity)
            _check_room(buffer)
            return Learner(lanes, TrainingState(networks, statistics, buffer, keys[2]))

        return Alternating(type(self).__name__, start, walk, learn, mesh)

    def _learn(
        self, robot: Robot, task: Task, algorithm: Algorithm, training: TrainingState, part: Memory
    ) -> tuple[TrainingState, Metrics]:
        """Takes `part [unroll, lanes, ...]` in, and learns from `updates` minibatches."""
        buffer = insert(training.buffer, part)
        fed = inputs(part.s, None if part.goal is None else part.goal - part.o)
        statistics = running_statistics.update(training.statistics, fed)
        left = steps_left(buffer)

        def update(tree: Any, key: jax.Array) -> tuple[Any, Metrics]:
            which, how = jax.random.split(key)
            batch = self.sample(robot, task, buffer, left, which)
            return algorithm.update(tree, statistics, batch, how)

        def learn(tree: Any, keys: jax.Array) -> tuple[Any, Metrics]:
            tree, info = jax.lax.scan(update, tree, keys)
            return tree, jax.tree.map(jnp.mean, info)

        def wait(tree: Any, keys: jax.Array) -> tuple[Any, Metrics]:
            info = jax.eval_shape(learn, tree, keys)[1]
            return tree, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), info)

        key, stream = jax.random.split(training.key)
        ready = buffer.filled * self.lanes >= max(self.warmup, 2 * self.lanes)
        keys = jax.random.split(stream, self.updates)
        tree, info = jax.lax.cond(ready, learn, wait, training.networks, keys)
        return TrainingState(tree, statistics, buffer, key), info

    def sample(
        self, robot: Robot, task: Task, buffer: Buffer, left: jax.Array, key: jax.Array
    ) -> Transition:
        """A minibatch `[batch, ...]`, its goals relabelled if there is HER, and judged anew.

        A step at the time limit is no end: it is marked as truncated, and not learned from.
        """
        where, what = jax.random.split(key)
        at = draw(buffer, where, self.batch)
        rows, s_next = look_up(buffer, at)
        goal, verdict = rows.goal, Verdict(rows.reward, rows.terminal, rows.rest)
        if self.her:
            assert isinstance(task, GoToGoal)  # `learning` has refused the others
            goal = self.her.goal(buffer, left, at, what, robot.standing_height)
            verdict = task.verdict(robot, rows.o, rows.o_next, goal, rows.cost, rows.fallen)
        before, after = (None, None) if goal is None else (goal - rows.o, goal - rows.o_next)
        return Transition(
            observation=inputs(rows.s, before),
            action=rows.a,
            reward=outlook(verdict, self.discount),
            discount=1.0 - verdict.terminal,
            next_observation=inputs(s_next, after),
            extras={"state_extras": {"truncation": 1.0 * (rows.last & ~verdict.terminal)}},
        )


def _check_room(buffer: Buffer) -> None:
    size = sum(x.nbytes for x in jax.tree.leaves(buffer))
    room = devices.memory() or devices.host_memory()
    if 1.2 * size > room:
        needs = f"the replay buffer needs {size / 1e9:.1f} GB, of {room / 1e9:.1f} on the device"
        raise BadInput(f"{needs}: give the agent a smaller capacity")


def _walk(
    robot: Robot,
    task: Task,
    algorithm: Algorithm,
    unroll: int,
    statistics: RunningStatisticsState,
    policy: Any,
    lanes: Lanes,
) -> tuple[Lanes, Experience, Memory, Metrics]:
    """`unroll` steps of every lane, exploring; outputs `[unroll, B, ...]`."""

    def choose(x: jax.Array, noise: Any) -> tuple[jax.Array, None]:
        return algorithm.act(statistics, policy, x, noise), None

    def keep(step: Step, notes: None) -> Memory:
        return remember(robot, step)

    return walk(robot, task, unroll, algorithm.draw, choose, keep, lanes)
