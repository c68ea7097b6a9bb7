"""GCBC, goal-conditioned behavioural cloning (Lynch et al., 2019; Ghosh et al., 2021)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from genidm.offline.data import Dataset
from genidm.offline.learner import ActorBatch, Learner, Loss, Params, draw_actor, log_prob
from genidm.offline.networks import Actor, apply


@dataclasses.dataclass(frozen=True, kw_only=True)
class GCBC(Learner):
    """Imitate what the record did on its way to each later position."""

    def draw(self, data: Dataset, key: jax.Array) -> ActorBatch:
        return draw_actor(self, data, key)

    def loss(self, params: Params, target: Params, batch: ActorBatch) -> Loss:
        """− E[log π(a | s, g)]."""
        actor = Actor(self.policy_hidden_layer_sizes, batch.a.shape[-1])
        mean = apply(actor, params["actor"], batch.actor)
        loss = -jnp.mean(log_prob(mean, batch.a))
        return loss, {"loss": loss, "mse": jnp.mean((mean - batch.a) ** 2)}
