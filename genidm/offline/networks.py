"""Networks of the offline learners: Brax's MLP with GELU, as OGBench sets it up."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from brax.training.networks import MLP

Layers = tuple[int, ...]

# Scale of the variance of an actor's last layer, so that its first actions are near 0.
ACTOR_SCALE = 0.01


def mlp(layer_sizes: Layers, **settings: Any) -> MLP:
    """Make an MLP `[..., n]` → `[..., layer_sizes[-1]]` with GELU and Glorot's initial weights."""
    glorot = nn.initializers.xavier_uniform()
    return MLP(layer_sizes, activation=nn.gelu, kernel_init=glorot, **settings)


def two_mlps(layer_sizes: Layers, **settings: Any) -> nn.Module:
    """Make two MLPs that see the same input: `[..., n]` → `[2, ..., layer_sizes[-1]]`."""
    pair = nn.vmap(
        MLP, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=None, axis_size=2
    )
    glorot = nn.initializers.xavier_uniform()
    made: nn.Module = pair(layer_sizes, activation=nn.gelu, kernel_init=glorot, **settings)
    return made


class Actor(nn.Module):
    """The mean of a normal distribution with standard deviation 1 in each direction.

    Attributes:
      hidden_layer_sizes: widths of the hidden layers.
      outputs: width of the mean.
    """

    hidden_layer_sizes: Layers
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        hidden = mlp(self.hidden_layer_sizes, activate_final=True)(x)
        scale = nn.initializers.variance_scaling(ACTOR_SCALE, "fan_avg", "uniform")
        return nn.Dense(self.outputs, kernel_init=scale)(hidden)


class TwoValues(nn.Module):
    """Two estimates of V `[2, ...]`, whose minimum is a cautious one.

    Attributes:
      hidden_layer_sizes: widths of the hidden layers.
      layer_norm: normalise the output of each hidden layer.
    """

    hidden_layer_sizes: Layers
    layer_norm: bool

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return two_mlps((*self.hidden_layer_sizes, 1), layer_norm=self.layer_norm)(x)[..., 0]


class GoalRepresentation(nn.Module):
    """φ(s, g) of length √k: the subgoals that HIQL's high level chooses.

    Attributes:
      hidden_layer_sizes: widths of the hidden layers.
      size: k, length of the output.
      layer_norm: normalise the output of each hidden layer.
    """

    hidden_layer_sizes: Layers
    size: int
    layer_norm: bool

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return unit_rms(mlp((*self.hidden_layer_sizes, self.size), layer_norm=self.layer_norm)(x))


def unit_rms(x: jax.Array) -> jax.Array:
    """Scale vectors `[..., k]` to length √k."""
    return x / jnp.linalg.norm(x, axis=-1, keepdims=True) * jnp.sqrt(x.shape[-1])


class TwoEmbeddings(nn.Module):
    """Two embeddings `[2, ..., latent_size]` of one side of a contrastive critic.

    Attributes:
      hidden_layer_sizes: widths of the hidden layers.
      latent_size: length of an embedding.
      layer_norm: normalise the output of each hidden layer.
    """

    hidden_layer_sizes: Layers
    latent_size: int
    layer_norm: bool

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        sizes = (*self.hidden_layer_sizes, self.latent_size)
        return two_mlps(sizes, layer_norm=self.layer_norm)(x)


def apply(module: nn.Module, params: Any, x: jax.Array) -> jax.Array:
    """Apply a network to inputs `[..., n]`."""
    out = module.apply(params, x)
    assert isinstance(out, jax.Array)  # not (out, state): no collection is mutable
    return out


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Shape of a policy: one actor, or two levels that a subgoal connects.

    Attributes:
      action_size: A, length of an action.
      policy_hidden_layer_sizes: hidden layers of every actor.
      representation_size: k, length of a subgoal's representation; None for one actor.
    """

    action_size: int
    policy_hidden_layer_sizes: Layers
    representation_size: int | None = None

    def init(self, key: jax.Array, state_size: int) -> dict[str, Any]:
        """Initialise parameters: {"actor": …}, or {"high_actor": …, "low_actor": …}."""
        x = jnp.zeros(state_size + 3, jnp.float32)
        if self.representation_size is None:
            return {"actor": self.actor.init(key, x)}
        high, low = jax.random.split(key)
        seen = jnp.zeros(state_size + self.representation_size, jnp.float32)
        return {
            "high_actor": self.high_actor.init(high, x),
            "low_actor": self.actor.init(low, seen),
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the actors in the parameters."""
        return ("actor",) if self.representation_size is None else ("high_actor", "low_actor")

    @property
    def actor(self) -> Actor:
        """π(a | s, g), or the low level π(a | s, φ) of two."""
        return Actor(self.policy_hidden_layer_sizes, self.action_size)

    @property
    def high_actor(self) -> Actor:
        """The high level π(φ | s, g) of two."""
        return Actor(self.policy_hidden_layer_sizes, self.representation_size or 0)

    def action(self, params: dict[str, Any], x: jax.Array) -> jax.Array:
        """Compute the mean action `[..., A]`, not clipped, of inputs (s, g − o) `[..., S + 3]`."""
        if self.representation_size is None:
            return apply(self.actor, params["actor"], x)
        subgoal = unit_rms(apply(self.high_actor, params["high_actor"], x))
        seen = jnp.concatenate([x[..., :-3], subgoal], axis=-1)
        return apply(self.actor, params["low_actor"], seen)
