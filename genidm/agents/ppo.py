"""PPO (Schulman et al. 2017), composed from Brax's networks, losses and statistics.

An iteration is two programs. In the first every device steps its own lanes; in the second
the running statistics take the new inputs in, and the networks learn from the batch in
`epochs` passes, on one device: networks this small learn faster than their gradients could
be averaged (four CPU devices: 0.3 s an iteration instead of 0.6), what is learned does not
depend on the number of devices, and no program waits for another device, which XLA's
collectives on a CPU can do forever when cores are scarce.
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
from brax.training.types import Transition
from flax import linen
from jax.sharding import Mesh

from genidm.agents.alternating import Alternates, Alternating, Learner
from genidm.agents.base import Metrics
from genidm.agents.policy import Activation, no_statistics, normalize
from genidm.agents.walking import walk
from genidm.checks import check, count, layers, number, positive
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.robots.base import Robot
from genidm.tasks import Lanes, Step, Task, input_size, inputs, outlook

# Of what Brax's loss reports, what is worth a curve.
LOSSES = ("policy_loss", "v_loss", "kl_mean", "policy_dist_mean_std")


class TrainingState(flax.struct.PyTreeNode):
    """What learns: networks, their optimizer, the statistics of the states, a key."""

    params: PPONetworkParams
    optimizer: Any
    statistics: RunningStatisticsState
    key: jax.Array

    @property
    def chosen(self) -> tuple[RunningStatisticsState, Any]:
        """What chooses actions."""
        return self.statistics, self.params.policy


@dataclasses.dataclass(frozen=True)
class PPO(Alternates):
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

    activation: ClassVar[Activation] = "tanh"

    lanes: int = 128
    unroll: int = 16
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 5e-4
    discount: float = 0.99
    gae: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-3
    reward_scale: float = 0.1
    hidden: tuple[int, ...] = (64, 64)
    value_hidden: tuple[int, ...] = (64, 64)
    max_gradient: float = 1.0

    def __post_init__(self) -> None:
        check(
            self, lanes=count(), unroll=count(), epochs=count(), minibatches=count(),
            learning_rate=positive(), discount=number(0, 1, above=True, below=True),
            gae=number(0, 1), clip=positive(), entropy=number(0), reward_scale=positive(),
            hidden=layers, value_hidden=layers, max_gradient=positive(),
        )  # fmt: skip
        if self.lanes % self.minibatches:
            uneven = f"{self.lanes} lanes cannot be shared among {self.minibatches} minibatches"
            raise BadInput(f"{uneven} evenly")

    def networks(self, robot: Robot, task: Task) -> ppo_networks.PPONetworks:
        """Brax's policy and value networks on normalised inputs."""
        return ppo_networks.make_ppo_networks(
            input_size(robot, task),
            robot.action.size,
            preprocess_observations_fn=normalize,
            policy_hidden_layer_sizes=self.hidden,
            value_hidden_layer_sizes=self.value_hidden,
            activation=linen.tanh,
        )

    def programs(self, robot: Robot, task: Task, mesh: Mesh) -> Alternating:
        """The two programs of an iteration."""
        networks = self.networks(robot, task)
        optimizer = optax.chain(
            optax.clip_by_global_norm(self.max_gradient), optax.adam(self.learning_rate)
        )
        walk = functools.partial(_walk, robot, task, networks, self.unroll, self.discount)
        learn = functools.partial(self._learn, networks, optimizer)

        def start(key: jax.Array) -> Learner:
            lanes, policy, value, stream = jax.random.split(key, 4)
            params = PPONetworkParams(
                networks.policy_network.init(policy), networks.value_network.init(value)
            )
            return Learner(
                lanes=task.start(robot, jax.random.split(lanes, self.lanes)),
                training=TrainingState(
                    params=params,
                    optimizer=optimizer.init(params),
                    statistics=no_statistics(input_size(robot, task)),
                    key=stream,
                ),
            )

        return Alternating("PPO", start, walk, learn, mesh)

    def _learn(
        self,
        networks: ppo_networks.PPONetworks,
        optimizer: optax.GradientTransformation,
        training: TrainingState,
        batch: Transition,
    ) -> tuple[TrainingState, Metrics]:
        """`epochs` passes over a batch `[unroll, lanes, ...]`, in shuffled minibatches."""
        batch = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch)
        statistics = running_statistics.update(training.statistics, batch.observation)
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

        key, stream = jax.random.split(training.key)
        (params, state), info = jax.lax.scan(
            epoch, (training.params, training.optimizer), jax.random.split(stream, self.epochs)
        )
        return TrainingState(params, state, statistics, key), {n: info[n].mean() for n in LOSSES}


def _walk(
    robot: Robot,
    task: Task,
    networks: ppo_networks.PPONetworks,
    unroll: int,
    discount: float,
    statistics: RunningStatisticsState,
    policy: Any,
    lanes: Lanes,
) -> tuple[Lanes, Experience, Transition, Metrics]:
    """`unroll` steps of every lane under the policy's own noise; outputs `[unroll, B, ...]`."""
    distribution = networks.parametric_action_distribution

    def draw(key: jax.Array) -> jax.Array:
        return jax.random.normal(key, (robot.action.size,), jnp.float32)

    def choose(x: jax.Array, noise: jax.Array) -> tuple[jax.Array, Any]:
        logits = networks.policy_network.apply(statistics, policy, x)
        normal = distribution.create_dist(logits)
        raw = normal.loc + normal.scale * noise
        return distribution.postprocess(raw), (logits, raw)

    def keep(step: Step, notes: Any) -> dict[str, Any]:
        logits, raw = notes
        return {
            "goal": step.goal,
            "reward": outlook(step, discount),
            "discount": 1.0 - step.terminal,
            "truncation": 1.0 * (step.last & ~step.terminal),
            "distribution_params": logits,
            "raw_action": raw,
        }

    lanes, experience, kept, seen = walk(robot, task, unroll, draw, choose, keep, lanes)
    kept["log_prob"] = distribution.log_prob(kept["distribution_params"], kept["raw_action"])
    return lanes, experience, transition(experience, kept, lanes), seen


def transition(experience: Experience, kept: dict[str, Any], lanes: Lanes) -> Transition:
    """What Brax's loss reads of steps `[T, B]`.

    Args:
      experience: the steps.
      kept: what PPO has kept of them.
      lanes: Lanes `[B]` after the last step. The loss asks for the value of its state alone, and
        not at all where the last step has ended an episode.
    """
    goal = kept["goal"]
    after = inputs(lanes.robots.observation, lanes.displacement)
    choice = ("distribution_params", "raw_action", "log_prob")
    return Transition(
        observation=inputs(experience.s, None if goal is None else goal - experience.o),
        action=experience.a,
        reward=kept["reward"],
        discount=kept["discount"],
        next_observation=after[None],
        extras={
            "policy_extras": {name: kept[name] for name in choice},
            "state_extras": {"truncation": kept["truncation"]},
        },
    )


def _shuffled(batch: Any, order: jax.Array, parts: int) -> Any:
    """A batch `[B, ...]` in the given order, as `[parts, B / parts, ...]`."""
    return jax.tree.map(lambda x: x[order].reshape(parts, -1, *x.shape[1:]), batch)
