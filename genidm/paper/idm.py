"""The two models and their losses: Def. 2, Def. 5, Eq. 1 and Eq. 3–7.

φ is the inverse dynamics model (IDM), ψ the latent feature model (LFM). The models see (s, d)
in place of (s, o, o') (Remark 2). Eq. 2 is in `pairs`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp

from genidm.paper.pairs import Pairs

# SimBa's ratio of a block's inner width to its width.
EXPANSION = 4


class MLP(nn.Module):
    """A multilayer perceptron with ReLU and a linear output layer.

    Attributes:
      hidden_layer_sizes: widths of the hidden layers.
      outputs: width of the output.
    """

    hidden_layer_sizes: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.hidden_layer_sizes:
            x = nn.relu(nn.Dense(width)(x))
        return nn.Dense(self.outputs)(x)


class ResidualMLP(nn.Module):
    """Residual blocks with layer normalisation, as in SimBa (Lee et al. 2024, arXiv 2410.09754).

    A block adds to its input x a layer of ReLU, `EXPANSION` times as wide, of the normalised x.

    Attributes:
      hidden_layer_sizes: width of each block; all are equal.
      outputs: width of the output.
    """

    hidden_layer_sizes: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        x = nn.Dense(self.hidden_layer_sizes[0])(x)
        for width in self.hidden_layer_sizes:
            wide = nn.relu(nn.Dense(EXPANSION * width)(nn.LayerNorm()(x)))
            x = x + nn.Dense(width)(wide)
        return nn.Dense(self.outputs)(nn.LayerNorm()(x))


Network = Literal["mlp", "residual"]
NETWORKS: dict[Network, type[MLP] | type[ResidualMLP]] = {"mlp": MLP, "residual": ResidualMLP}


def _apply(model: Any, params: Any, x: jax.Array) -> jax.Array:
    out = model.apply(params, x)
    assert isinstance(out, jax.Array)  # not (out, state): no collection is mutable
    return out


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Shape of the models (Table 2).

    Attributes:
      action_size: A, length of an action.
      idm: hidden layers of φ.
      lfm: hidden layers of ψ; unused without a latent.
      latent_size: k, or None for an IDM without LFM (RS, RL, GE).
      network: "mlp" (the paper's), or "residual".
    """

    action_size: int
    idm: tuple[int, ...]
    lfm: tuple[int, ...]
    latent_size: int | None
    network: Network = "mlp"

    def init(self, key: jax.Array, state_size: int) -> dict[str, object]:
        """Initialise parameters: {"idm": …} and, with a latent, {"lfm": …}."""
        psi, phi = jax.random.split(key)
        x = jnp.zeros(state_size + 3, jnp.float32)
        if self.latent_size is None:
            return {"idm": self._idm().init(phi, x)}
        return {
            "lfm": self._lfm().init(psi, x),
            "idm": self._idm().init(phi, jnp.zeros(self.latent_size, jnp.float32)),
        }

    def _idm(self) -> MLP | ResidualMLP:
        return NETWORKS[self.network](self.idm, self.action_size)

    def _lfm(self) -> MLP | ResidualMLP:
        return NETWORKS[self.network](self.lfm, self.latent_size or 0)

    def latent(self, params: dict, s: jax.Array, d: jax.Array) -> jax.Array:
        """Compute ψ(s, d) = γ `[..., k]` (Def. 5, Eq. 3); without an LFM, (s, d) `[..., S + 3]`.

        Args:
          params: parameters from `init`.
          s: normalised states `[..., S]`.
          d: unit vectors `[..., 3]` (Remark 2).
        """
        x = jnp.concatenate([s, d], axis=-1)
        return x if self.latent_size is None else _apply(self._lfm(), params["lfm"], x)

    def action(self, params: dict, latent: jax.Array) -> jax.Array:
        """Compute φ(γ) = a `[..., A]` (Eq. 4); without an LFM, φ(s, d) = a (Def. 2, Eq. 1)."""
        return _apply(self._idm(), params["idm"], latent)


class Model(Protocol):
    """ψ and φ with their parameters, as the losses use them."""

    def latent(self, s: jax.Array, d: jax.Array) -> jax.Array:
        """Compute γ = ψ(s, d) `[..., k]` (Eq. 3); without an LFM, (s, d)."""

    def action(self, latent: jax.Array) -> jax.Array:
        """Compute φ(γ) `[..., A]` (Eq. 4; Eq. 1 without an LFM)."""


def loss_latent(latent: jax.Array, latent_hat: jax.Array) -> jax.Array:
    """L1 (Eq. 5): squared distance between latents `[..., k]` of e.m.o. samples, batch mean."""
    return jnp.mean(jnp.sum((latent - latent_hat) ** 2, axis=-1))


def loss_action(predicted: jax.Array, action: jax.Array) -> jax.Array:
    """L2 (Eq. 6): squared distance between actions `[..., A]`, batch mean."""
    return jnp.mean(jnp.sum((predicted - action) ** 2, axis=-1))


def loss_plain(model: Model, batch: Pairs) -> tuple[jax.Array, dict[str, jax.Array]]:
    """L2 of an IDM on samples with one view: the loss of methods without an LFM (RS, RL, GE)."""
    action = loss_action(model.action(model.latent(batch.s[0], batch.d[0])), batch.a)
    return action, {"loss": action, "loss_action": action}


def loss_siamese(
    model: Model, batch: Pairs, latent_loss_weight: float, mean_latent: bool
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """L = λ L1 + (1 − λ) L2 (Eq. 7, Fig. 4) on samples with two views.

    φ sees the mean of the two latents (Eq. 6) if `mean_latent` is True, else each latent.
    """
    latents = model.latent(batch.s, batch.d)
    latent = loss_latent(latents[0], latents[1])
    phi_input = latents.mean(0, keepdims=True) if mean_latent else latents
    predicted = model.action(phi_input)
    action = loss_action(predicted, jnp.broadcast_to(batch.a, predicted.shape))
    loss = latent_loss_weight * latent + (1 - latent_loss_weight) * action
    return loss, {"loss": loss, "loss_latent": latent, "loss_action": action}
