"""GCIVL, goal-conditioned implicit V-learning (OGBench's variant of IQL without Q)."""

from __future__ import annotations

import dataclasses
import functools

import flax.struct
import jax
import jax.numpy as jnp

from genidm.checks import check, number
from genidm.offline.data import Dataset, draw_goals, draw_samples
from genidm.offline.implicit import ImplicitValue, loss_value
from genidm.offline.learner import Loss, Params, loss_awr, together
from genidm.offline.networks import Actor, apply


class Batch(flax.struct.PyTreeNode):
    """A minibatch; inputs (s, g − o) are normalised, `[n, S + 3]`.

    Attributes:
      value: s with the goal of V.
      value_next: s' with the goal of V.
      actor: s with the goal of the actor.
      actor_next: s' with the goal of the actor.
      a: actions `[n, A]`.
      reward: `[n]`, 0 if the goal of V is the position of the step itself, else −1.
      mask: `[n]`, 0 if the goal of V is the position of the step itself, else 1.
    """

    value: jax.Array
    value_next: jax.Array
    actor: jax.Array
    actor_next: jax.Array
    a: jax.Array
    reward: jax.Array
    mask: jax.Array


@dataclasses.dataclass(frozen=True, kw_only=True)
class GCIVL(ImplicitValue):
    """V(s, g) by an expectile, and the actions that raise it by AWR.

    Attributes:
      alpha: inverse temperature of AWR.
    """

    alpha: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, alpha=number(0))

    def init(self, key: jax.Array, state_size: int, action_size: int) -> Params:
        actor, value = jax.random.split(key)
        x = jnp.zeros(state_size + 3)
        return super().init(actor, state_size, action_size) | {"value": self.value.init(value, x)}

    def draw(self, data: Dataset, key: jax.Array) -> Batch:
        sample_key, value_key, actor_key = jax.random.split(key, 3)
        sample = draw_samples(data, sample_key, self.batch_size)
        n = sample.n
        value_goal = draw_goals(data, value_key, n, self.value_goals, self.discounting)
        actor_goal = draw_goals(data, actor_key, n, self.actor_goals, self.discounting)
        away = 1.0 * (value_goal != n)
        steps = jnp.stack([n, n + 1, n, n + 1])
        goals = jnp.stack([value_goal, value_goal, actor_goal, actor_goal])
        value, value_next, actor, actor_next = data.seen(sample, steps, goals)
        return Batch(value, value_next, actor, actor_next, data.a[n], reward=-away, mask=away)

    def loss(self, params: Params, target: Params, batch: Batch) -> Loss:
        """L_V + L_π, with A = V(s', g) − V(s, g)."""
        value = functools.partial(apply, self.value)
        loss_v = loss_value(
            functools.partial(value, params["value"]),
            functools.partial(value, target["value"]),
            (batch.value, batch.value_next),
            (batch.reward, batch.mask),
            self.discounting,
            self.expectile,
        )
        fixed = jax.lax.stop_gradient(params["value"])
        after, now = value(fixed, jnp.stack([batch.actor_next, batch.actor])).mean(0)
        advantage = after - now
        actor = Actor(self.policy_hidden_layer_sizes, batch.a.shape[-1])
        mean = apply(actor, params["actor"], batch.actor)
        return together(value=loss_v, actor=loss_awr(mean, batch.a, advantage, self.alpha))
