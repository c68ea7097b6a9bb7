"""Base class of robots with a MuJoCo model: resets, states, and the mirror image of a model."""

from __future__ import annotations

import dataclasses
import functools
import math
from os import PathLike
from typing import ClassVar

import brax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from etils import epath

from genidm import engines, symmetry
from genidm.engines import ENGINES, Engine, Physics
from genidm.robots.base import Robot, State, select
from genidm.symmetry import Layout

ASSETS = epath.Path(brax.__file__).parent / "envs" / "assets"


@dataclasses.dataclass(frozen=True)
class Solver:
    """Settings of the constraint solver, chosen mainly for stability (docs/physics.md).

    Attributes:
      iterations: Newton iterations per physics step. Brax's value, 1, is not stable.
      line_search: line-search iterations per Newton iteration. Brax's value, 4, is not stable.
      elliptic: elliptic friction cones. Pyramidal cones depend on the world's axes, so they break
        equivalence modulo orientation (Def. 3).
    """

    iterations: int = 4
    line_search: int = 8
    elliptic: bool = True


def load(path: PathLike[str] | str, solver: Solver) -> mujoco.MjSpec:
    """Reads a model file (MJCF) and applies the solver settings."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = solver.iterations
    spec.option.ls_iterations = solver.line_search
    cones = mujoco.mjtCone
    spec.option.cone = cones.mjCONE_ELLIPTIC if solver.elliptic else cones.mjCONE_PYRAMIDAL
    return spec


@dataclasses.dataclass(frozen=True)
class Image:
    """A symmetry of a model, the reflection y → −y or a quarter turn, as permutations and signs.

    Attributes:
      bodies: `[nbody]`, for each body the body at its image.
      hinges: `[nv − 6]`, for each hinge the hinge at its image.
      signs: `[nv − 6]`, −1 for hinges whose angle and torque change sign, else 1.
      actuators: `[nu]`, for each actuator the actuator at its image.
      actuator_signs: `[nu]`, −1 for actuators whose torque changes sign, else 1.
    """

    bodies: list[int]
    hinges: list[int]
    signs: list[float]
    actuators: list[int]
    actuator_signs: list[float]


REFLECTION = np.diag([1.0, -1.0, 1.0])
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _partner(points: np.ndarray, transformation: np.ndarray, i: int) -> int:
    distance = np.linalg.norm(points - transformation @ points[i], axis=-1)
    if distance.min() > 1e-6:
        raise ValueError("the model is not its own image")
    return int(distance.argmin())


def image_of(model: mujoco.MjModel, transformation: np.ndarray) -> Image:
    """Finds the image of every body, hinge and actuator in the rest pose.

    Args:
      model: the model.
      transformation: `[3, 3]`, `REFLECTION` or `QUARTER_TURN`.

    Raises:
      ValueError: the model is not its own image.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # Centres of mass tell bodies apart even where their frames coincide.
    bodies = [_partner(data.xipos, transformation, i) for i in range(model.nbody)]
    hinges, signs = [], []
    for j in range(1, model.njnt):
        # A hinge's axis is a pseudovector.
        axis = np.linalg.det(transformation) * transformation @ data.xaxis[j]
        body = bodies[model.jnt_bodyid[j]]
        along = [
            (k, axis @ data.xaxis[k]) for k in range(1, model.njnt) if model.jnt_bodyid[k] == body
        ]
        k, sign = max(along, key=lambda pair: abs(pair[1]))
        hinges.append(k - 1)
        signs.append(float(round(sign)))
    driven = [int(j) - 1 for j in model.actuator_trnid[:, 0]]
    actuators = [driven.index(hinges[j]) for j in driven]
    return Image(bodies, hinges, signs, actuators, [signs[j] for j in driven])


def quarter_turn_of(model: mujoco.MjModel) -> Image | None:
    """The quarter turn of a model's body, or None if it is not its own image, limits included."""
    try:
        image = image_of(model, QUARTER_TURN)
    except (ValueError, IndexError):
        return None
    limits, signs = model.jnt_range[1:], np.array(image.signs)[:, None]
    same = np.sort(limits[image.hinges] * signs, axis=1)
    return image if np.allclose(same, limits, atol=1e-6) and signs.all() else None


class MujocoRobot(Robot):
    """A robot with a free base and hinges, stepped by an engine of `genidm.engines.ENGINES`.

    A subclass sets `name`, `model`, `frame_skip`, `dt`, `standing_height` and `healthy_height`;
    docs/extending.md shows one. It may override the other attributes and methods.

    By default s is gymnasium's without x and y: height, quaternion (w ≥ 0), joint angles,
    velocity, spin, joint velocities.

    Args:
      solver: settings of the constraint solver.
      engine: one of `engines`; default: chosen by hardware.

    Attributes:
      model: the MJCF file.
      frame_skip: physics steps per control step.
      healthy_height: metres, least and greatest height of the base; outside, the robot has fallen.
      control_cost: weight of the sum of squared actions in the cost of a step.
      reset_noise: noise of the initial state: half width of the uniform noise in qpos (m, rad),
        standard deviation of the noise in qvel (m/s, rad/s).

    Raises:
      ValueError: the model has no free base, has joints other than hinges, is not its own mirror
        image, or its time step does not fit `dt`.
    """

    engines = ENGINES.keys()
    engine: Engine
    model: ClassVar[PathLike[str] | str]
    frame_skip: ClassVar[int]
    healthy_height: ClassVar[tuple[float, float]]
    target_distance = (2.0, 5.0)
    healthy_reward = 1.0
    paper_interactions = 2_000_000
    control_cost: float = 0.5
    reset_noise: float = 0.1

    def __init__(self, solver: Solver | None = None, engine: str | None = None):
        solver = solver or Solver()
        self._spec = self._specify(solver)
        self.mj_model = self._spec.compile()
        _fitting(self.mj_model, self.frame_skip, self.dt)
        chosen = engines.choose(engine, self.engines, self.name)
        self.engine = engines.of_model(chosen, self._spec, self.frame_skip)
        self.settings = {"name": self.name, "engine": self.engine.name, "solver": solver}
        self._rest = self.rest_pose()
        self.mirror = image_of(self.mj_model, REFLECTION)
        self.quarter_turn = quarter_turn_of(self.mj_model)
        self.physics = self._physics_layout()
        self.observation = self._layout()
        m = self.mirror
        turn = self.quarter_turn
        quarter = (turn.actuators, turn.actuator_signs) if turn else None
        self.action = Layout(
            (symmetry.joints("torque", m.actuators, m.actuator_signs, "of full torque", quarter),)
        )

    def _specify(self, solver: Solver) -> mujoco.MjSpec:
        """The model, with the solver settings."""
        return load(self.model, solver)

    def rest_pose(self) -> np.ndarray:
        """qpos `[nq]` of the rest pose, the centre of the reset noise."""
        return self.mj_model.qpos0.astype(np.float32)

    def _layout(self) -> Layout:
        """Layout of s, as `_observe` returns it."""
        return Layout(
            (
                symmetry.invariant("height", unit="m"),
                symmetry.quaternion("orientation"),
                self._hinges("joint angles", "rad"),
                symmetry.vector("velocity", "m/s"),
                symmetry.body_pseudovector("spin"),
                self._hinges("joint velocities", "rad/s"),
            )
        )

    def _hinges(self, name: str, unit: str) -> symmetry.Field:
        """A field with one number per hinge."""
        m, turn = self.mirror, self.quarter_turn
        quarter = (turn.hinges, turn.signs) if turn else None
        return symmetry.joints(name, m.hinges, m.signs, unit, quarter)

    def _physics_layout(self) -> Physics:
        angles = self._hinges("joint angles", "rad")
        rates = self._hinges("joint velocities", "rad/s")
        pose = (symmetry.vector("position"), symmetry.quaternion("orientation"), angles)
        motion = (symmetry.vector("velocity", "m/s"), symmetry.body_pseudovector("spin"), rates)
        return Physics(Layout(pose), Layout(motion), Layout(motion))

    def visual_model(self) -> mujoco.MjSpec:
        return self._spec.copy()

    def visual_qpos(self, physics: Physics) -> np.ndarray:
        return np.asarray(physics.qpos)

    def reset(self, keys: jax.Array, yaw: jax.Array) -> State:
        physics = jax.vmap(self._draw)(keys)
        return self.set_state(physics, yaw)

    def _draw(self, key: jax.Array) -> Physics:
        """gymnasium's initial state: the rest pose, uniform noise in qpos, Gaussian in qvel."""
        pose, motion = jax.random.split(key)
        noise, nq, nv = self.reset_noise, self.mj_model.nq, self.mj_model.nv
        qpos = jnp.asarray(self._rest) + jax.random.uniform(
            pose, (nq,), jnp.float32, minval=-noise, maxval=noise
        )
        # MuJoCo normalises quaternions that it reads; the observation needs unit length, too.
        qpos = qpos.at[3:7].divide(jnp.linalg.norm(qpos[3:7]))
        qvel = noise * jax.random.normal(motion, (nv,), jnp.float32)
        return Physics(qpos, qvel, jnp.zeros(nv, jnp.float32))

    def set_state(self, physics: Physics, yaw: jax.Array) -> State:
        contact = jnp.zeros((*yaw.shape, self.mj_model.nbody, 6), physics.qpos.dtype)
        state = jax.vmap(self._state)(self.rotate_physics(physics, yaw), contact)
        # An initial state is never a fall, although the noise may exceed the healthy height.
        return state.replace(fallen=jnp.zeros_like(state.fallen))

    def step(self, state: State, action: jax.Array) -> State:
        physics, contact = self.engine.step(state.physics, action)
        finite = functools.reduce(
            jnp.logical_and,
            [
                jnp.isfinite(x).all(tuple(range(1, x.ndim)))
                for x in jax.tree.leaves((physics, contact))
            ],
        )
        after = jax.vmap(self._state)(physics, contact)
        return select(finite, after, state.replace(diverged=jnp.ones_like(finite)))

    def _state(self, physics: Physics, contact: jax.Array) -> State:
        height = physics.qpos[2]
        low, high = self.healthy_height
        return State(
            physics=physics,
            observation=self._observe(physics, contact),
            position=physics.qpos[:3],
            heading=symmetry.yaw_of(physics.qpos[3:7]),
            fallen=(height < low) | (height > high),
            diverged=jnp.zeros((), bool),
        )

    def _observe(self, physics: Physics, contact: jax.Array) -> jax.Array:
        """s `[S]` of one robot from its physics and contact wrenches `[nbody, 6]`."""
        qpos = physics.qpos.at[3:7].set(symmetry.canonical_quaternion(physics.qpos[3:7]))
        return jnp.concatenate([qpos[2:], physics.qvel])

    def cost(self, state: State, action: jax.Array) -> jax.Array:
        return self.control_cost * jnp.sum(action**2, axis=-1)


def _fitting(model: mujoco.MjModel, frame_skip: int, dt: float) -> None:
    """Checks that `Physics` describes the model, and that its time step fits `dt` (ValueError)."""
    free, hinge = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE
    if [*model.jnt_type[:1]] != [free] or not (model.jnt_type[1:] == hinge).all():
        raise ValueError("the model must have a free joint first, and hinges after it")
    seconds = frame_skip * model.opt.timestep
    if not math.isclose(seconds, dt, rel_tol=1e-6):
        raise ValueError(f"{frame_skip} time steps of the model are {seconds:g} s, not {dt:g} s")
