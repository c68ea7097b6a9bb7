"""The policy of an offline learner as a controller: (s, g − o) → a."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from genidm import files
from genidm.agents.policy import described
from genidm.checks import WIDEST, check_value, count, layers, optional, positive
from genidm.config import to_json
from genidm.offline.data import normalize
from genidm.offline.networks import Architecture
from genidm.robots.base import Robot
from genidm.tasks import inputs


class GoalPolicy(flax.struct.PyTreeNode):
    """The mean action of an offline learner's policy.

    Attributes:
      params: parameters of the actors (`Architecture.init`).
      mean: `[S + 3]`, mean of the training inputs.
      std: `[S + 3]`, standard deviation of the training inputs.
      longest_goal: metres; a goal farther away is moved to this distance, the largest one
        between two positions of an episode in the training data.
      architecture: shape of the actors.
      robot: the robot that the policy controls.
    """

    params: Any
    mean: jax.Array
    std: jax.Array
    longest_goal: jax.Array
    architecture: Architecture = flax.struct.field(pytree_node=False)
    robot: Robot = flax.struct.field(pytree_node=False)

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """Compute actions `[..., A]` in [−1, 1] from the current state and goal.

        Args:
          s: states `[..., S]`.
          relative_goal: `[..., 3]`, from the robot to its goal, metres.

        Raises:
          BadInput: the shapes do not fit the robot or each other, or a number is not finite.
        """
        s = self.robot.check_inputs(s, relative_goal)
        distance = jnp.linalg.norm(relative_goal, axis=-1, keepdims=True)
        near = relative_goal * jnp.minimum(1.0, self.longest_goal / jnp.maximum(distance, 1e-6))
        x = normalize(inputs(s, near), self.mean, self.std)
        return jnp.clip(self.architecture.action(self.params, x), -1.0, 1.0)

    def fresh(self, key: jax.Array) -> dict[str, Any]:
        """Make untrained parameters and statistics, with the same shapes as the trained ones."""
        size = self.robot.observation.size
        return {
            "params": self.architecture.init(key, size),
            "mean": jnp.zeros(size + 3, jnp.float32),
            "std": jnp.ones(size + 3, jnp.float32),
        }

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Write the policy as a directory, without pickle.

        Raises:
          BadInput: the path exists, and `overwrite` is False.
        """
        leaves = jax.tree.map(
            np.asarray, {"params": self.params, "mean": self.mean, "std": self.std}
        )
        meta = {"longest_goal": float(self.longest_goal)} | to_json(self.architecture)
        files.save_arrays(path, leaves, described(self.robot) | meta, overwrite)

    @classmethod
    def restore(cls, tree: dict[str, Any], meta: dict[str, Any], robot: Robot) -> GoalPolicy:
        """Make a policy from the arrays and metadata that `save` wrote.

        Raises:
          BadInput: the metadata of the networks is invalid.
        """
        for name, allowed in (
            ("action_size", count(robot.action.size, robot.action.size)),
            ("policy_hidden_layer_sizes", layers), ("longest_goal", positive()),
            ("representation_size", optional(count(1, WIDEST))),
        ):  # fmt: skip
            check_value(name, meta[name], allowed)
        architecture = Architecture(
            meta["action_size"], tuple(meta["policy_hidden_layer_sizes"]),
            meta["representation_size"],
        )  # fmt: skip
        longest = jnp.float32(meta["longest_goal"])
        return cls(**tree, longest_goal=longest, architecture=architecture, robot=robot)
