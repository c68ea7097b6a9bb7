"""The implicit V-learning that GCIVL and HIQL share (Kostrikov et al., 2022; Park et al., 2023)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from genidm.checks import check, layers, number
from genidm.offline.data import Goals
from genidm.offline.learner import Learner, Loss, Params
from genidm.offline.networks import TwoValues

VALUE_GOALS = Goals(current=0.2, future=0.5, random=0.3, geometric=True)

ValueFn = Callable[[jax.Array], jax.Array]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImplicitValue(Learner):
    """A learner with V(s, g), fitted to an upper expectile.

    Attributes:
      value_hidden_layer_sizes: hidden layers of V.
      layer_norm: normalise the output of each hidden layer of V.
      tau: share of the new parameters in each update of the target of V.
      expectile: in (0, 1); above 0.5 the value prefers the better outcomes of a state.
      value_goals: where the goals of V come from.
    """

    value_hidden_layer_sizes: tuple[int, ...] = (512, 512, 512)
    layer_norm: bool = True
    tau: float = 0.005
    expectile: float = 0.9
    value_goals: Goals = VALUE_GOALS

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self,
            value_hidden_layer_sizes=layers,
            tau=number(0, 1, above=True),
            expectile=number(0, 1, above=True, below=True),
        )

    @property
    def value(self) -> TwoValues:
        """V, two estimates."""
        return TwoValues(self.value_hidden_layer_sizes, self.layer_norm)

    def targets(self, params: Params) -> Params:
        return {"value": params["value"]}

    def moved(self, target: Params, params: Params) -> Params:
        moved: Params = optax.incremental_update(self.targets(params), target, self.tau)
        return moved


def loss_expectile(advantage: jax.Array, error: jax.Array, expectile: float) -> jax.Array:
    """|τ − 1(A < 0)| · error², batch mean (`[n]` each)."""
    return jnp.mean(jnp.where(advantage >= 0, expectile, 1 - expectile) * error**2)


def loss_value(
    value: ValueFn,
    target: ValueFn,
    seen: tuple[jax.Array, jax.Array],
    reward_mask: tuple[jax.Array, jax.Array],
    discounting: float,
    expectile: float,
) -> Loss:
    """The expectile loss of V(s, g) against r + γ m V̄(s', g), for both estimates.

    The sign of the advantage is that of the targets, and the error is that of V itself, which
    keeps overestimates small, as double DQN does.

    Args:
      value: inputs `[..., S + 3]` → V `[2, ...]`.
      target: the same of the target, V̄.
      seen: inputs of s and of s', with the same goal.
      reward_mask: r `[n]`, −1 on the way and 0 at the goal; m `[n]`, 0 at the goal.
      discounting: γ.
      expectile: expectile, in (0, 1).
    """
    (now, after), (reward, mask) = seen, reward_mask
    v_next, v_target = jnp.moveaxis(target(jnp.stack([after, now])), 1, 0)
    q = reward + discounting * mask * v_next.min(0)
    advantage = q - v_target.mean(0)
    v = value(now)
    errors = reward + discounting * mask * v_next - v
    loss = sum(
        (loss_expectile(advantage, error, expectile) for error in errors), start=jnp.float32(0)
    )
    return loss, {"loss": loss, "mean": v.mean(), "min": v.mean(0).min(), "max": v.mean(0).max()}
