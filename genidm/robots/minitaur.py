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

# In each leg L is the outer motor on the left of the body and the inner one on the right, so
# that the mirror image of front left L is front right R.
ACROSS = [5, 4, 7, 6, 1, 0, 3, 2]
LEG_ACROSS = [2, 3, 0, 1]
# Seconds that a worker may take for the robots it is given at once: a thousand times the usual.
PATIENCE = 30.0

ABSENT = (
    'the Minitaur needs PyBullet, which is not installed: `pip install "genidm[minitaur]"` brings'
    " it for CPython 3.11 on Linux x86-64; for others there is no wheel of pybullet 3.2.7, and pip"
    " has to build it"
)


class Physics(flax.struct.PyTreeNode):
    """All that a step in PyBullet depends on; `genidm.robots.minitaur_world.ROW`, number by number.

    Attributes:
      pose: `[B, 23]`; base position (m) and quaternion, then joint angles (rad).
      motion: `[B, 22]`; base velocity (m/s) and spin (rad/s), then joint velocities (rad/s).
      motors: `[B, 16]`; physics steps that each motor has been hot for, torques observed (N·m).
    """

    pose: Any
    motion: Any
    motors: Any


def joints(name: str, unit: str) -> symmetry.Field:
    """One number for each of the eight motors, or of the knees below them."""
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
    """The Minitaur of pybullet_envs, stepped by processes of this machine.

    The action `[8]` goes through the leg model of pybullet_envs: how far each leg swings
    (±45° at ±1), then how far it is drawn in, for the legs front left, back left, front
    right, back right. A DC motor model turns the angles that it asks for into torques.

    A step is a function of `State.physics` alone. Each robot is put into its state anew, in
    whichever process is free, and makes five physics steps there: so a robot can be placed,
    replayed and resumed at no cost, and a process that dies takes nothing with it. What
    it costs is the contacts that Bullet keeps from one step to the next (docs/physics.md).

    The model is nearly its own mirror image, not quite: on the left of the body a knee is
    joined 5 mm from where it would be on the right, and one motor of eight, front left R,
    has no inertia of its own. How far that takes it in a mirrored replay is in docs/physics.md.

    Args:
      solver: settings of Bullet.
      engine: "bullet"; there is no other.
      observed: s. "paper17": motor angles (8), the base's velocity (3) and spin (3) in the
        world frame, roll, pitch and yaw. "native28": that of pybullet_envs, motor angles,
        velocities and observed torques (8 each), and a quaternion, here as (w, x, y, z), w ≥ 0.
      processes: that step robots; one for each core, unless given.

    Raises:
      BadInput: PyBullet is not installed, or `observed` is neither.
    """

    name = "minitaur"
    dt = world.SUBSTEP * world.SUBSTEPS
    standing_height = 0.2
    target_distance = protocol.TARGET_DISTANCE["minitaur"]
    paper_interactions = protocol.INTERACTIONS["minitaur"]
    # pybullet_envs has none. With a horizon of a second (discount 0.99), a lunge at 1 m/s that
    # ends in a fall would else be worth more than any walk.
    healthy_reward = 0.5
    # Of the base's start, m/s and rad/s; pybullet_envs has none, and starts that are all alike.
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
            raise BadInput(f"observed is {' or '.join(OBSERVATIONS)}, not {observed!r}")
        solver = solver or Solver()
        chosen = engines.choose(engine, self.engines, self.name)
        self.settings = {
            "name": self.name, "engine": chosen, "solver": solver, "observed": observed,
        }  # fmt: skip
        self.observation = OBSERVATIONS[observed]
        self.engine = bullet(solver, processes)

    @functools.cached_property
    def _rest(self) -> Physics:
        """The settled start, `[...]` of one robot, at yaw 0."""
        return from_rows(jnp.asarray(self.engine.pool.greeting()))

    def visual_model(self) -> mujoco.MjSpec:
        """PyBullet's own model, as MuJoCo reads it: its boxes and cylinders."""
        import pybullet_data

        spec = mujoco.MjSpec.from_file(str(Path(pybullet_data.getDataPath()) / world.URDF))
        spec.compiler.fusestatic = False  # the base is a body, and no part of the floor
        spec.bodies[1].add_freejoint()
        return spec

    def visual_qpos(self, physics: Physics) -> np.ndarray:
        pose = np.asarray(physics.pose)
        angles = pose[..., 7:] * np.tile(world.DIRECTION, 2)
        return np.concatenate([pose[..., :7], angles[..., self._drawn]], axis=-1)

    @functools.cached_property
    def _drawn(self) -> list[int]:
        """For each hinge of the visual model, which of our joints it is."""
        model, names = self.visual_model().compile(), world.MOTORS + world.KNEES
        return [names.index(model.joint(i).name) for i in range(1, model.njnt)]

    def reset(self, keys: jax.Array, yaw: jax.Array) -> State:
        """The settled start of pybullet_envs, the base given a slight push."""
        with jax.ensure_compile_time_eval():
            rest = self._rest
        push = jax.vmap(lambda key: jax.random.normal(key, (6,), jnp.float32))(keys)
        still = jnp.broadcast_to(rest.motion, (*keys.shape, MOTION.size))
        moving = still.at[:, :6].add(self.reset_noise * push)
        alike = jax.tree.map(lambda x: jnp.broadcast_to(x, (*keys.shape, *x.shape)), rest)
        return self.set_state(alike.replace(motion=moving), yaw)

    def set_state(self, physics: Physics, yaw: jax.Array) -> State:
        state = self._state(self.rotate_physics(physics, yaw))
        # A start is not judged.
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
        """What pybullet_envs charges for energy, a second."""
        torque = MOTORS.part(state.physics.motors, "torque")
        rate = MOTION.part(state.physics.motion, "motor velocities")
        return world.charge(torque, rate) / self.dt


def from_rows(rows: jax.Array) -> Physics:
    """Physics of rows `[..., 61]`; quaternions with w ≥ 0."""
    pose, motion, motors = jnp.split(rows, [POSE.size, POSE.size + MOTION.size], axis=-1)
    upright = symmetry.canonical_quaternion(pose[..., 3:7])
    return Physics(pose.at[..., 3:7].set(upright), motion, motors)


@functools.cache
def bullet(solver: Solver, processes: int | None) -> Bullet:
    """The processes that step robots under these settings, shared by all that ask for them."""
    settings = json.dumps(dataclasses.asdict(solver))
    # -P: the worker's own directory is no place to import from.
    command = [sys.executable, "-P", world.__file__, settings, str(PATIENCE)]
    made = Bullet(command, world.WIDTH, processes, PATIENCE)
    atexit.register(made.pool.close)
    return made


assert sum(ROW.values()) == POSE.size + MOTION.size + MOTORS.size
