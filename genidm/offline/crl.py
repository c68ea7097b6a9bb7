"""CRL, contrastive RL with DDPG+BC (Eysenbach et al., 2022; Park et al., 2024)."""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import optax

from genidm.checks import WIDEST, check, count, layers, number
from genidm.offline.data import Dataset, Goals, draw_goals, draw_samples
from genidm.offline.learner import Learner, Loss, Params, log_prob, together
from genidm.offline.networks import Actor, TwoEmbeddings, apply

VALUE_GOALS = Goals(geometric=True)


class Batch(flax.struct.PyTreeNode):
    """A minibatch; inputs (s, g − o) are normalised, `[n, S + 3]`.

    Attributes:
      value: s with the goal of the critic, a later position.
      actor: s with the goal of the actor.
      a: actions `[n, A]`.
    """

    value: jax.Array
    actor: jax.Array
    a: jax.Array


@dataclasses.dataclass(frozen=True, kw_only=True)
class CRL(Learner):
    """A critic φ(s, a)ᵀψ(g) / √k that tells a sample's later position from other samples'.

    A goal is relative to the robot here, so ψ embeds a displacement g − o, and the wrong goals of
    a sample are the displacements of the other samples.

    Attributes:
      value_hidden_layer_sizes: hidden layers of φ and ψ.
      latent_size: k, length of φ and ψ.
      layer_norm: normalise the output of each hidden layer of φ and ψ.
      alpha: weight of behavioural cloning against the critic.
      value_goals: where the goals of the critic come from.
    """

    value_hidden_layer_sizes: tuple[int, ...] = (512, 512, 512)
    latent_size: int = 512
    layer_norm: bool = True
    alpha: float = 0.1
    value_goals: Goals = VALUE_GOALS

    def __post_init__(self) -> None:
        super().__post_init__()
        size = count(1, WIDEST)
        check(self, value_hidden_layer_sizes=layers, latent_size=size, alpha=number(0))

    @property
    def embedding(self) -> TwoEmbeddings:
        """φ or ψ, two of each."""
        return TwoEmbeddings(self.value_hidden_layer_sizes, self.latent_size, self.layer_norm)

    def init(self, key: jax.Array, state_size: int, action_size: int) -> Params:
        actor, phi, psi = jax.random.split(key, 3)
        s_and_a = jnp.zeros(state_size + action_size)
        return super().init(actor, state_size, action_size) | {
            "phi": self.embedding.init(phi, s_and_a),
            "psi": self.embedding.init(psi, jnp.zeros(3)),
        }

    def draw(self, data: Dataset, key: jax.Array) -> Batch:
        sample_key, value_key, actor_key = jax.random.split(key, 3)
        sample = draw_samples(data, sample_key, self.batch_size)
        n = sample.n
        value_goal = draw_goals(data, value_key, n, self.value_goals, self.discounting)
        actor_goal = draw_goals(data, actor_key, n, self.actor_goals, self.discounting)
        return Batch(data.seen(sample, n, value_goal), data.seen(sample, n, actor_goal), data.a[n])

    def loss(self, params: Params, target: Params, batch: Batch) -> Loss:
        """L_critic + L_π."""
        return together(
            critic=self._loss_critic(params, batch), actor=self._loss_actor(params, batch)
        )

    def _embed(self, params: Params, x: jax.Array, a: jax.Array) -> tuple[jax.Array, jax.Array]:
        """φ(s, a) and ψ(g) `[2, n, k]` from inputs (s, g − o) and actions."""
        s_and_a = jnp.concatenate([x[..., :-3], a], axis=-1)
        phi = apply(self.embedding, params["phi"], s_and_a)
        return phi, apply(self.embedding, params["psi"], x[..., -3:])

    def _loss_critic(self, params: Params, batch: Batch) -> Loss:
        """Binary cross-entropy of every pair of sample and goal (binary NCE)."""
        phi, psi = self._embed(params, batch.value, batch.a)
        logits = jnp.einsum("eik,ejk->eij", phi, psi) / jnp.sqrt(phi.shape[-1])
        own = jnp.eye(batch.a.shape[0])
        loss = optax.sigmoid_binary_cross_entropy(
            logits, jnp.broadcast_to(own, logits.shape)
        ).mean()
        found = jnp.mean(jnp.argmax(logits.mean(0), axis=1) == jnp.arange(batch.a.shape[0]))
        return loss, {"loss": loss, "found": found}

    def _loss_actor(self, params: Params, batch: Batch) -> Loss:
        """DDPG+BC: − E[Q(s, π(s, g), g)] / E|Q| − α E[log π(a | s, g)]."""
        actor = Actor(self.policy_hidden_layer_sizes, batch.a.shape[-1])
        mean = apply(actor, params["actor"], batch.actor)
        fixed = jax.lax.stop_gradient(params)
        phi, psi = self._embed(fixed, batch.actor, jnp.clip(mean, -1, 1))
        q = jnp.min(jnp.sum(phi * psi, axis=-1) / jnp.sqrt(phi.shape[-1]), axis=0)
        scale = jax.lax.stop_gradient(jnp.abs(q).mean() + 1e-6)
        loss = -q.mean() / scale - self.alpha * log_prob(mean, batch.a).mean()
        mse = jnp.mean((mean - batch.a) ** 2)
        return loss, {"loss": loss, "q": q.mean(), "mse": mse}
