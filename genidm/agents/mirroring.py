"""Networks that are their own mirror image, for robots whose bodies are.

A network f becomes ½ (f(x) + M f(M x)), where M is the reflection y → −y. So the policy acts in the
mirror image of a state as the mirror image of its action, whatever its parameters are, and every
step teaches it both. Learning from mirrored copies of the steps instead (as in rsl_rl) makes the
policy nearly symmetric, and slowly: an image of a step is unlikely under a policy that is not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.training.networks import FeedForwardNetwork

from genidm.robots.base import Robot
from genidm.tasks import mirror_inputs


def mirrored(
    robot: Robot, network: FeedForwardNetwork, mirror: Callable[[jax.Array], jax.Array]
) -> FeedForwardNetwork:
    """Make a network of a policy's inputs its own mirror image.

    Args:
      robot: the robot.
      network: its `apply` maps (statistics, parameters, inputs `[..., I]`) to an output.
      mirror: output → the output in the mirror image.
    """

    def apply(statistics: Any, params: Any, x: jax.Array) -> jax.Array:
        image = network.apply(statistics, params, mirror_inputs(robot, x))
        return 0.5 * (network.apply(statistics, params, x) + mirror(image))

    return FeedForwardNetwork(network.init, apply)


def mirror_policy_output(robot: Robot, output: jax.Array) -> jax.Array:
    """Mirror a policy network's output: means `[..., A]`, or means and scales `[..., 2 A]`."""
    mean, scale = jnp.split(output, [robot.action.size], axis=-1)
    mean = robot.action.mirror(mean)
    if not scale.shape[-1]:
        return mean
    # A standard deviation moves to the mirrored joint, but keeps its sign.
    signs = robot.action.mirror(jnp.ones(robot.action.size))
    return jnp.concatenate([mean, robot.action.mirror(scale) * signs], axis=-1)
