"""Rows of raw stepping: `mujoco.batch`, and `robot.step` on each engine."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from mujoco.batch import Batch

from experiments.benchmark.bench import Bench, counted
from experiments.benchmark.measuring import Probe, Skip, carried, timed
from genidm import devices
from genidm.config import to_json
from genidm.engines.base import Physics
from genidm.engines.mujoco import MuJoCo
from genidm.robots import Robot, State, remade
from genidm.robots.mujoco import MujocoRobot

# Steps per lane in a call, as in an iteration of PPO.
STEPS = 32


def batch(bench: Bench, *, wide: bool = False, threads: int | None = None) -> Probe:
    """Only `mujoco.batch`, with random actions drawn in advance.

    Args:
      bench: sizes.
      wide: use the number of lanes of 𝒢 and evaluation.
      threads: number of threads; default: one per core.
    """
    robot, lanes = on_engine(bench, "mujoco"), bench.num_envs(wide)
    assert isinstance(robot, MujocoRobot)
    threads = threads or devices.cores()
    if threads > devices.cores():
        raise Skip(f"{threads} threads need as many cores, but there are {devices.cores()}")
    simulations = Batch(robot.mj_model, lanes, nthread=threads)
    place(simulations, _standing(robot, lanes).physics)
    actions = np.asarray(_actions(robot, lanes), np.float64)
    call = functools.partial(step_batch, robot, simulations, actions)
    return Probe(timed(call, lanes * STEPS), f"{lanes} lanes, {counted(threads, 'thread')}")


def place(simulations: Batch, physics: Physics) -> None:
    """Sets the state of every simulation."""
    simulations.qpos, simulations.qvel = np.asarray(physics.qpos), np.asarray(physics.qvel)
    simulations.qacc_warmstart = np.asarray(physics.warmstart)


def step_batch(robot: MujocoRobot, simulations: Batch, actions: np.ndarray) -> None:
    """Makes the control steps of actions `[T, B, A]` with `mujoco.batch` alone."""
    for action in actions:
        simulations.ctrl = action
        simulations.step(nstep=robot.frame_skip)


def stepping(
    bench: Bench, *, engine: str | None = None, wide: bool = False, count: int | None = None
) -> Probe:
    """Only `robot.step`, with random actions drawn in advance.

    Args:
      bench: sizes.
      engine: engine that steps the robot; default: the robot's own.
      wide: use the number of lanes of 𝒢 and evaluation.
      count: number of devices; default: those that the robot uses.
    """
    robot, lanes = on_engine(bench, engine) if engine else bench.robot, bench.num_envs(wide)
    if (count or 0) > jax.device_count():
        raise Skip(f"it needs {count} devices, but there are {jax.device_count()}")
    mesh = devices.mesh(jax.devices()[:count]) if count else robot.mesh()
    if lanes % mesh.size:
        raise Skip(f"{lanes} lanes cannot be shared among {mesh.size} devices")
    actions = devices.put(_actions(robot, lanes), mesh, 1)

    sharded = devices.over_lanes(functools.partial(walk, robot), mesh, [0, 1], 0)
    program = jax.jit(sharded, donate_argnums=0)
    call = carried(lambda s: program(s, actions), devices.put(_standing(robot, lanes), mesh))
    return Probe(timed(call, lanes * STEPS), f"{lanes} lanes, {among(robot, mesh)}")


def walk(robot: Robot, state: State, actions: jax.Array) -> State:
    """Makes the control steps of actions `[T, B, A]`; returns the last state."""
    return jax.lax.scan(lambda s, a: (robot.step(s, a), None), state, actions)[0]


def limit(bench: Bench, *, wide: bool = False) -> Probe:
    """The robot's own engine alone: the limit of every row that steps the robot.

    For MuJoCo in C this is `mujoco.batch`, without the calls from a jitted program to the host.
    For other engines it is `robot.step`.
    """
    if isinstance(bench.robot.engine, MuJoCo):
        probe, what = batch(bench, wide=wide), "mujoco.batch"
    else:
        probe, what = stepping(bench, wide=wide), "robot.step"
    return probe._replace(note=f"{what}, {probe.note}")


def on_engine(bench: Bench, name: str) -> Robot:
    """The same robot on another engine.

    Raises:
      Skip: the engine cannot step the robot.
    """
    robot = bench.robot
    if name not in robot.engines:
        raise Skip(f"the {robot.name} is not stepped by {name}")
    return remade(to_json(robot.settings) | {"engine": name})


def among(robot: Robot, mesh: Mesh) -> str:
    """The threads or devices that share the lanes, in words."""
    if isinstance(robot.engine, MuJoCo):
        return counted(robot.engine.threads, "thread")
    return counted(mesh.size, "device")


def _actions(robot: Robot, lanes: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(0), (STEPS, lanes, robot.action.size), minval=-1.0)


def _standing(robot: Robot, lanes: int) -> State:
    return jax.jit(robot.reset)(jax.random.split(jax.random.key(1), lanes), jnp.zeros(lanes))
