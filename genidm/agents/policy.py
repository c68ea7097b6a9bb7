"""What an agent has learned, as a controller: (s, g − o) → a, without exploration."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.networks import MLP
from flax import linen

from genidm import files
from genidm.checks import check_value, layers, one_of
from genidm.robots.base import Robot
from genidm.tasks import inputs

Activation = Literal["tanh", "relu"]
ACTIVATIONS: dict[Activation, Callable[[jax.Array], jax.Array]] = {
    "tanh": linen.tanh,
    "relu": linen.relu,
}

# Normalised inputs are kept within ± this, for the networks of all agents.
normalize = functools.partial(running_statistics.normalize, max_abs_value=10.0)


def no_statistics(size: int) -> RunningStatisticsState:
    """Of no inputs yet; of strong types, as those from a checkpoint: one program serves both."""
    state = running_statistics.init_state(jnp.zeros(size, jnp.float32))
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), state)


def described(robot: Robot) -> dict[str, Any]:
    """What a controller's directory says of its robot: the name, and what it sees and does."""
    return {
        "robot": robot.name,
        "observation": robot.observation.listed(),
        "action": robot.action.listed(),
    }


class Policy(flax.struct.PyTreeNode):
    """The mean action of a trained policy network, squashed by tanh.

    Attributes:
      params: of Brax's policy network; its first A outputs are the mean.
      mean: `[I]`, of the inputs seen while learning.
      std: `[I]`.
      policy_hidden_layer_sizes: layers of the network.
      activation: of the hidden layers.
      goal_conditioned: fed (s, g − o); s alone otherwise.
      robot: the robot that it was trained on.
    """

    params: Any
    mean: jax.Array
    std: jax.Array
    policy_hidden_layer_sizes: tuple[int, ...] = flax.struct.field(pytree_node=False)
    activation: Activation = flax.struct.field(pytree_node=False)
    goal_conditioned: bool = flax.struct.field(pytree_node=False)
    robot: Robot = flax.struct.field(pytree_node=False)

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """Actions `[..., A]` for states `[..., S]` and ways to the goal `[..., 3]`, metres.

        Raises:
          BadInput: their shapes do not fit the robot, or each other.
        """
        s = self.robot.check_inputs(s, relative_goal)
        x = inputs(s, relative_goal if self.goal_conditioned else None)
        x = normalize(x, running_statistics.NestedMeanStd(self.mean, self.std))
        out = self._network().apply(self.params, x)
        return jnp.tanh(out[..., : self.robot.action.size])

    def _network(self) -> MLP:
        """Its outputs are the mean and, of agents that explore by a Gaussian, the deviation."""
        outputs = self.params["params"][f"hidden_{len(self.policy_hidden_layer_sizes)}"][
            "bias"
        ].shape[-1]
        if outputs not in (self.robot.action.size, 2 * self.robot.action.size):
            raise ValueError(f"its network has {outputs} outputs")
        return MLP((*self.policy_hidden_layer_sizes, outputs), ACTIVATIONS[self.activation])

    def fresh(self, key: jax.Array) -> dict[str, Any]:
        """Parameters and statistics of the shapes that these have, untrained."""
        size = self.robot.observation.size + 3 * self.goal_conditioned
        params = self._network().init(key, jnp.zeros(size, jnp.float32))
        return {
            "params": params,
            "mean": jnp.zeros(size, jnp.float32),
            "std": jnp.ones(size, jnp.float32),
        }

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Writes the policy as a directory, without pickle.

        Raises:
          BadInput: there is something already, and `overwrite` is not set.
        """
        leaves = jax.tree.map(
            np.asarray, {"params": self.params, "mean": self.mean, "std": self.std}
        )
        meta = described(self.robot) | {
            "policy_hidden_layer_sizes": self.policy_hidden_layer_sizes,
            "activation": self.activation,
            "goal_conditioned": self.goal_conditioned,
        }
        files.save_arrays(path, leaves, meta, overwrite)

    @classmethod
    def restore(cls, tree: dict[str, Any], meta: dict[str, Any], robot: Robot) -> Policy:
        """The policy that `save` wrote, from what lies in its directory.

        Raises:
          BadInput: what it says of its network cannot be.
        """
        for name, allowed in (
            ("policy_hidden_layer_sizes", layers), ("activation", one_of(ACTIVATIONS)),
            ("goal_conditioned", one_of((False, True))),
        ):  # fmt: skip
            check_value(name, meta[name], allowed)
        return cls(
            **tree,
            policy_hidden_layer_sizes=tuple(meta["policy_hidden_layer_sizes"]),
            activation=meta["activation"],
            goal_conditioned=meta["goal_conditioned"],
            robot=robot,
        )
