"""The two models (Eq. 1, 3, 4): the latent feature model ψ and the inverse dynamics model φ."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp


class MLP(nn.Module):
    """A multilayer perceptron with ReLU, linear at the end.

    Attributes:
      hidden: widths of the hidden layers.
      outputs: width of the output.
    """

    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.hidden:
            x = nn.relu(nn.Dense(width)(x))
        return nn.Dense(self.outputs)(x)


def _apply(model: MLP, params: Any, x: jax.Array) -> jax.Array:
    out = model.apply(params, x)
    assert isinstance(out, jax.Array)  # and no state beside it
    return out


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Shape of the models (Table 2).

    Attributes:
      action_size: A.
      idm: hidden layers of φ.
      lfm: hidden layers of ψ; unused without a latent.
      latent_size: k, or None for an IDM without LFM (RS, RL, GE).
    """

    action_size: int
    idm: tuple[int, ...]
    lfm: tuple[int, ...]
    latent_size: int | None

    def init(self, key: jax.Array, state_size: int) -> dict[str, object]:
        """Fresh parameters {"idm": …} and, with a latent, {"lfm": …}."""
        psi, phi = jax.random.split(key)
        x = jnp.zeros(state_size + 3)
        if self.latent_size is None:
            return {"idm": self._idm().init(phi, x)}
        return {
            "lfm": self._lfm().init(psi, x),
            "idm": self._idm().init(phi, jnp.zeros(self.latent_size)),
        }

    def _idm(self) -> MLP:
        return MLP(self.idm, self.action_size)

    def _lfm(self) -> MLP:
        return MLP(self.lfm, self.latent_size or 0)

    def latent(self, params: dict, s: jax.Array, d: jax.Array) -> jax.Array:
        """ψ(s, d) = γ `[..., k]` (Eq. 3); without an LFM, the pair (s, d) `[..., S + 3]` itself.

        Args:
          params: from `init`.
          s: normalised states `[..., S]`.
          d: unit vectors `[..., 3]`.
        """
        x = jnp.concatenate([s, d], axis=-1)
        return x if self.latent_size is None else _apply(self._lfm(), params["lfm"], x)

    def action(self, params: dict, latent: jax.Array) -> jax.Array:
        """φ(γ) = a `[..., A]` (Eq. 4, or Eq. 1 without an LFM)."""
        return _apply(self._idm(), params["idm"], latent)
