"""The physics alone: the robot stepped in MuJoCo's C engine, and in MJX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.rollout import Rollout

from experiments.benchmark.bench import Bench, counted
from experiments.benchmark.measuring import Probe, Skip, carried, timed
from genidm import devices
from genidm.robots import Robot, State
from genidm.robots.mujoco import MujocoRobot

# Steps of a lane in a call, as in an iteration of PPO.
STEPS = 32


def in_c(bench: Bench) -> Probe:
    """MuJoCo in C, one thread a core, on the robot's own model and solver settings."""
    robot, lanes = bench.robot, bench.options.lanes
    if not isinstance(robot, MujocoRobot):
        raise Skip(f"the {robot.name} is no MuJoCo model")
    model, threads = robot.mj_model, devices.cores()
    pool = bench.exits.enter_context(Rollout(nthread=threads))
    data = [mujoco.MjData(model) for _ in range(threads)]
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (lanes, STEPS, model.nu))
    control = actions.repeat(robot.frames, axis=1)
    physics = _standing(robot, lanes).physics
    start = [np.zeros((lanes, 1)), physics.qpos, physics.qvel, np.zeros((lanes, model.na))]

    def step(state: np.ndarray) -> np.ndarray:
        states, _ = pool.rollout(model, data, state, control)
        return states[:, -1]

    call = carried(step, np.concatenate(start, axis=1))
    return Probe(timed(call, lanes * STEPS), f"{lanes} lanes, {threads} threads")


def raw(bench: Bench, *, wide: bool = False, count: int | None = None) -> Probe:
    """`robot.step` under random actions drawn beforehand, and nothing else.

    Args:
      bench: sizes.
      wide: as many lanes as 𝒢 and evaluation have.
      count: devices; all, unless given.
    """
    robot, lanes = bench.robot, bench.options.wide if wide else bench.options.lanes
    count = count or jax.device_count()
    if count > jax.device_count() or lanes % count:
        raise Skip(f"{lanes} lanes and {jax.device_count()} devices do not make {count} shares")
    mesh = devices.mesh(jax.devices()[:count])
    shape = (STEPS, lanes, robot.action.size)
    actions = devices.put(jax.random.uniform(jax.random.key(0), shape, minval=-1.0), mesh, 1)

    def walk(state: State, actions: jax.Array) -> State:
        return jax.lax.scan(lambda s, a: (robot.step(s, a), None), state, actions)[0]

    program = jax.jit(devices.over_lanes(walk, mesh, [0, 1], 0), donate_argnums=0)
    call = carried(lambda s: program(s, actions), devices.put(_standing(robot, lanes), mesh))
    return Probe(timed(call, lanes * STEPS), f"{lanes} lanes, {counted(count, 'device')}")


def _standing(robot: Robot, lanes: int) -> State:
    return jax.jit(robot.reset)(jax.random.split(jax.random.key(1), lanes), jnp.zeros(lanes))
