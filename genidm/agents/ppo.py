"""PPO (Schulman et al. 2017), composed from Brax's networks, losses and statistics.

One iteration, one program: every lane walks `unroll` steps, the running statistics take
the new states in, and the networks learn from the batch in `epochs` passes. Lanes are
stepped device by device. The updates are made on every device alike, on the whole batch:
networks this small learn faster than their gradients could be averaged (measured on four
CPU devices: 0.28 s an iteration instead of 0.60), and what is learned does not depend on
the number of devices.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo.losses import PPONetworkParams, compute_ppo_loss
from brax.training.gradients import gradient_update_fn
from brax.training.types import Transition
from flax import linen
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Learning
from genidm.experience import Experience, record
from genidm.robots.base import Robot
from genidm.tasks import Lanes, Step, WalkForward, split

# Of what Brax's loss reports, what is worth a curve.
LOSSES = ("policy_loss", "v_loss", "kl_mean", "policy_dist_mean_std")


class Learner(flax.struct.PyTreeNode):
    """All that PPO carries from one iteration to the next."""

    lanes: Lanes
    params: PPONetworkParams
    optimizer: Any
    statistics: RunningStatisticsState
    key: jax.Array


@dataclasses.dataclass(frozen=True)
class PPO:
    """Settings of PPO.

    Attributes:
      lanes: robots at once.
      unroll: steps an iteration; lanes × unroll transitions are learned from at a time.
      epochs: passes over each batch.
      minibatches: parts of the batch, each of lanes / minibatches lanes.
      learning_rate: of Adam.
      discount: of rewards, a step.
      gae: λ of generalised advantage estimation.
      clip: of the policy's ratio.
      entropy: weight of the entropy bonus.
      reward_scale: rewards are multiplied by it before the value function sees them.
      hidden: layers of the policy (Table 2: 64×64).
      value_hidden: layers of the value function.
      max_gradient: gradients are clipped to this norm.
    """

    lanes: int = 128
    unroll: int = 32
    epochs: int = 5
    minibatches: int = 8
    learning_rate: float = 5e-4
    discount: float = 0.98
    gae: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-2
    reward_scale: float = 0.1
    hidden: tuple[int, ...] = (64, 64)
    value_hidden: tuple[int, ...] = (64, 64)
    max_gradient: float = 1.0

    def networks(self, robot: Robot) -> ppo_networks.PPONetworks:
        """Brax's policy and value networks on normalised states."""
        return ppo_networks.make_ppo_networks(
            robot.observation.size,
            robot.action.size,
            preprocess_observations_fn=functools.partial(
                running_statistics.normalize, max_abs_value=10.0
            ),
            policy_hidden_layer_sizes=self.hidden,
            value_hidden_layer_sizes=self.value_hidden,
            activation=linen.tanh,
        )

    def learning(self, robot: Robot, task: WalkForward, mesh: Mesh) -> Learning:
        networks = self.networks(robot)
        optimizer = optax.chain(
            optax.clip_by_global_norm(self.max_gradient), optax.adam(self.learning_rate)
        )
        rollout = devices.over_lanes(
            functools.partial(_rollout, robot, task, networks, self.unroll),
            mesh, [None, None, 0], (0, 1),
        )  # fmt: skip
        learn = functools.partial(self._learn, networks, optimizer)

        def start(key: jax.Array) -> Learner:
            lanes, policy, value, stream = jax.random.split(key, 4)
            params = PPONetworkParams(
                networks.policy_network.init(policy), networks.value_network.init(value)
            )
            return Learner(
                lanes=task.start(robot, jax.random.split(lanes, self.lanes)),
                params=params,
                optimizer=optimizer.init(params),
                statistics=running_statistics.init_state(jnp.zeros(robot.observation.size)),
                key=stream,
            )

        def iterate(learner: Learner) -> tuple[Learner, Experience, dict[str, jax.Array]]:
            lanes, (steps, choices) = rollout(
                learner.statistics, learner.params.policy, learner.lanes
            )
            batch = devices.constrain(_transitions(steps, choices), mesh, axis=None)
            learner, losses = learn(learner.replace(lanes=lanes), batch)
            return learner, record(steps), _metrics(robot, steps) | losses

        return Learning(start, jax.jit(iterate, donate_argnums=0))

    def _learn(
        self,
        networks: ppo_networks.PPONetworks,
        optimizer: optax.GradientTransformation,
        learner: Learner,
        batch: Transition,
    ) -> tuple[Learner, dict[str, jax.Array]]:
        """`epochs` passes over a batch `[lanes, unroll, ...]`, in shuffled minibatches."""
        statistics = running_statistics.update(learner.statistics, batch.observation)
        loss = functools.partial(
            compute_ppo_loss,
            ppo_network=networks,
            entropy_cost=self.entropy,
            discounting=self.discount,
            reward_scaling=self.reward_scale,
            gae_lambda=self.gae,
            clipping_epsilon=self.clip,
        )
        update = gradient_update_fn(loss, optimizer, pmap_axis_name=None, has_aux=True)

        def minibatch(carry: Any, part: Any) -> tuple[Any, Any]:
            params, state = carry
            data, key = part
            (_, info), params, state = update(params, statistics, data, key, optimizer_state=state)
            return (params, state), info

        def epoch(carry: Any, key: jax.Array) -> tuple[Any, Any]:
            order, noise = jax.random.split(key)
            parts = _shuffled(batch, jax.random.permutation(order, self.lanes), self.minibatches)
            return jax.lax.scan(
                minibatch, carry, (parts, jax.random.split(noise, self.minibatches))
            )

        key, stream = jax.random.split(learner.key)
        (params, state), info = jax.lax.scan(
            epoch, (learner.params, learner.optimizer), jax.random.split(stream, self.epochs)
        )
        learner = learner.replace(params=params, optimizer=state, statistics=statistics, key=key)
        return learner, {name: info[name].mean() for name in LOSSES}


def _rollout(
    robot: Robot,
    task: WalkForward,
    networks: ppo_networks.PPONetworks,
    unroll: int,
    statistics: RunningStatisticsState,
    policy: Any,
    lanes: Lanes,
) -> tuple[Lanes, tuple[Step, dict[str, jax.Array]]]:
    """`unroll` steps of every lane under the policy's own noise; outputs `[unroll, B]`."""
    distribution = networks.parametric_action_distribution

    def step(lanes: Lanes, _: None) -> tuple[Lanes, tuple[Step, dict[str, jax.Array]]]:
        lanes, keys = split(lanes)
        logits = networks.policy_network.apply(statistics, policy, lanes.robots.observation)
        raw = jax.vmap(distribution.sample_no_postprocessing)(logits, keys)
        choice = {
            "distribution_params": logits,
            "raw_action": raw,
            "log_prob": distribution.log_prob(logits, raw),
        }
        lanes, transition = task.advance(robot, lanes, distribution.postprocess(raw))
        return lanes, (transition, choice)

    return jax.lax.scan(step, lanes, length=unroll)


def _transitions(steps: Step, choices: dict[str, jax.Array]) -> Transition:
    """What Brax's loss reads, `[lanes, unroll, ...]`."""
    transition = Transition(
        observation=steps.before.observation,
        action=steps.action,
        reward=steps.reward,
        discount=1.0 - steps.terminal,
        # The loss reads no next state but the one after the last step.
        next_observation=steps.after.observation[-1:],
        extras={
            "policy_extras": choices,
            "state_extras": {"truncation": 1.0 * (steps.last & ~steps.terminal)},
        },
    )
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), transition)


def _shuffled(batch: Any, order: jax.Array, parts: int) -> Any:
    """A batch `[B, ...]` in the given order, as `[parts, B / parts, ...]`."""
    return jax.tree.map(lambda x: x[order].reshape(parts, -1, *x.shape[1:]), batch)


def _metrics(robot: Robot, steps: Step) -> dict[str, jax.Array]:
    forward = steps.after.position[..., 0] - steps.before.position[..., 0]
    return {
        "reward": steps.reward.mean(),
        "speed": forward.mean() / robot.control_step,
        "falls": steps.after.fallen.mean(),
        "diverged": steps.after.diverged.sum(),
    }
