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

# Metres by which the reset noise can lower a foot (0.1 of height, 0.1 rad at the ankle).
START_CLEARANCE = 0.15


class Ant(MujocoRobot):
    """gymnasium's Ant (Table 1, A.1.1).

    s `[111]` is qpos without x and y (13 numbers), qvel (14) and the external wrench on each of
    the 14 bodies, the world included, clipped to ±1: the layout of gymnasium's Ant up to version
    4. There are two differences from gymnasium, so that every field transforms exactly:
    quaternions have w ≥ 0, and the horizontal part of a wrench is clipped by its length, not by
    its components along the world's axes.

    Args:
      solver: settings of the constraint solver.
      engine: one of `engines`; default: chosen by hardware.
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
        # In gymnasium's pose the feet just touch the floor. Noise would move some feet into the
        # floor, and in the first step the floor would throw the Ant above its healthy height.
        pose[2] += START_CLEARANCE
        return pose

    def _layout(self) -> Layout:
        quarter = self.quarter_turn.bodies if self.quarter_turn else None
        contact = symmetry.wrenches("contact", self.mirror.bodies, quarter)
        return Layout((*super()._layout().fields, contact))

    def _observe(self, physics: Physics, contact: jax.Array) -> jax.Array:
        wrenches = clip_wrenches(contact).reshape(-1)
        return jnp.concatenate([super()._observe(physics, contact), wrenches])

    def cost(self, state: State, action: jax.Array) -> jax.Array:
        contact = self.observation.part(state.observation, "contact")
        return super().cost(state, action) + self.contact_cost * jnp.sum(contact**2, axis=-1)


def clip_wrenches(wrenches: jax.Array) -> jax.Array:
    """Clips wrenches `[n, 6]` to ±1; clipping commutes with rotation about the vertical.

    gymnasium clips x and y separately. That depends on the world's axes and breaks Def. 3; here
    the horizontal part of each torque and each force is shortened to length 1.
    """
    parts = wrenches.reshape(-1, 2, 3)
    length = symmetry.horizontal_norm(parts)[..., None]
    level = parts[..., :2] / jnp.maximum(length, 1.0)
    upright = jnp.clip(parts[..., 2:], -1.0, 1.0)
    return jnp.concatenate([level, upright], axis=-1).reshape(wrenches.shape)
