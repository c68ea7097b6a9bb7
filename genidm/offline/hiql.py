"""HIQL, hierarchical implicit Q-learning (Park et al., 2023)."""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from genidm.checks import WIDEST, check, count, number
from genidm.errors import BadInput
from genidm.offline.data import Dataset, draw_goals, draw_samples, future_states, random_states
from genidm.offline.implicit import ImplicitValue, loss_value
from genidm.offline.learner import Loss, Params, loss_awr, together
from genidm.offline.networks import Architecture, GoalRepresentation, apply


class Batch(flax.struct.PyTreeNode):
    """A minibatch; inputs (s, g − o) are normalised, `[n, S + 3]`.

    Attributes:
      value: s with the goal of V.
      value_next: s' with the goal of V.
      low: s with the position of w, `subgoal_steps` ahead, as the goal.
      low_next: s' with the same goal.
      high: s with the goal of the high level.
      subgoal: s with the position of the subgoal w of the high level, at most `subgoal_steps`
        ahead and no farther than its goal.
      high_next: w with the goal of the high level.
      a: actions `[n, A]`.
      reward: `[n]`, 0 if the goal of V is the position of the step itself, else −1.
      mask: `[n]`, 0 if the goal of V is the position of the step itself, else 1.
    """

    value: jax.Array
    value_next: jax.Array
    low: jax.Array
    low_next: jax.Array
    high: jax.Array
    subgoal: jax.Array
    high_next: jax.Array
    a: jax.Array
    reward: jax.Array
    mask: jax.Array


@dataclasses.dataclass(frozen=True, kw_only=True)
class HIQL(ImplicitValue):
    """V(s, φ(s, g)); a high level that chooses subgoals φ(s, w); a low level that goes there.

    Attributes:
      low_alpha: inverse temperature of the low level's AWR.
      high_alpha: inverse temperature of the high level's AWR.
      subgoal_steps: steps from a state to its subgoal w.
      representation_size: k, length of φ.
    """

    expectile: float = 0.7
    low_alpha: float = 3.0
    high_alpha: float = 3.0
    subgoal_steps: int = 25
    representation_size: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        alpha, size = number(0), count(1, WIDEST)
        check(self, low_alpha=alpha, high_alpha=alpha, representation_size=size)
        check(self, subgoal_steps=count())
        if self.actor_goals.current:
            raise BadInput("HIQL's high level has no current goals: set actor_goals.current to 0")

    def architecture(self, action_size: int) -> Architecture:
        layers, k = self.policy_hidden_layer_sizes, self.representation_size
        return Architecture(action_size, layers, k)

    @property
    def representation(self) -> GoalRepresentation:
        """φ(s, g)."""
        k = self.representation_size
        return GoalRepresentation(self.value_hidden_layer_sizes, k, self.layer_norm)

    def init(self, key: jax.Array, state_size: int, action_size: int) -> Params:
        actors, value, phi = jax.random.split(key, 3)
        return super().init(actors, state_size, action_size) | {
            "value": self.value.init(value, jnp.zeros(state_size + self.representation_size)),
            "representation": self.representation.init(phi, jnp.zeros(state_size + 3)),
        }

    def draw(self, data: Dataset, key: jax.Array) -> Batch:
        sample_key, value_key, high_key = jax.random.split(key, 3)
        sample = draw_samples(data, sample_key, self.batch_size)
        n = sample.n
        value_goal = draw_goals(data, value_key, n, self.value_goals, self.discounting)
        ahead = jnp.minimum(n + self.subgoal_steps, data.end[n])
        high_goal, subgoal = self._draw_high(data, high_key, n, ahead)
        away = 1.0 * (value_goal != n)
        steps = jnp.stack([n, n + 1, n, n + 1, n, n, subgoal])
        goals = jnp.stack([value_goal, value_goal, ahead, ahead, high_goal, subgoal, high_goal])
        names = ("value", "value_next", "low", "low_next", "high", "subgoal", "high_next")
        seen = dict(zip(names, data.seen(sample, steps, goals), strict=True))
        return Batch(**seen, a=data.a[n], reward=-away, mask=away)

    def _draw_high(
        self, data: Dataset, key: jax.Array, n: jax.Array, ahead: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The high level's goals `[n]`, and their subgoals `[n]`."""
        future_key, random_key, kind_key = jax.random.split(key, 3)
        goals = self.actor_goals
        future = future_states(data, future_key, n, goals.geometric, self.discounting)
        random = random_states(data, random_key, n.size)
        is_random = jax.random.uniform(kind_key, n.shape) < goals.random
        subgoal = jnp.where(is_random, ahead, jnp.minimum(ahead, future))
        return jnp.where(is_random, random, future), subgoal

    def loss(self, params: Params, target: Params, batch: Batch) -> Loss:
        """L_V + L_low + L_high; φ learns from L_V alone."""
        fixed = jax.lax.stop_gradient(params)
        loss_v = loss_value(
            lambda x: self._value(params, x),
            lambda x: self._value(fixed | target, x),
            (batch.value, batch.value_next),
            (batch.reward, batch.mask),
            self.discounting,
            self.expectile,
        )
        seen = jnp.stack([batch.low_next, batch.low, batch.high_next, batch.high])
        low_after, low_now, high_after, high_now = self._value(fixed, seen).mean(0)
        levels = Architecture(
            batch.a.shape[-1], self.policy_hidden_layer_sizes, self.representation_size
        )
        low_sees = self._with_representation(fixed, batch.low)
        low = apply(levels.actor, params["low_actor"], low_sees)
        high = apply(levels.high_actor, params["high_actor"], batch.high)
        subgoal = apply(self.representation, fixed["representation"], batch.subgoal)
        return together(
            value=loss_v,
            low=loss_awr(low, batch.a, low_after - low_now, self.low_alpha),
            high=loss_awr(high, subgoal, high_after - high_now, self.high_alpha),
        )

    def _with_representation(self, params: Params, x: jax.Array) -> jax.Array:
        """(s, φ(s, g)) `[..., S + k]` from inputs (s, g − o) `[..., S + 3]`."""
        phi = apply(self.representation, params["representation"], x)
        return jnp.concatenate([x[..., :-3], phi], axis=-1)

    def _value(self, params: Params, x: jax.Array) -> jax.Array:
        """V(s, φ(s, g)) `[2, ...]`; the target has an own V, but no own φ, as in OGBench."""
        return apply(self.value, params["value"], self._with_representation(params, x))
