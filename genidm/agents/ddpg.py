"""DDPG (Lillicrap et al. 2016), with Brax's networks."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.gradients import gradient_update_fn
from brax.training.networks import FeedForwardNetwork, make_policy_network, make_q_network
from brax.training.types import Transition as BraxTransition

from genidm.agents.base import Metrics
from genidm.agents.mirroring import mirror_policy_output, mirrored
from genidm.agents.off_policy import Algorithm, OffPolicy
from genidm.agents.policy import normalize
from genidm.checks import check, number
from genidm.robots.base import Robot


class DDPGState(flax.struct.PyTreeNode):
    """Parameters of the policy, the critic and their targets, and optimizer states."""

    policy: Any
    critic: Any
    policy_target: Any
    critic_target: Any
    policy_optimizer: Any
    critic_optimizer: Any


@dataclasses.dataclass(frozen=True)
class DDPG(OffPolicy):
    """Settings of DDPG.

    Attributes:
      noise: standard deviation of the Gaussian exploration noise.
      random: fraction of the actions that are uniform random instead.
      action_cost: weight, in the policy loss, of the mean square of the actions before tanh;
        it keeps tanh from saturating.
    """

    noise: float = 0.1
    random: float = 0.1
    action_cost: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, noise=number(0), random=number(0, 1), action_cost=number(0))

    def networks(self, robot: Robot, size: int) -> tuple[FeedForwardNetwork, FeedForwardNetwork]:
        """Brax's policy network (before tanh) and critic, with normalised inputs."""
        actions = robot.action.size
        policy = make_policy_network(actions, size, normalize, self.policy_hidden_layer_sizes)
        if self.mirror:
            policy = mirrored(robot, policy, functools.partial(mirror_policy_output, robot))
        return (
            policy,
            make_q_network(size, actions, normalize, self.critic_hidden_layer_sizes, n_critics=1),
        )

    def loss_critic(
        self,
        critic: Any,
        networks: tuple[FeedForwardNetwork, FeedForwardNetwork],
        targets: tuple[Any, Any],
        statistics: RunningStatisticsState,
        batch: BraxTransition,
    ) -> jax.Array:
        """Half the mean square of Q(x, a) − (r + γ Q'(x', μ'(x'))); truncated steps add 0."""
        mu, q = networks
        action = jnp.tanh(mu.apply(statistics, targets[0], batch.next_observation))
        next_value = q.apply(statistics, targets[1], batch.next_observation, action)[..., 0]
        reward = self.reward_scaling * batch.reward
        target = reward + self.discounting * batch.discount * next_value
        value = q.apply(statistics, critic, batch.observation, batch.action)[..., 0]
        mask = 1 - batch.extras["state_extras"]["truncation"]
        return 0.5 * jnp.mean((mask * (value - target)) ** 2)

    def loss_policy(
        self,
        policy: Any,
        networks: tuple[FeedForwardNetwork, FeedForwardNetwork],
        critic: Any,
        statistics: RunningStatisticsState,
        batch: BraxTransition,
    ) -> jax.Array:
        """Batch mean of −Q(x, μ(x)), plus the action cost."""
        mu, q = networks
        raw = mu.apply(statistics, policy, batch.observation)
        value = q.apply(statistics, critic, batch.observation, jnp.tanh(raw))
        return self.action_cost * jnp.mean(raw**2) - jnp.mean(value)

    def algorithm(self, robot: Robot, size: int) -> Algorithm:
        networks = self.networks(robot, size)
        adam = optax.adam(self.learning_rate)

        def loss_critic(params: Any, *rest: Any) -> jax.Array:
            return self.loss_critic(params, networks, *rest)

        def loss_policy(params: Any, *rest: Any) -> jax.Array:
            return self.loss_policy(params, networks, *rest)

        critic_update = gradient_update_fn(loss_critic, adam, pmap_axis_name=None)
        policy_update = gradient_update_fn(loss_policy, adam, pmap_axis_name=None)

        def start(key: jax.Array) -> DDPGState:
            keys = jax.random.split(key)
            params = [net.init(k) for net, k in zip(networks, keys, strict=True)]
            # The targets must be copies, because jax cannot donate one array twice.
            targets = jax.tree.map(jnp.copy, params)
            return DDPGState(*params, *targets, *(adam.init(p) for p in params))

        def draw(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            which, noise, uniform = jax.random.split(key, 3)
            size = (robot.action.size,)
            explores = jax.random.uniform(which, (), jnp.float32) < self.random
            drawn = jax.random.uniform(uniform, size, jnp.float32, minval=-1.0)
            return explores, self.noise * jax.random.normal(noise, size, jnp.float32), drawn

        def act(
            statistics: RunningStatisticsState, policy: Any, x: jax.Array, numbers: Any
        ) -> tuple[jax.Array, jax.Array]:
            explores, noise, drawn = numbers
            intended = jnp.tanh(networks[0].apply(statistics, policy, x))
            noisy = jnp.clip(intended + noise, -1.0, 1.0)
            return jnp.where(explores[:, None], drawn, noisy), intended

        def update(
            n: DDPGState, statistics: RunningStatisticsState, batch: BraxTransition, key: jax.Array
        ) -> tuple[DDPGState, Metrics]:
            critic_loss, critic, critic_state = critic_update(
                n.critic, (n.policy_target, n.critic_target), statistics, batch,
                optimizer_state=n.critic_optimizer,
            )  # fmt: skip
            policy_loss, policy, policy_state = policy_update(
                n.policy, critic, statistics, batch, optimizer_state=n.policy_optimizer
            )
            policy_target, critic_target = optax.incremental_update(
                (policy, critic), (n.policy_target, n.critic_target), self.tau
            )
            new = DDPGState(
                policy, critic, policy_target, critic_target, policy_state, critic_state
            )
            return new, {"critic_loss": critic_loss, "policy_loss": policy_loss}

        return Algorithm(start, draw, act, update)
