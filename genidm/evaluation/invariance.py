"""Whether a controller has forgotten the heading: ‖π(s, d) − π(Rs, Rd)‖ (Def. 3)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from genidm import symmetry
from genidm.evaluation.evaluate import ControllerFn
from genidm.experience import Experience
from genidm.robots.base import Robot

ANGLES = np.radians(np.arange(0, 181, 15))
"""Turns `[13]` that controllers are compared at, radians."""

FAR = 3.0  # metres to a goal, where the robot's test has goals there


def invariance(
    robot: Robot,
    controller: ControllerFn,
    s: jax.Array,
    relative_goal: jax.Array,
    angles: np.ndarray,
) -> np.ndarray:
    """How much actions change when robot and goal are turned alike; 0 for exact invariance.

    Args:
      robot: whose layout turns the states.
      controller: π.
      s: states `[N, S]`.
      relative_goal: from the robots to their goals `[N, 3]`, metres.
      angles: `[K]`, radians.

    Returns:
      Euclidean distances of the actions `[K, N]`.
    """

    @jax.jit
    def change(s: jax.Array, relative_goal: jax.Array, angle: jax.Array) -> jax.Array:
        yaw = jnp.full(s.shape[0], angle)
        turned = robot.observation.rotate(s, yaw), symmetry.rotate_vector(relative_goal, yaw)
        return jnp.linalg.norm(controller(*turned) - controller(s, relative_goal), axis=-1)

    return np.stack([np.asarray(change(s, relative_goal, a)) for a in angles])


def probes(
    robot: Robot, record: Experience, count: int = 1000, seed: int = 0
) -> tuple[jax.Array, jax.Array]:
    """States of a record and a goal in each, to ask every controller the same.

    Goals lie 3 m away, or as near to that as the robot's test has them, within ±45° of the
    heading and at the height of a standing robot (A.1.3).

    Args:
      robot: whose record it is.
      record: `[T, B, ...]`; steps in which the physics diverged are left out.
      count: most states to draw.
      seed: of which states and bearings are drawn.

    Returns:
      states `[N, S]`, and from the robots to their goals `[N, 3]`, metres.
    """
    rng = np.random.default_rng(seed)
    there = np.flatnonzero(record.valid)
    drawn = np.sort(rng.choice(there, min(count, there.size), replace=False))
    s, o = (jnp.asarray(x.reshape(-1, x.shape[-1])[drawn]) for x in (record.s, record.o))
    bearing = rng.uniform(-np.pi / 4, np.pi / 4, drawn.size).astype(np.float32)
    angle = robot.observation.yaw(s) + bearing
    level = np.clip(FAR, *robot.target_distance) * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    return s, jnp.concatenate([level, robot.standing_height - o[:, 2:]], axis=-1)
