"""SAC (Haarnoja et al. 2018), with Brax's networks and losses."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.sac.losses import make_losses
from brax.training.agents.sac.networks import SACNetworks
from brax.training.distribution import NormalTanhDistribution
from brax.training.gradients import gradient_update_fn
from brax.training.networks import make_policy_network, make_q_network
from brax.training.types import Transition as BraxTransition

from genidm.agents.base import Metrics
from genidm.agents.mirroring import mirror_policy_output, mirrored
from genidm.agents.off_policy import Algorithm, OffPolicy
from genidm.agents.policy import normalize
from genidm.robots.base import Robot


class SACState(flax.struct.PyTreeNode):
    """Parameters of policy, critics, their targets and temperature, and optimizer states."""

    policy: Any
    critic: Any
    target: Any
    log_alpha: jax.Array
    policy_optimizer: Any
    critic_optimizer: Any
    alpha_optimizer: Any


@dataclasses.dataclass(frozen=True)
class SAC(OffPolicy):
    """Settings of SAC; the temperature is tuned for a target entropy of −A / 2, as in Brax.

    Attributes:
      layer_norm: layer normalisation in the critics, which makes them learn in fewer updates.
    """

    layer_norm: bool = False

    def networks(self, robot: Robot, size: int) -> SACNetworks:
        """Brax's policy network and two critics, with normalised inputs."""
        distribution = NormalTanhDistribution(event_size=robot.action.size)
        policy = make_policy_network(
            distribution.param_size, size, normalize, self.policy_hidden_layer_sizes
        )
        if self.mirror:
            policy = mirrored(robot, policy, functools.partial(mirror_policy_output, robot))
        return SACNetworks(
            policy,
            make_q_network(
                size,
                robot.action.size,
                normalize,
                self.critic_hidden_layer_sizes,
                layer_norm=self.layer_norm,
            ),
            distribution,
        )

    def algorithm(self, robot: Robot, size: int) -> Algorithm:
        networks = self.networks(robot, size)
        adam = optax.adam(self.learning_rate)
        losses = make_losses(networks, self.reward_scaling, self.discounting, robot.action.size)
        alpha_update, critic_update, policy_update = (
            gradient_update_fn(loss, adam, pmap_axis_name=None) for loss in losses
        )

        def start(key: jax.Array) -> SACState:
            policy_key, critic_key = jax.random.split(key)
            policy = networks.policy_network.init(policy_key)
            critic = networks.q_network.init(critic_key)
            log_alpha = jnp.zeros((), jnp.float32)
            # The target must be a copy, because jax cannot donate one array twice.
            target = jax.tree.map(jnp.copy, critic)
            states = (adam.init(x) for x in (policy, critic, log_alpha))
            return SACState(policy, critic, target, log_alpha, *states)

        def draw(key: jax.Array) -> jax.Array:
            return jax.random.normal(key, (robot.action.size,), jnp.float32)

        def act(
            statistics: RunningStatisticsState, policy: Any, x: jax.Array, noise: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            logits = networks.policy_network.apply(statistics, policy, x)
            distribution = networks.parametric_action_distribution
            normal = distribution.create_dist(logits)
            raw = normal.loc + normal.scale * noise
            return distribution.postprocess(raw), distribution.postprocess(normal.loc)

        def update(
            n: SACState, statistics: RunningStatisticsState, batch: BraxTransition, key: jax.Array
        ) -> tuple[SACState, Metrics]:
            keys = jax.random.split(key, 3)
            alpha = jnp.exp(n.log_alpha)
            _, log_alpha, alpha_state = alpha_update(
                n.log_alpha, n.policy, statistics, batch, keys[0],
                optimizer_state=n.alpha_optimizer,
            )  # fmt: skip
            critic_loss, critic, critic_state = critic_update(
                n.critic, n.policy, statistics, n.target, alpha, batch, keys[1],
                optimizer_state=n.critic_optimizer,
            )  # fmt: skip
            policy_loss, policy, policy_state = policy_update(
                n.policy, statistics, critic, alpha, batch, keys[2],
                optimizer_state=n.policy_optimizer,
            )  # fmt: skip
            target = optax.incremental_update(critic, n.target, self.tau)
            info = {"critic_loss": critic_loss, "policy_loss": policy_loss, "alpha": alpha}
            new = SACState(
                policy, critic, target, log_alpha, policy_state, critic_state, alpha_state
            )
            return new, info

        return Algorithm(start, draw, act, update)
