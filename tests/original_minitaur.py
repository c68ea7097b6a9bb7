"""pybullet_envs' own Minitaur, whose numbers ours are held against.

It needs the old gym, so its numbers are recorded, in original_minitaur.csv:

    python3.11 -m venv gym && gym/bin/pip install gym==0.25.2 "numpy<2" pybullet==3.2.7
    gym/bin/python tests/original_minitaur.py

A row is what `numbers` gives, at the settled start and after some of `actions`. One thing is
changed: overlapping pairs are put in order, as ours are. In Bullet's own order, which is
that of the robot's past, its numbers differ from these by up to 0.003 at the settled start.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

RECORD = Path(__file__).with_suffix(".csv")
AFTER = (0, 1, 5, 10, 20, 40)


def actions() -> np.ndarray:
    """`[40, 8]`."""
    return np.round(np.random.default_rng(0).uniform(-1, 1, (max(AFTER), 8)), 3)


def numbers(env: Any, s: Any, reward: float) -> np.ndarray:
    """Its s (28), base position, velocity, spin (3 each), counters of heat (8), reward."""
    body = env.minitaur.quadruped
    position, _ = env._pybullet_client.getBasePositionAndOrientation(body)
    velocity, spin = env._pybullet_client.getBaseVelocity(body)
    return np.concatenate([s, position, velocity, spin, env.minitaur._overheat_counter, [reward]])


def original() -> np.ndarray:
    """`[6, 46]`."""
    from pybullet_envs.bullet.minitaur_gym_env import MinitaurBulletEnv

    env = MinitaurBulletEnv(env_randomizer=None)
    client = env._pybullet_client
    as_it_is = client.setPhysicsEngineParameter
    client.setPhysicsEngineParameter = lambda **given: as_it_is(
        **given, deterministicOverlappingPairs=1
    )
    rows = [numbers(env, env.reset(), 0.0)]
    for action in actions():
        s, reward, _, _ = env.step(action)
        rows.append(numbers(env, s, reward))
    return np.array(rows)[list(AFTER)]


if __name__ == "__main__":
    np.savetxt(RECORD, original(), delimiter=",", fmt="%.17g")
