"""Scenarios of the paper's test (A.1.3), the same for every method."""

from __future__ import annotations

import hashlib
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from genidm.checks import check_value, count, seed
from genidm.paper.protocol import TARGET_BEARING, TEST_EPISODES, TEST_SEEDS
from genidm.robots.base import Robot
from genidm.tasks import ahead


class Scenarios(flax.struct.PyTreeNode):
    """Starts and targets of test episodes `[seeds, episodes]`.

    Attributes:
      keys: random keys `[seeds, episodes]` of the starts.
      yaw: `[seeds, episodes]`, rotations of the starts, radians.
      target: `[seeds, episodes, 3]`, metres, world frame.
    """

    keys: Any
    yaw: Any
    target: Any

    @property
    def shape(self) -> tuple[int, int]:
        """(seeds, episodes)."""
        return self.yaw.shape

    def digest(self) -> str:
        """sha256 of all numbers: tests with equal digests are equal."""
        h = hashlib.sha256()
        for x in (jax.random.key_data(self.keys), self.yaw, self.target):
            h.update(np.ascontiguousarray(x).tobytes())
        return h.hexdigest()


# Test seed n and training seed n must not give the same random numbers.
SCENARIO_KEY = 0x7E57
# All starts are in memory at once: 1 GB for this many of the Ant, 100 times the paper's test.
MOST_EPISODES = 10**6


def scenarios(
    robot: Robot, seeds: int = TEST_SEEDS, episodes: int = TEST_EPISODES, first_seed: int = 0
) -> Scenarios:
    """Make the paper's test (A.1.3): random heading, target 2–5 m away within ±45° of it.

    The result depends on the robot and the seeds only; more episodes extend the same list.
    The target has the height of a standing robot, so d is three-dimensional.

    Args:
      robot: its test gives the target's distance (Minitaur: 1.5–2.5 m) and height.
      seeds: number of test seeds.
      episodes: episodes per seed.
      first_seed: first test seed.

    Raises:
      BadInput: there is no episode, or there are more than `MOST_EPISODES`, or a seed is not
        of 32 bits.
    """
    check_value("seeds of a test", seeds, count())
    check_value("episodes of a test", episodes, count())
    check_value("seeds × episodes of a test", seeds * episodes, count(1, MOST_EPISODES))
    check_value("first seed of a test", first_seed, seed())
    check_value("last seed of a test", first_seed + seeds - 1, seed())
    numbers = np.arange(first_seed, first_seed + seeds).astype(np.uint32)
    return _scenarios(robot, numbers, np.arange(episodes, dtype=np.uint32))


def _scenarios(robot: Robot, seeds: np.ndarray, episodes: np.ndarray) -> Scenarios:
    def one(seed: jax.Array, episode: jax.Array) -> tuple[jax.Array, ...]:
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(SCENARIO_KEY), seed), episode)
        start, turn, far, side = jax.random.split(key, 4)
        low, high = robot.target_distance
        return (
            start,
            jax.random.uniform(turn, (), jnp.float32, minval=-jnp.pi, maxval=jnp.pi),
            jax.random.uniform(far, (), jnp.float32, minval=low, maxval=high),
            jax.random.uniform(
                side, (), jnp.float32, minval=-TARGET_BEARING, maxval=TARGET_BEARING
            ),
        )

    grid = jax.vmap(jax.vmap(one, (None, 0)), (0, None))
    keys, yaw, distance, bearing = jax.jit(grid)(seeds, episodes)
    return toward(robot, keys, yaw, distance, bearing)


def toward(
    robot: Robot, keys: jax.Array, yaw: jax.Array, distance: jax.Array, bearing: jax.Array
) -> Scenarios:
    """Make scenarios with targets at given distances and bearings.

    Args:
      robot: robot of the scenarios.
      keys: random keys `[seeds, episodes]` of the starts.
      yaw: `[seeds, episodes]`, rotations of the starts, radians.
      distance: `[seeds, episodes]`, metres from the start.
      bearing: `[seeds, episodes]`, radians to the left of the start's heading.
    """
    flat = [x.reshape(-1) for x in (keys, yaw, distance, bearing)]
    target = ahead(robot, jax.jit(robot.reset)(*flat[:2]), *flat[2:])
    return Scenarios(keys, yaw, target.reshape(*yaw.shape, 3).astype(jnp.float32))


# Fig. 8: ten episodes start as in training; in ten others, the robot faces almost the opposite
# direction.
FIG8_EPISODES = 10
UNSEEN_YAW = 0.75 * np.pi


def fig8_scenarios(robot: Robot) -> Scenarios:
    """Make the scenarios of Fig. 8, `[2, 10]`: one fixed start per row, targets far ahead.

    Row 0 starts at yaw 0, as in training; row 1 at 135°. Targets lie in the farther half of
    the test's range (Ant: 3.5–5 m).
    """
    low, high = robot.target_distance
    far = jnp.linspace((low + high) / 2, high, FIG8_EPISODES, dtype=jnp.float32)
    side = jnp.linspace(-TARGET_BEARING, TARGET_BEARING, FIG8_EPISODES, dtype=jnp.float32)
    shape = (2, FIG8_EPISODES)
    return toward(
        robot,
        keys=jnp.broadcast_to(jax.random.key(SCENARIO_KEY), shape),
        yaw=jnp.broadcast_to(jnp.asarray([[0.0], [UNSEEN_YAW]], jnp.float32), shape),
        distance=jnp.broadcast_to(far, shape),
        bearing=jnp.broadcast_to(side, shape),
    )
