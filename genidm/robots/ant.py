"""The Ant: four legs, eight torques, a 111-D state (Table 1, A.1.1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from genidm import symmetry
from genidm.engines.base import Physics
from genidm.paper import protocol
from genidm.robots.base import State
from genidm.robots.mujoco import ASSETS, MujocoRobot
from genidm.symmetry import Layout

# Metres; what the reset noise can lower a foot by (0.1 of height, 0.1 rad at the ankle).
START_CLEARANCE = 0.15


class Ant(MujocoRobot):
    """gymnasium's Ant.

    s `[111]` is 13 of the 15 numbers of qpos (without x and y), the 14 of qvel, and the
    external wrench on each of the 14 bodies, the world counted, clipped to ±1: the layout
    of gymnasium's Ant up to version 4. Two numbers differ from gymnasium's, so that every
    field transforms exactly: quaternions have w ≥ 0, and a wrench's horizontal part is
    clipped by its length, not by its components along the world's axes.

    Args:
      solver: of the contacts.
      engine: one of `engines`; chosen by what jax runs on, unless given.
    """

    name = "ant"
    model = ASSETS / "ant.xml"
    frame_skip = 5
    dt = 0.05
    standing_height = 0.55
    target_distance = protocol.TARGET_DISTANCE["ant"]
    healthy_height = (0.2, 1.0)
    paper_interactions = protocol.INTERACTIONS["ant"]
    # gymnasium's weights of the walking reward.
    healthy_reward = 1.0
    control_cost = 0.5
    contact_cost = 5e-4

    def rest_pose(self) -> np.ndarray:
        pose = self.mj_model.numeric("init_qpos").data.astype(np.float32)
        # There the feet just touch the floor: noise would put some of them inside it, and the
        # floor would throw the Ant above its healthy height before its first step is done.
        pose[2] += START_CLEARANCE
        return pose

    def _layout(self) -> Layout:
        contact = symmetry.wrenches("contact", self.mirror.bodies)
        return Layout((*super()._layout().fields, contact))

    def _observe(self, physics: Physics, contact: jax.Array) -> jax.Array:
        wrenches = clip_wrenches(contact).reshape(-1)
        return jnp.concatenate([super()._observe(physics, contact), wrenches])

    def cost(self, state: State, action: jax.Array) -> jax.Array:
        contact = self.observation.part(state.observation, "contact")
        return super().cost(state, action) + self.contact_cost * jnp.sum(contact**2, axis=-1)


def clip_wrenches(wrenches: jax.Array) -> jax.Array:
    """Wrenches `[n, 6]` with every number in ±1, in a way that commutes with a turn.

    Clipping x and y each, as gymnasium does, follows the world's axes and would break
    Def. 3; here the horizontal part of torque and of force is shortened to length 1.
    """
    parts = wrenches.reshape(-1, 2, 3)
    length = symmetry.horizontal_norm(parts)[..., None]
    level = parts[..., :2] / jnp.maximum(length, 1.0)
    upright = jnp.clip(parts[..., 2:], -1.0, 1.0)
    return jnp.concatenate([level, upright], axis=-1).reshape(wrenches.shape)
