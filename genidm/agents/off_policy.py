"""The loop that SAC and DDPG share: step, store, learn from a replay buffer.

Like PPO's, an iteration has two programs. In the first, every device steps its own lanes.
In the second, one device adds the steps to the buffer and makes `grad_updates_per_step`
updates, each from one minibatch. An `Algorithm` holds what differs between SAC and DDPG.
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
from brax.training.types import Transition as BraxTransition
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Metrics
from genidm.agents.buffer import (
    Buffer,
    ReplayTransition,
    add,
    empty,
    gather,
    sample_index,
    steps_left,
    to_replay_transition,
)  # fmt: skip
from genidm.agents.her import HER
from genidm.agents.policy import Activation, no_statistics
from genidm.agents.rollout_then_learn import AgentState, LearningAgent, RolloutThenLearn
from genidm.agents.unroll import generate_unroll
from genidm.checks import check, count, layers, number, positive
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.robots.base import Robot
from genidm.tasks import (
    EnvState,
    GoToGoal,
    Outcome,
    Task,
    Transition,
    bootstrapped_reward,
    input_size,
    inputs,
    mirror_inputs,
)


class Algorithm(NamedTuple):
    """The functions that define an off-policy algorithm.

    Attributes:
      start: key → tree of networks and optimizer states; its `policy` chooses actions.
      draw: key → the random numbers for one action of one robot.
      act: (statistics, policy, inputs `[B, I]`, random numbers `[B, ...]`) → actions `[B, A]`
        with exploration, and without.
      update: (tree, statistics, BraxTransition `[N, ...]`, key) → (tree, losses).
    """

    start: Callable[[jax.Array], Any]
    draw: Callable[[jax.Array], Any]
    act: Callable[[RunningStatisticsState, Any, jax.Array, Any], tuple[jax.Array, jax.Array]]
    update: Callable[..., tuple[Any, Metrics]]


class TrainingState(flax.struct.PyTreeNode):
    """Networks and optimizer states, statistics of the inputs, the buffer and a random key."""

    networks: Any
    statistics: RunningStatisticsState
    buffer: Buffer
    key: jax.Array

    @property
    def actor_params(self) -> tuple[RunningStatisticsState, Any]:
        """Statistics and policy parameters: all that a rollout needs."""
        return self.statistics, self.networks.policy


@dataclasses.dataclass(frozen=True)
class OffPolicy(LearningAgent):
    """Settings that off-policy agents share.

    Attributes:
      num_envs: number of lanes: environments that step together.
      unroll_length: environment steps per lane in one iteration.
      grad_updates_per_step: gradient updates per iteration (Brax calls an iteration a training
        step): per unroll_length steps of all lanes.
      batch_size: steps per minibatch.
      max_replay_size: maximum number of steps in the buffer.
      min_replay_size: number of steps in the buffer before the first update.
      learning_rate: learning rate of Adam.
      discounting: discount factor γ per step.
      tau: weight of the new networks in the target networks, per update.
      reward_scaling: factor for rewards.
      policy_hidden_layer_sizes: widths of the policy's hidden layers (Table 2: 64×64).
      critic_hidden_layer_sizes: widths of the critics' hidden layers.
      her: settings of relabelling; None keeps the original goals and rewards.
      mirror: the policy is its own mirror image (`mirroring`), and the critics learn from steps of
        which half are reflected.
    """

    activation: ClassVar[Activation] = "relu"

    num_envs: int = 128
    unroll_length: int = 8
    grad_updates_per_step: int = 128
    batch_size: int = 256
    max_replay_size: int = 1_000_000
    min_replay_size: int = 10_000
    learning_rate: float = 1e-3
    discounting: float = 0.98
    tau: float = 0.005
    reward_scaling: float = 1.0
    policy_hidden_layer_sizes: tuple[int, ...] = (64, 64)
    critic_hidden_layer_sizes: tuple[int, ...] = (256, 256)
    her: HER | None = None
    mirror: bool = False

    def __post_init__(self) -> None:
        check(
            self,
            num_envs=count(),
            unroll_length=count(),
            grad_updates_per_step=count(),
            batch_size=count(),
            max_replay_size=count(),
            min_replay_size=count(0),
            learning_rate=positive(),
            discounting=number(0, 1, above=True, below=True),
            tau=positive(1),
            reward_scaling=positive(),
            policy_hidden_layer_sizes=layers,
            critic_hidden_layer_sizes=layers,
        )
        size = self.num_envs * self.unroll_length
        if self.min_replay_size > self.max_replay_size // size * size:
            buffer = f"a buffer of max_replay_size {self.max_replay_size}"
            raise BadInput(f"{buffer} never holds min_replay_size = {self.min_replay_size} steps")

    def for_accelerator(self) -> Self:
        """Settings for an accelerator: more lanes, and one step per iteration.

        An iteration has as many steps as before, but the policy changes after every step.
        """
        return dataclasses.replace(
            self, num_envs=self.num_envs * self.unroll_length, unroll_length=1
        )

    @abc.abstractmethod
    def algorithm(self, robot: Robot, size: int) -> Algorithm:
        """The algorithm's networks and losses for policy inputs `[size]`."""

    def programs(self, robot: Robot, task: Task, mesh: Mesh) -> RolloutThenLearn:
        """The rollout and learning programs of an iteration.

        Raises:
          BadInput: `her` is set, but the task has no goals. `start` raises it, too, if the buffer
            does not fit on the device.
        """
        if self.her and not isinstance(task, GoToGoal):
            raise BadInput("HER relabels goals, but this task has no goals")
        algorithm = self.algorithm(robot, input_size(robot, task))
        rollout = functools.partial(_rollout, robot, task, algorithm, self.unroll_length)
        learn = functools.partial(self._learn, robot, task, algorithm)

        def start(key: jax.Array) -> AgentState:
            keys = jax.random.split(key, 3)
            lanes = task.start(robot, jax.random.split(keys[0], self.num_envs))
            networks = algorithm.start(keys[1])
            statistics = no_statistics(input_size(robot, task))
            part = jax.eval_shape(rollout, statistics, networks.policy, lanes)[2]
            buffer = empty(part, self.max_replay_size)
            _check_room(buffer)
            return AgentState(lanes, TrainingState(networks, statistics, buffer, keys[2]))

        return RolloutThenLearn(type(self).__name__, start, rollout, learn, mesh)

    def _learn(
        self,
        robot: Robot,
        task: Task,
        algorithm: Algorithm,
        training: TrainingState,
        part: ReplayTransition,
    ) -> tuple[TrainingState, Metrics]:
        """Add `part [unroll_length, num_envs, ...]`; make `grad_updates_per_step` updates."""
        buffer = add(training.buffer, part)
        observation = inputs(part.s, None if part.goal is None else part.goal - part.o)
        statistics = running_statistics.update(training.statistics, observation)
        left = steps_left(buffer)

        def update(tree: Any, key: jax.Array) -> tuple[Any, Metrics]:
            which, how = jax.random.split(key)
            batch = self.sample(robot, task, buffer, left, which)
            if self.mirror:
                batch = half_mirrored(robot, batch, jax.random.fold_in(which, 1))
            return algorithm.update(tree, statistics, batch, how)

        def learn(tree: Any, keys: jax.Array) -> tuple[Any, Metrics]:
            tree, info = jax.lax.scan(update, tree, keys)
            return tree, jax.tree.map(jnp.mean, info)

        def wait(tree: Any, keys: jax.Array) -> tuple[Any, Metrics]:
            info = jax.eval_shape(learn, tree, keys)[1]
            return tree, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), info)

        key, stream = jax.random.split(training.key)
        ready = buffer.filled * self.num_envs >= max(self.min_replay_size, 2 * self.num_envs)
        keys = jax.random.split(stream, self.grad_updates_per_step)
        tree, info = jax.lax.cond(ready, learn, wait, training.networks, keys)
        return TrainingState(tree, statistics, buffer, key), info

    def sample(
        self, robot: Robot, task: Task, buffer: Buffer, left: jax.Array, key: jax.Array
    ) -> BraxTransition:
        """Sample a minibatch `[batch_size, ...]`; with HER, relabel goals and recompute rewards.

        A step at the time limit is not terminal: it is marked as truncated, and the losses
        ignore it.
        """
        where, what = jax.random.split(key)
        at = sample_index(buffer, where, self.batch_size)
        rows, s_next = gather(buffer, at)
        goal, outcome = rows.goal, Outcome(rows.reward, rows.terminal, rows.absorbing_reward)
        if self.her:
            assert isinstance(task, GoToGoal)  # `programs` refuses other tasks
            goal = self.her.goal(buffer, left, at, what, robot.standing_height)
            outcome = task.outcome(robot, rows.o, rows.o_next, goal, rows.cost, rows.fallen)
        before, after = (None, None) if goal is None else (goal - rows.o, goal - rows.o_next)
        return BraxTransition(
            observation=inputs(rows.s, before),
            action=rows.a,
            reward=bootstrapped_reward(outcome, self.discounting),
            discount=1.0 - outcome.terminal,
            next_observation=inputs(s_next, after),
            extras={"state_extras": {"truncation": 1.0 * (rows.last & ~outcome.terminal)}},
        )


def half_mirrored(robot: Robot, batch: BraxTransition, key: jax.Array) -> BraxTransition:
    """A minibatch `[N, ...]` in which every step is reflected (y → −y) with probability ½."""
    reflected = jax.random.bernoulli(key, 0.5, batch.reward.shape)[:, None]

    def mix(mirror: Callable[[jax.Array], jax.Array], x: jax.Array) -> jax.Array:
        return jnp.where(reflected, mirror(x), x)

    state = functools.partial(mirror_inputs, robot)
    return batch._replace(
        observation=mix(state, batch.observation),
        action=mix(robot.action.mirror, batch.action),
        next_observation=mix(state, batch.next_observation),
    )


def _check_room(buffer: Buffer) -> None:
    size = sum(x.nbytes for x in jax.tree.leaves(buffer))
    room = devices.memory() or devices.host_memory()
    if 1.2 * size > room:
        needs = f"the replay buffer needs {size / 1e9:.1f} GB; the device has {room / 1e9:.1f} GB"
        raise BadInput(f"{needs}. Set a smaller max_replay_size")


def _rollout(
    robot: Robot,
    task: Task,
    algorithm: Algorithm,
    unroll_length: int,
    statistics: RunningStatisticsState,
    policy: Any,
    lanes: EnvState,
) -> tuple[EnvState, Experience, ReplayTransition, Metrics]:
    """Step every lane with exploration; outputs are `[unroll_length, B, ...]`."""

    def choose(x: jax.Array, noise: Any) -> tuple[jax.Array, jax.Array, None]:
        return *algorithm.act(statistics, policy, x, noise), None

    def keep(step: Transition, notes: None) -> ReplayTransition:
        return to_replay_transition(robot, step)

    return generate_unroll(robot, task, unroll_length, algorithm.draw, choose, keep, lanes)
