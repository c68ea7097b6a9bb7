"""PPO (Schulman et al. 2017), built from Brax's networks, losses and statistics.

An iteration has two programs. In the first, every device steps its own lanes. In the second,
one device updates the input statistics and makes `num_updates_per_batch` passes over the batch.
Only one device learns, for three reasons. With networks this small it is faster than four CPU
devices that average their gradients (0.3 s per iteration instead of 0.6). The result does not
depend on the number of devices. XLA's collectives on a CPU can deadlock when cores are scarce.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo.losses import PPONetworkParams, compute_ppo_loss
from brax.training.gradients import gradient_update_fn
from brax.training.types import Transition as BraxTransition
from flax import linen
from jax.sharding import Mesh

from genidm.agents.base import Metrics
from genidm.agents.mirroring import mirror_policy_output, mirrored
from genidm.agents.policy import Activation, no_statistics, normalize
from genidm.agents.rollout_then_learn import AgentState, LearningAgent, RolloutThenLearn
from genidm.agents.unroll import generate_unroll
from genidm.checks import check, count, layers, number, positive
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.robots.base import Robot
from genidm.tasks import EnvState, Task, Transition, bootstrapped_reward, input_size

# The metrics of Brax's loss that are logged.
LOSSES = ("policy_loss", "v_loss", "kl_mean", "policy_dist_mean_std")


class TrainingState(flax.struct.PyTreeNode):
    """Network parameters, optimizer state, statistics of the inputs and a random key."""

    params: PPONetworkParams
    optimizer: Any
    statistics: RunningStatisticsState
    key: jax.Array

    @property
    def actor_params(self) -> tuple[RunningStatisticsState, Any]:
        """Statistics and policy parameters: all that a rollout needs."""
        return self.statistics, self.params.policy


@dataclasses.dataclass(frozen=True)
class PPO(LearningAgent):
    """Settings of PPO.

    Attributes:
      num_envs: number of lanes: environments that step together.
      unroll_length: environment steps per lane in one iteration; a batch has num_envs ×
        unroll_length transitions.
      num_updates_per_batch: passes over each batch.
      num_minibatches: minibatches per pass, each of num_envs / num_minibatches lanes.
      learning_rate: learning rate of Adam.
      discounting: discount factor γ per step.
      gae_lambda: λ of generalised advantage estimation.
      clipping_epsilon: clipping range ε of the probability ratio.
      entropy_cost: weight of the entropy bonus.
      reward_scaling: factor for rewards.
      policy_hidden_layer_sizes: widths of the policy's hidden layers (Table 2: 64×64).
      value_hidden_layer_sizes: widths of the value function's hidden layers.
      max_grad_norm: maximum norm of the gradients; larger ones are clipped.
      mirror: policy and value function are their own mirror images (`mirroring`).
    """

    activation: ClassVar[Activation] = "tanh"

    num_envs: int = 128
    unroll_length: int = 16
    num_updates_per_batch: int = 4
    num_minibatches: int = 4
    learning_rate: float = 5e-4
    discounting: float = 0.99
    gae_lambda: float = 0.95
    clipping_epsilon: float = 0.2
    entropy_cost: float = 1e-3
    reward_scaling: float = 0.1
    policy_hidden_layer_sizes: tuple[int, ...] = (64, 64)
    value_hidden_layer_sizes: tuple[int, ...] = (64, 64)
    max_grad_norm: float = 1.0
    mirror: bool = False

    def __post_init__(self) -> None:
        check(
            self,
            num_envs=count(),
            unroll_length=count(),
            num_updates_per_batch=count(),
            num_minibatches=count(),
            learning_rate=positive(),
            discounting=number(0, 1, above=True, below=True),
            gae_lambda=number(0, 1),
            clipping_epsilon=positive(),
            entropy_cost=number(0),
            reward_scaling=positive(),
            policy_hidden_layer_sizes=layers,
            value_hidden_layer_sizes=layers,
            max_grad_norm=positive(),
        )
        if self.num_envs % self.num_minibatches:
            raise BadInput(
                f"num_envs {self.num_envs} must be a multiple of "
                f"num_minibatches {self.num_minibatches}"
            )

    def networks(self, robot: Robot, task: Task) -> ppo_networks.PPONetworks:
        """Brax's policy and value networks, with normalised inputs."""
        made = ppo_networks.make_ppo_networks(
            input_size(robot, task),
            robot.action.size,
            preprocess_observations_fn=normalize,
            policy_hidden_layer_sizes=self.policy_hidden_layer_sizes,
            value_hidden_layer_sizes=self.value_hidden_layer_sizes,
            activation=linen.tanh,
        )
        if not self.mirror:
            return made
        mirror = functools.partial(mirror_policy_output, robot)
        policy = mirrored(robot, made.policy_network, mirror)
        value = mirrored(robot, made.value_network, lambda x: x)
        return made.replace(policy_network=policy, value_network=value)

    def programs(self, robot: Robot, task: Task, mesh: Mesh) -> RolloutThenLearn:
        """The rollout and learning programs of an iteration."""
        networks = self.networks(robot, task)
        optimizer = optax.chain(
            optax.clip_by_global_norm(self.max_grad_norm), optax.adam(self.learning_rate)
        )
        rollout = functools.partial(
            _rollout, robot, task, networks, self.unroll_length, self.discounting
        )
        learn = functools.partial(self._learn, networks, optimizer)

        def start(key: jax.Array) -> AgentState:
            lanes, policy, value, stream = jax.random.split(key, 4)
            params = PPONetworkParams(
                networks.policy_network.init(policy), networks.value_network.init(value)
            )
            return AgentState(
                env_state=task.start(robot, jax.random.split(lanes, self.num_envs)),
                training_state=TrainingState(
                    params=params,
                    optimizer=optimizer.init(params),
                    statistics=no_statistics(input_size(robot, task)),
                    key=stream,
                ),
            )

        return RolloutThenLearn("PPO", start, rollout, learn, mesh)

    def _learn(
        self,
        networks: ppo_networks.PPONetworks,
        optimizer: optax.GradientTransformation,
        training: TrainingState,
        batch: BraxTransition,
    ) -> tuple[TrainingState, Metrics]:
        """Learn from a batch `[unroll_length, num_envs, ...]`, in shuffled minibatches."""
        batch = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch)
        statistics = running_statistics.update(training.statistics, batch.observation)
        loss = functools.partial(
            compute_ppo_loss,
            ppo_network=networks,
            entropy_cost=self.entropy_cost,
            discounting=self.discounting,
            reward_scaling=self.reward_scaling,
            gae_lambda=self.gae_lambda,
            clipping_epsilon=self.clipping_epsilon,
        )
        update = gradient_update_fn(loss, optimizer, pmap_axis_name=None, has_aux=True)

        def minibatch(carry: Any, part: Any) -> tuple[Any, Any]:
            params, state = carry
            data, key = part
            (_, info), params, state = update(params, statistics, data, key, optimizer_state=state)
            return (params, state), info

        def epoch(carry: Any, key: jax.Array) -> tuple[Any, Any]:
            order, noise = jax.random.split(key)
            parts = _shuffled(
                batch, jax.random.permutation(order, self.num_envs), self.num_minibatches
            )
            return jax.lax.scan(
                minibatch, carry, (parts, jax.random.split(noise, self.num_minibatches))
            )

        key, stream = jax.random.split(training.key)
        (params, state), info = jax.lax.scan(
            epoch,
            (training.params, training.optimizer),
            jax.random.split(stream, self.num_updates_per_batch),
        )
        return TrainingState(params, state, statistics, key), {n: info[n].mean() for n in LOSSES}


def _rollout(
    robot: Robot,
    task: Task,
    networks: ppo_networks.PPONetworks,
    unroll_length: int,
    discounting: float,
    statistics: RunningStatisticsState,
    policy: Any,
    lanes: EnvState,
) -> tuple[EnvState, Experience, BraxTransition, Metrics]:
    """Step every lane with sampled actions; outputs are `[unroll_length, B, ...]`."""
    distribution = networks.parametric_action_distribution

    def draw(key: jax.Array) -> jax.Array:
        return jax.random.normal(key, (robot.action.size,), jnp.float32)

    def choose(x: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        logits = networks.policy_network.apply(statistics, policy, x)
        normal = distribution.create_dist(logits)
        raw = normal.loc + normal.scale * noise
        return distribution.postprocess(raw), distribution.postprocess(normal.loc), (logits, raw)

    def keep(step: Transition, notes: Any) -> dict[str, Any]:
        logits, raw = notes
        return {
            "inputs": step.inputs(robot),
            "reward": bootstrapped_reward(step, discounting),
            "discount": 1.0 - step.terminal,
            "truncation": 1.0 * (step.last & ~step.terminal),
            "distribution_params": logits,
            "raw_action": raw,
        }

    lanes, experience, kept, seen = generate_unroll(
        robot, task, unroll_length, draw, choose, keep, lanes
    )
    kept["log_prob"] = distribution.log_prob(kept["distribution_params"], kept["raw_action"])
    return lanes, experience, brax_transition(experience.a, kept, lanes.inputs(robot)), seen


def brax_transition(a: jax.Array, kept: dict[str, Any], after: jax.Array) -> BraxTransition:
    """Convert steps `[T, B]` to the transition that Brax's loss reads.

    Args:
      a: actions `[T, B, A]`.
      kept: PPO's data for the loss, arrays `[T, B, ...]`.
      after: the policy's input `[B, I]` after the last step. The loss reads only its value, and
        ignores it where the last step ended an episode.
    """
    policy_fields = ("distribution_params", "raw_action", "log_prob")
    return BraxTransition(
        observation=kept["inputs"],
        action=a,
        reward=kept["reward"],
        discount=kept["discount"],
        next_observation=after[None],
        extras={
            "policy_extras": {name: kept[name] for name in policy_fields},
            "state_extras": {"truncation": kept["truncation"]},
        },
    )


def _shuffled(batch: Any, order: jax.Array, parts: int) -> Any:
    """Reorder a batch `[B, ...]` and split it into `[parts, B / parts, ...]`."""
    return jax.tree.map(lambda x: x[order].reshape(parts, -1, *x.shape[1:]), batch)
