"""The Minitaur: eight motors on four legs, in PyBullet; a 17-D state (Table 1, A.1.1)."""

from __future__ import annotations

import atexit
import dataclasses
import functools
import importlib.util
import json
import sys
from pathlib import Path
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from genidm import engines, symmetry
from genidm.engines.bullet import Bullet
from genidm.errors import BadInput
from genidm.paper import protocol
from genidm.robots import minitaur_world as world
from genidm.robots.base import Robot, State, select
from genidm.robots.minitaur_world import ROW, Solver
from genidm.symmetry import Layout

Observed = Literal["paper17", "native28"]

# On the left of the body, L is the outer motor of a leg; on the right, L is the inner motor. So
# the mirror image of front left L is front right R.
ACROSS = [5, 4, 7, 6, 1, 0, 3, 2]
LEG_ACROSS = [2, 3, 0, 1]
# Seconds that a worker may take for one request, about a thousand times the usual time.
PATIENCE = 30.0

ABSENT = (
    'the Minitaur needs PyBullet, which is not installed: run `pip install "genidm[minitaur]"`'
    " (pybullet 3.2.7 has a wheel only for CPython 3.11 on Linux x86-64; elsewhere pip builds it)"
)


class Physics(flax.struct.PyTreeNode):
    """Everything that a step in PyBullet depends on, in the order of `minitaur_world.ROW`.

    Attributes:
      pose: `[B, 23]`; base position (m) and quaternion, then joint angles (rad).
      motion: `[B, 22]`; base velocity (m/s) and spin (rad/s), then joint velocities (rad/s).
      motors: `[B, 16]`; for each motor the number of successive physics steps above the torque
        `minitaur_world.HOT`, then the observed torques (N·m).
    """

    pose: Any
    motion: Any
    motors: Any


def joints(name: str, unit: str) -> symmetry.Field:
    """A field with one number for each of the eight motors, or each of their knees."""
    return symmetry.joints(name, ACROSS, [1] * 8, unit)


POSE = Layout(
    (
        symmetry.vector("position"), symmetry.quaternion("orientation"),
        joints("motor angles", "rad"), joints("knee angles", "rad"),
    )
)  # fmt: skip
MOTION = Layout(
    (
        symmetry.vector("velocity", "m/s"), symmetry.pseudovector("spin"),
        joints("motor velocities", "rad/s"), joints("knee velocities", "rad/s"),
    )
)  # fmt: skip
MOTORS = Layout((joints("hot for", "physics steps"), joints("torque", "N·m")))

OBSERVATIONS = {
    "paper17": Layout(
        (
            joints("motor angles", "rad"), symmetry.vector("velocity", "m/s"),
            symmetry.pseudovector("spin"), symmetry.euler("roll, pitch, yaw"),
        )
    ),
    "native28": Layout(
        (
            joints("motor angles", "rad"), joints("motor velocities", "rad/s"),
            joints("torque", "N·m"), symmetry.quaternion("orientation"),
        )
    ),
}  # fmt: skip


class Minitaur(Robot):
    """The Minitaur of pybullet_envs, stepped by local worker processes (Table 1, A.1.1).

    The leg model of pybullet_envs maps the action `[8]` to motor angles: first the swing of each
    leg (±45° at ±1), then its retraction (45° of both motors at 1), for the legs front left, back
    left, front right, back right. A DC motor model computes the torques from these angles.

    A step is a function of `State.physics` alone. For every step a free process sets the robot's
    state and makes five physics steps. So states can be set, replayed and resumed at no cost, and
    a process that dies loses nothing. But the contacts that Bullet keeps from step to step are
    lost (docs/physics.md).

    The model is not exactly its own mirror image: the shins of a leg are joined with an offset of
    5 mm, towards the same side in all legs, and one of the eight motors, front left R, has almost
    no inertia. docs/physics.md measures the effect on a mirrored replay.

    Args:
      solver: settings of Bullet.
      engine: "bullet", the only engine.
      observed: content of s. "paper17": motor angles (8), the base's velocity (3) and spin (3) in
        the world frame, roll, pitch and yaw. "native28", as in pybullet_envs: motor angles,
        velocities and observed torques (8 each), and a quaternion, here (w, x, y, z) with w ≥ 0.
      processes: number of worker processes; default: one for each core.

    Raises:
      BadInput: PyBullet is not installed, or `observed` is unknown.
    """

    name = "minitaur"
    dt = world.SUBSTEP * world.SUBSTEPS
    standing_height = 0.2
    target_distance = protocol.TARGET_DISTANCE["minitaur"]
    paper_interactions = protocol.INTERACTIONS["minitaur"]
    # pybullet_envs has none. But with a horizon of one second (discount 0.99), a jump forward at
    # 1 m/s that ends in a fall would then return more than any gait.
    healthy_reward = 0.5
    # Standard deviation of the base's initial velocity, m/s and rad/s. pybullet_envs has none: all
    # its initial states are equal.
    reset_noise = 0.1

    physics = Physics(POSE, MOTION, MOTORS)
    action = Layout(
        (
            symmetry.joints("swing", LEG_ACROSS, [1] * 4, "of 45°"),
            symmetry.joints("drawn in", LEG_ACROSS, [1] * 4, "of 45° of both motors"),
        )
    )

    engines = ("bullet",)
    engine: Bullet

    def __init__(
        self,
        solver: Solver | None = None,
        engine: str | None = None,
        observed: Observed = "paper17",
        processes: int | None = None,
    ):
        if importlib.util.find_spec("pybullet") is None:
            raise BadInput(ABSENT)
        if observed not in OBSERVATIONS:
            raise BadInput(f"observed must be {' or '.join(OBSERVATIONS)}, not {observed!r}")
        solver = solver or Solver()
        chosen = engines.choose(engine, self.engines, self.name)
        self.settings = {
            "name": self.name, "engine": chosen, "solver": solver, "observed": observed,
        }  # fmt: skip
        self.observation = OBSERVATIONS[observed]
        self.engine = bullet(solver, processes)

    @functools.cached_property
    def _rest(self) -> Physics:
        """Physics `[...]` of one robot, settled on the floor, at yaw 0."""
        return from_rows(jnp.asarray(self.engine.pool.greeting()))

    def visual_model(self) -> mujoco.MjSpec:
        """PyBullet's own model, read by MuJoCo: its boxes and cylinders."""
        import pybullet_data

        spec = mujoco.MjSpec.from_file(str(Path(pybullet_data.getDataPath()) / world.URDF))
        spec.compiler.fusestatic = False  # else MuJoCo fuses the base with the world
        spec.bodies[1].add_freejoint()
        return spec

    def visual_qpos(self, physics: Physics) -> np.ndarray:
        pose = np.asarray(physics.pose)
        angles = pose[..., 7:] * np.tile(world.DIRECTION, 2)
        return np.concatenate([pose[..., :7], angles[..., self._visual_joints]], axis=-1)

    @functools.cached_property
    def _visual_joints(self) -> list[int]:
        """For each hinge of the visual model, its index among our joints."""
        model, names = self.visual_model().compile(), world.MOTORS + world.KNEES
        return [names.index(model.joint(i).name) for i in range(1, model.njnt)]

    def reset(self, keys: jax.Array, yaw: jax.Array) -> State:
        """The settled initial state of pybullet_envs, with noise in the base's velocity."""
        with jax.ensure_compile_time_eval():
            rest = self._rest
        push = jax.vmap(lambda key: jax.random.normal(key, (6,), jnp.float32))(keys)
        still = jnp.broadcast_to(rest.motion, (*keys.shape, MOTION.size))
        moving = still.at[:, :6].add(self.reset_noise * push)
        alike = jax.tree.map(lambda x: jnp.broadcast_to(x, (*keys.shape, *x.shape)), rest)
        return self.set_state(alike.replace(motion=moving), yaw)

    def set_state(self, physics: Physics, yaw: jax.Array) -> State:
        state = self._state(self.rotate_physics(physics, yaw))
        # An initial state is never a fall.
        return state.replace(fallen=jnp.zeros_like(state.fallen))

    def step(self, state: State, action: jax.Array) -> State:
        before = state.physics
        rows = jnp.concatenate([before.pose, before.motion, before.motors], axis=-1)
        after = self.engine.step(rows, action).physics
        finite = jnp.isfinite(after).all(-1)
        then = self._state(from_rows(after))
        return select(finite, then, state.replace(diverged=jnp.ones_like(finite)))

    def _state(self, physics: Physics) -> State:
        orientation = POSE.part(physics.pose, "orientation")
        fallen = world.has_fallen(orientation, physics.pose[:, 2])
        return State(
            physics=physics,
            observation=self._observe(physics),
            position=physics.pose[:, :3],
            heading=symmetry.yaw_of(orientation),
            fallen=fallen,
            diverged=jnp.zeros_like(fallen),
        )

    def _observe(self, physics: Physics) -> jax.Array:
        known: dict[str, jax.Array] = {}
        for layout, x in ((POSE, physics.pose), (MOTION, physics.motion), (MOTORS, physics.motors)):
            known |= {f.name: layout.part(x, f.name) for f in layout.fields}
        known["roll, pitch, yaw"] = symmetry.euler_of(known["orientation"])
        return jnp.concatenate([known[f.name] for f in self.observation.fields], axis=-1)

    def cost(self, state: State, action: jax.Array) -> jax.Array:
        """The energy cost `[B]` of pybullet_envs, per second."""
        torque = MOTORS.part(state.physics.motors, "torque")
        rate = MOTION.part(state.physics.motion, "motor velocities")
        return world.charge(torque, rate) / self.dt


def from_rows(rows: jax.Array) -> Physics:
    """Splits rows `[..., 61]` into Physics; quaternions get w ≥ 0."""
    pose, motion, motors = jnp.split(rows, [POSE.size, POSE.size + MOTION.size], axis=-1)
    upright = symmetry.canonical_quaternion(pose[..., 3:7])
    return Physics(pose.at[..., 3:7].set(upright), motion, motors)


@functools.cache
def bullet(solver: Solver, processes: int | None) -> Bullet:
    """The engine for these settings; all robots with the same settings share its processes."""
    settings = json.dumps(dataclasses.asdict(solver))
    # -P: without it the worker would import from genidm/robots first.
    command = [sys.executable, "-P", world.__file__, settings, str(PATIENCE)]
    made = Bullet(command, world.WIDTH, processes, PATIENCE)
    atexit.register(made.pool.close)
    return made


assert sum(ROW.values()) == POSE.size + MOTION.size + MOTORS.size
