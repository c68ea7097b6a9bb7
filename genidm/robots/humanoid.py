"""The Humanoid: PyBullet's model in MuJoCo; 17 torques, a 43-D state (Table 1, A.1.1)."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from genidm import symmetry
from genidm.engines.base import Physics
from genidm.paper import protocol
from genidm.robots.base import State
from genidm.robots.mujoco import ASSETS, MujocoRobot, Solver
from genidm.symmetry import Layout

Frame = Literal["heading", "world"]

# PyBullet's motors in its order: name, and "power" in N·m (pybullet_envs, robot_locomotors.py).
POWER = {
    "abdomen_z": 100, "abdomen_y": 100, "abdomen_x": 100,
    "right_hip_x": 100, "right_hip_z": 100, "right_hip_y": 300, "right_knee": 200,
    "left_hip_x": 100, "left_hip_z": 100, "left_hip_y": 300, "left_knee": 200,
    "right_shoulder1": 75, "right_shoulder2": 75, "right_elbow": 75,
    "left_shoulder1": 75, "left_shoulder2": 75, "left_elbow": 75,
}  # fmt: skip
# The share of its power that a motor may use (pybullet_envs, robot_locomotors.py).
STRENGTH = 0.41
# Values for both sides, where Brax's file differs between the sides or from PyBullet's: degrees,
# N·m/rad, kg·m².
HIP_RANGE = (-120.0, 20.0)
KNEE_STIFFNESS = 1.0
HIP_ARMATURE = 0.01
# Metres, in the torso's frame: PyBullet's base is at the centre of the torso's lowest geom.
BASE = np.array([-0.01, 0.0, -0.12])
# Newtons: the least force at which a foot counts as on the floor.
TOUCH = 1.0


class Humanoid(MujocoRobot):
    """PyBullet's humanoid in MuJoCo (Table 1, A.1.1).

    s `[43]` is PyBullet's state, with the yaw in place of the direction to the target: height −
    0.8 m, 0.3 × velocity, roll, pitch, yaw; for each joint its angle relative to its limits (−1
    to 1) and 0.1 × its velocity; and whether each foot touches the floor.

    Args:
      solver: settings of the constraint solver.
      engine: one of `engines`; default: chosen by hardware.

    Attributes:
      velocity: frame of the velocity in s. PyBullet's is the heading frame, which is already
        invariant to the yaw; in `HumanoidWorld` the LFM has to learn this invariance.
    """

    name = "humanoid"
    velocity: ClassVar[Frame] = "heading"
    model = ASSETS / "humanoid.xml"
    frame_skip = 4
    dt = 0.0165
    standing_height = 1.17
    target_distance = protocol.TARGET_DISTANCE["humanoid"]
    healthy_height = (0.78, math.inf)
    paper_interactions = protocol.INTERACTIONS["humanoid"]
    # PyBullet's weights of the walking reward.
    healthy_reward = 2.0
    electricity_cost = 2.0
    torque_cost = 0.1
    limit_cost = 0.1

    def __init__(self, solver: Solver | None = None, engine: str | None = None):
        super().__init__(solver, engine)
        limits = self.mj_model.jnt_range[1:]
        self._middle, self._half_range = limits.mean(1), (limits[:, 1] - limits[:, 0]) / 2
        self._feet = np.array([self.mj_model.body(f"{side}_foot").id for side in ("right", "left")])

    def _specify(self, solver: Solver) -> mujoco.MjSpec:
        return edited(super()._specify(solver))

    def _layout(self) -> Layout:
        m = self.mirror
        motion = symmetry.heading_vector if self.velocity == "heading" else symmetry.vector
        angle_and_rate = [2 * hinge + i for hinge in m.hinges for i in (0, 1)]
        return Layout(
            (
                symmetry.invariant("height", unit="m above 0.8"),
                motion("velocity", "m/s × 0.3"),
                symmetry.euler("roll, pitch, yaw"),
                symmetry.joints(
                    "joint angles, velocities", angle_and_rate, np.repeat(m.signs, 2).tolist(),
                    "of the range, rad/s × 0.1",
                ),
                symmetry.joints("feet on the floor", [1, 0], [1, 1], "yes or no"),
            )
        )  # fmt: skip

    def rest_pose(self) -> np.ndarray:
        pose = self.mj_model.qpos0.astype(np.float32)
        pose[:3] = 0.0, 0.0, 1.4  # PyBullet's initial height: the robot drops onto its feet
        return pose

    def _draw(self, key: jax.Array) -> Physics:
        """PyBullet's initial state: upright and at rest, with uniform noise in the joints."""
        noise, count = self.reset_noise, len(self.mirror.hinges)
        angles = jax.random.uniform(key, (count,), jnp.float32, -noise, noise)
        qpos = jnp.asarray(self._rest).at[7:].add(angles)
        still = jnp.zeros(count + 6, jnp.float32)
        return Physics(qpos, still, still)

    def _observe(self, physics: Physics, contact: jax.Array) -> jax.Array:
        angles = symmetry.euler_of(physics.qpos[3:7])
        velocity = physics.qvel[:3]
        if self.velocity == "heading":
            velocity = symmetry.rotate_vector(velocity, -angles[2])
        place = (physics.qpos[7:] - self._middle) / self._half_range
        joints = jnp.stack([place, 0.1 * physics.qvel[6:]], axis=-1).reshape(-1)
        touching = jnp.linalg.norm(contact[self._feet, 3:], axis=-1) > TOUCH
        height = physics.qpos[2:3] - 0.8
        s = jnp.concatenate([height, 0.3 * velocity, angles, joints, 1.0 * touching])
        return jnp.clip(s, -5.0, 5.0)

    def cost(self, state: State, action: jax.Array) -> jax.Array:
        """PyBullet's costs `[B]` of power, torque, and joints at their limits."""
        joints = self.observation.part(state.observation, "joint angles, velocities")
        place, rate = joints[..., 0::2], joints[..., 1::2]
        power = self.electricity_cost * jnp.mean(jnp.abs(action * rate), axis=-1)
        torque = self.torque_cost * jnp.mean(action**2, axis=-1)
        return power + torque + self.limit_cost * jnp.sum(jnp.abs(place) > 0.99, axis=-1)


class HumanoidWorld(Humanoid):
    """The Humanoid with its velocity in the world's frame, which makes the problem harder."""

    name = "humanoid_world"
    velocity = "world"


def edited(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Edits Brax's humanoid: PyBullet's motors, limits, time step and base; symmetric sides."""
    spec.option.timestep = Humanoid.dt / Humanoid.frame_skip
    for side in ("right", "left"):
        spec.joint(f"{side}_hip_y").range = HIP_RANGE
        spec.joint(f"{side}_hip_y").armature = HIP_ARMATURE
        spec.joint(f"{side}_knee").stiffness[0] = KNEE_STIFFNESS  # of a polynomial
    for motor in list(spec.actuators):
        spec.delete(motor)
    for name, power in POWER.items():
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gear[0] = STRENGTH * power
        motor.ctrllimited, motor.ctrlrange = True, (-1.0, 1.0)
    torso = spec.body("torso")
    torso.pos = torso.pos + BASE
    spans = [geom for geom in torso.geoms if np.isfinite(geom.fromto).all()]
    for geom in spans:
        geom.fromto = geom.fromto - np.tile(BASE, 2)
    for part in (*torso.bodies, *torso.cameras, *(g for g in torso.geoms if g not in spans)):
        part.pos = part.pos - BASE
    return spec
