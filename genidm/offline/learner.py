"""What all offline learners share: settings, the log-likelihood of an action, and AWR."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from genidm.checks import check, count, layers, number, positive
from genidm.offline.data import Dataset, Goals, draw_goals, draw_samples
from genidm.offline.networks import Architecture

Info = dict[str, jax.Array]
Loss = tuple[jax.Array, Info]
Params = dict[str, Any]

# A minibatch of this size takes some GB: several views through networks of 512.
MOST_IN_BATCH = 1 << 16
# Largest weight of a sample in AWR.
MOST_WEIGHT = 100.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Learner(abc.ABC):
    """Settings of an offline learner; the defaults of a subclass are OGBench's, but for `updates`.

    Attributes:
      updates: number of minibatches (OGBench: 1 M).
      batch_size: samples per minibatch.
      learning_rate: learning rate of Adam.
      policy_hidden_layer_sizes: hidden layers of every actor.
      discounting: γ, of the value and of geometric goals.
      actor_goals: where the goals of the actor come from.
    """

    updates: int = 20_000
    batch_size: int = 1024
    learning_rate: float = 3e-4
    policy_hidden_layer_sizes: tuple[int, ...] = (512, 512, 512)
    discounting: float = 0.99
    actor_goals: Goals = dataclasses.field(default_factory=Goals)

    def __post_init__(self) -> None:
        check(
            self,
            updates=count(),
            batch_size=count(1, MOST_IN_BATCH),
            learning_rate=positive(),
            policy_hidden_layer_sizes=layers,
            discounting=number(0, 1, above=True, below=True),
        )

    def architecture(self, action_size: int) -> Architecture:
        """The shape of the policy."""
        return Architecture(action_size, self.policy_hidden_layer_sizes)

    def init(self, key: jax.Array, state_size: int, action_size: int) -> Params:
        """Initialise the parameters of all networks: name → parameters."""
        return self.architecture(action_size).init(key, state_size)

    def targets(self, params: Params) -> Params:
        """The part of the parameters that has a slowly moving copy, the target."""
        return {}

    def moved(self, target: Params, params: Params) -> Params:
        """The targets after an update that began with `params`."""
        return target

    @abc.abstractmethod
    def draw(self, data: Dataset, key: jax.Array) -> Any:
        """Draw a minibatch with its goals."""

    @abc.abstractmethod
    def loss(self, params: Params, target: Params, batch: Any) -> Loss:
        """The sum of all losses of a minibatch, and what to report.

        Args:
          params: parameters of all networks; the loss is differentiated by them.
          target: the targets.
          batch: a minibatch from `draw`.
        """


class ActorBatch(flax.struct.PyTreeNode):
    """Samples for an actor alone.

    Attributes:
      actor: inputs (s, g − o) `[n, S + 3]` with the actor's goal.
      a: actions `[n, A]`.
    """

    actor: jax.Array
    a: jax.Array


def draw_actor(learner: Learner, data: Dataset, key: jax.Array) -> ActorBatch:
    """Draw samples with the goals of an actor."""
    sample_key, goal_key = jax.random.split(key)
    sample = draw_samples(data, sample_key, learner.batch_size)
    goal = draw_goals(data, goal_key, sample.n, learner.actor_goals, learner.discounting)
    return ActorBatch(data.seen(sample, sample.n, goal), data.a[sample.n])


def log_prob(mean: jax.Array, x: jax.Array) -> jax.Array:
    """log N(x; mean, 1) `[...]` of vectors `[..., n]`."""
    return -0.5 * (jnp.sum((x - mean) ** 2, axis=-1) + x.shape[-1] * jnp.log(2 * jnp.pi))


def loss_awr(mean: jax.Array, x: jax.Array, advantage: jax.Array, alpha: float) -> Loss:
    """Advantage-weighted regression: − E[min(e^{α A}, 100) log π(x)].

    Args:
      mean: mean of π `[n, k]`.
      x: what π imitates `[n, k]`.
      advantage: A `[n]`.
      alpha: inverse temperature; 0 imitates all samples alike.
    """
    weight = jnp.minimum(jnp.exp(alpha * advantage), MOST_WEIGHT)
    log_likelihood = log_prob(mean, x)
    loss = -jnp.mean(weight * log_likelihood)
    mse = jnp.mean((mean - x) ** 2)
    return loss, {"loss": loss, "advantage": advantage.mean(), "mse": mse}


def together(**losses: Loss) -> Loss:
    """The sum of losses; each one's report gets its name in front."""
    total = sum((loss for loss, _ in losses.values()), start=jnp.float32(0))
    named = (
        (f"{part}_{name}", x) for part, (_, info) in losses.items() for name, x in info.items()
    )
    return total, {"loss": total, **dict(named)}
