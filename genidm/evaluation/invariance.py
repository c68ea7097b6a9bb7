"""Invariance of a controller to rotations R of the world: ‖π(s, d) − π(Rs, Rd)‖ (Def. 3)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from genidm import symmetry
from genidm.evaluation.evaluate import ControllerFn
from genidm.experience import Experience
from genidm.paper.protocol import TARGET_BEARING
from genidm.robots.base import Robot

ANGLES = np.radians(np.arange(0, 181, 15))
"""Rotations `[13]` at which controllers are compared, radians."""

FAR = 3.0  # metres to a goal, if the robot's test has goals at this distance


def invariance(
    robot: Robot,
    controller: ControllerFn,
    s: jax.Array,
    relative_goal: jax.Array,
    angles: np.ndarray,
) -> np.ndarray:
    """Measure how much actions change if robot and goal are rotated alike (0: invariant, Def. 3).

    Args:
      robot: robot whose layout rotates the states.
      controller: π.
      s: states `[N, S]`.
      relative_goal: `[N, 3]`, from the robots to their goals, metres.
      angles: rotations `[K]`, radians.

    Returns:
      Euclidean distances between the actions `[K, N]`.
    """

    @jax.jit
    def change(s: jax.Array, relative_goal: jax.Array, angle: jax.Array) -> jax.Array:
        yaw = jnp.full(s.shape[0], angle)
        rotated = robot.observation.rotate(s, yaw), symmetry.rotate_vector(relative_goal, yaw)
        return jnp.linalg.norm(controller(*rotated) - controller(s, relative_goal), axis=-1)

    return np.stack([np.asarray(change(s, relative_goal, a)) for a in angles])


def probes(
    robot: Robot, record: Experience, count: int = 1000, seed: int = 0
) -> tuple[jax.Array, jax.Array]:
    """Draw states of a record and a goal for each, the same for every controller.

    Goals lie 3 m away, or at the distance nearest to that in the robot's test, within ±45°
    of the heading and at the height of a standing robot (A.1.3).

    Args:
      robot: robot of the record.
      record: `[T, B, ...]`; invalid steps are left out.
      count: maximum number of states.
      seed: seed of the states and bearings.

    Returns:
      states `[N, S]`, and relative goals `[N, 3]`, metres.
    """
    rng = np.random.default_rng(seed)
    valid = np.flatnonzero(record.valid)
    drawn = np.sort(rng.choice(valid, min(count, valid.size), replace=False))
    s, o = (jnp.asarray(x.reshape(-1, x.shape[-1])[drawn]) for x in (record.s, record.o))
    bearing = rng.uniform(-TARGET_BEARING, TARGET_BEARING, drawn.size).astype(np.float32)
    angle = robot.observation.yaw(s) + bearing
    horizontal = np.clip(FAR, *robot.target_distance) * jnp.stack(
        [jnp.cos(angle), jnp.sin(angle)], -1
    )
    return s, jnp.concatenate([horizontal, robot.standing_height - o[:, 2:]], axis=-1)
