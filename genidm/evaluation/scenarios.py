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
from genidm.symmetry import rotate_vector
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

Range = tuple[float, float]
# The test of the author's code (docs/authors.md): metres ahead and to the left of the start.
BOX_AHEAD: Range = (2.0, 4.0)
BOX_SIDE: Range = (-2.0, 2.0)
BOX_EPISODES = 100


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
    numbers = _numbered(seeds, episodes, first_seed)
    bearings = (-TARGET_BEARING, TARGET_BEARING)
    return toward(robot, *_draw(*numbers, robot.target_distance, bearings))


def box_scenarios(
    robot: Robot, seeds: int = TEST_SEEDS, episodes: int = BOX_EPISODES, first_seed: int = 0
) -> Scenarios:
    """Make the test of the author's code (docs/authors.md): targets in a box ahead of the robot.

    A target is 2–4 m ahead of the start and up to 2 m to its left or right, in the frame of the
    start's yaw; the heading differs from it by the reset noise. The target has the height of the
    start. In the author's test, reaching does not end an episode: `goal_radius` is 0.

    Args:
      robot: the robot.
      seeds: number of test seeds.
      episodes: episodes per seed.
      first_seed: first test seed.

    Raises:
      BadInput: as `scenarios`.
    """
    keys, yaw, forward, left = _draw(*_numbered(seeds, episodes, first_seed), BOX_AHEAD, BOX_SIDE)
    start = jax.jit(robot.reset)(keys.reshape(-1), yaw.reshape(-1)).position
    offset = jnp.stack([forward, left, jnp.zeros_like(left)], axis=-1)
    target = start.reshape(offset.shape) + rotate_vector(offset, yaw)
    return Scenarios(keys, yaw, target.astype(jnp.float32))


def _numbered(seeds: int, episodes: int, first_seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The test seeds and the numbers of their episodes, after a check."""
    check_value("seeds of a test", seeds, count())
    check_value("episodes of a test", episodes, count())
    check_value("seeds × episodes of a test", seeds * episodes, count(1, MOST_EPISODES))
    check_value("first seed of a test", first_seed, seed())
    check_value("last seed of a test", first_seed + seeds - 1, seed())
    numbers = np.arange(first_seed, first_seed + seeds).astype(np.uint32)
    return numbers, np.arange(episodes, dtype=np.uint32)


def _draw(
    seeds: np.ndarray, episodes: np.ndarray, first: Range, second: Range
) -> tuple[jax.Array, ...]:
    """Keys of the starts, yaws in ±π, and numbers in two ranges, `[seeds, episodes]` each."""

    def one(seed: jax.Array, episode: jax.Array) -> tuple[jax.Array, ...]:
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(SCENARIO_KEY), seed), episode)
        start, *keys = jax.random.split(key, 4)
        ranges = ((-jnp.pi, jnp.pi), first, second)
        return start, *(
            jax.random.uniform(key, (), jnp.float32, minval=low, maxval=high)
            for key, (low, high) in zip(keys, ranges, strict=True)
        )

    grid = jax.vmap(jax.vmap(one, (None, 0)), (0, None))
    drawn: tuple[jax.Array, ...] = jax.jit(grid)(seeds, episodes)
    return drawn


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
