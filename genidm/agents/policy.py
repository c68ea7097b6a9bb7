"""A learned policy as a controller: (s, g − o) → a, without exploration."""

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
from genidm.symmetry import quarters_to
from genidm.tasks import inputs, mirror_inputs

Activation = Literal["tanh", "relu"]
ACTIVATIONS: dict[Activation, Callable[[jax.Array], jax.Array]] = {
    "tanh": linen.tanh,
    "relu": linen.relu,
}

# All agents use this function, so that a saved policy normalises as in training.
normalize = functools.partial(running_statistics.normalize, max_abs_value=10.0)


def no_statistics(size: int) -> RunningStatisticsState:
    """Initial statistics of `size` inputs; strongly typed, so that a resume does not recompile."""
    state = running_statistics.init_state(jnp.zeros(size, jnp.float32))
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), state)


def described(robot: Robot) -> dict[str, Any]:
    """The robot's name, observation and action fields, as a controller's directory stores them."""
    return {
        "robot": robot.name,
        "observation": robot.observation.listed(),
        "action": robot.action.listed(),
    }


def bearing(relative_goal: jax.Array) -> jax.Array:
    """Direction `[...]` of relative goals `[..., 3]` in the world, radians from +x."""
    return jnp.arctan2(relative_goal[..., 1], relative_goal[..., 0])


class Policy(flax.struct.PyTreeNode):
    """The mean action of a trained policy network, squashed by tanh.

    Attributes:
      params: parameters of Brax's policy network; its first A outputs are the mean.
      mean: `[I]`, mean of the training inputs.
      std: `[I]`, standard deviation of the training inputs.
      policy_hidden_layer_sizes: widths of the hidden layers.
      activation: activation of the hidden layers.
      goal_conditioned: whether the input is (s, g − o); if not, it is s.
      robot: the robot that the policy controls.
      faces_goal: whether s is first rotated so that +x points at the goal. So a policy that walks
        towards +x walks to the goal, without any fit.
      nearest_side: whether the side of the body that is nearest to +x counts as its front
        (`genidm.tasks.WalkForward`).
      mirror: whether the policy is its own mirror image (`mirroring`).
    """

    params: Any
    mean: jax.Array
    std: jax.Array
    policy_hidden_layer_sizes: tuple[int, ...] = flax.struct.field(pytree_node=False)
    activation: Activation = flax.struct.field(pytree_node=False)
    goal_conditioned: bool = flax.struct.field(pytree_node=False)
    robot: Robot = flax.struct.field(pytree_node=False)
    faces_goal: bool = flax.struct.field(pytree_node=False, default=False)
    nearest_side: bool = flax.struct.field(pytree_node=False, default=False)
    mirror: bool = flax.struct.field(pytree_node=False, default=False)

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """Actions `[..., A]` for states `[..., S]` and relative goals `[..., 3]`, metres.

        Raises:
          BadInput: the shapes do not fit the robot or each other, or a number is not finite.
        """
        s = self.robot.check_inputs(s, relative_goal)
        if self.faces_goal:
            s = self.robot.observation.rotate(s, -bearing(relative_goal))
        if not self.nearest_side:
            return self._action(s, relative_goal)
        heading = self.robot.observation.yaw(s)
        quarters = quarters_to(jnp.zeros_like(heading), heading)
        action = self._action(self.robot.observation.turn_body_by(s, quarters), relative_goal)
        return self.robot.action.turn_body_by(action, -quarters)

    def _action(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """The output `[..., A]` of the network, squashed."""
        x = inputs(s, relative_goal if self.goal_conditioned else None)
        mean = self._mean(x)
        if self.mirror:
            image = self._mean(mirror_inputs(self.robot, x))
            mean = 0.5 * (mean + self.robot.action.mirror(image))
        return jnp.tanh(mean)

    def _mean(self, x: jax.Array) -> jax.Array:
        x = normalize(x, running_statistics.NestedMeanStd(self.mean, self.std))
        out: jax.Array = self._network().apply(self.params, x)
        return out[..., : self.robot.action.size]

    def _network(self) -> MLP:
        """The policy network: it outputs the mean and, for PPO and SAC, the standard deviation."""
        outputs = self.params["params"][f"hidden_{len(self.policy_hidden_layer_sizes)}"][
            "bias"
        ].shape[-1]
        if outputs not in (self.robot.action.size, 2 * self.robot.action.size):
            raise ValueError(f"the policy network has {outputs} outputs")
        return MLP((*self.policy_hidden_layer_sizes, outputs), ACTIVATIONS[self.activation])

    def fresh(self, key: jax.Array) -> dict[str, Any]:
        """Untrained parameters and statistics of the same shapes."""
        size = self.robot.observation.size + 3 * self.goal_conditioned
        params = self._network().init(key, jnp.zeros(size, jnp.float32))
        return {
            "params": params,
            "mean": jnp.zeros(size, jnp.float32),
            "std": jnp.ones(size, jnp.float32),
        }

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Write the policy as a directory, without pickle.

        Raises:
          BadInput: the path exists, and `overwrite` is False.
        """
        leaves = jax.tree.map(
            np.asarray, {"params": self.params, "mean": self.mean, "std": self.std}
        )
        meta = described(self.robot) | {
            "policy_hidden_layer_sizes": self.policy_hidden_layer_sizes,
            "activation": self.activation,
            "goal_conditioned": self.goal_conditioned,
            "faces_goal": self.faces_goal,
            "nearest_side": self.nearest_side,
            "mirror": self.mirror,
        }
        files.save_arrays(path, leaves, meta, overwrite)

    @classmethod
    def restore(cls, tree: dict[str, Any], meta: dict[str, Any], robot: Robot) -> Policy:
        """Rebuild the policy from the arrays and the metadata that `save` wrote.

        Raises:
          BadInput: the metadata of the network is not valid.
        """
        # Older files do not have these.
        meta = dict.fromkeys(("faces_goal", "nearest_side", "mirror"), False) | meta
        either = one_of((False, True))
        for name, allowed in (
            ("policy_hidden_layer_sizes", layers), ("activation", one_of(ACTIVATIONS)),
            ("goal_conditioned", either), ("faces_goal", either), ("nearest_side", either),
            ("mirror", either),
        ):  # fmt: skip
            check_value(name, meta[name], allowed)
        return cls(
            **tree,
            policy_hidden_layer_sizes=tuple(meta["policy_hidden_layer_sizes"]),
            activation=meta["activation"],
            goal_conditioned=meta["goal_conditioned"],
            robot=robot,
            faces_goal=meta["faces_goal"],
            nearest_side=meta["nearest_side"],
            mirror=meta["mirror"],
        )
