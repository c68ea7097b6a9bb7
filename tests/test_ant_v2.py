"""gym's Ant-v2: its model against gymnasium's, and its steps against MuJoCo in C."""

from __future__ import annotations

from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from in_c import assert_close, placed, positive_w, step_in_c

from genidm.engines import Physics
from genidm.robots import AntV2, by_name, remade
from genidm.robots.mujoco import Solver

LANES = 8


@pytest.fixture(scope="module")
def robot() -> AntV2:
    return AntV2(engine="mujoco")


def test_the_model_is_gymnasiums(robot: AntV2) -> None:
    """Every number but names and colours; gymnasium's ant.xml is that of gym's Ant-v2."""
    gymnasium = pytest.importorskip("gymnasium")
    path = resources.files(gymnasium) / "envs" / "mujoco" / "assets" / "ant.xml"
    theirs, ours = mujoco.MjModel.from_xml_path(str(path)), robot.mj_model
    skipped = ("name", "numeric", "geom_rgba")
    arrays = {
        name: x
        for name in dir(theirs)
        if not name.startswith(("_", *skipped))
        and isinstance(x := getattr(theirs, name), np.ndarray)
        and x.dtype.kind in "iuf"
    }
    assert {"body_mass", "geom_contype", "geom_margin", "jnt_range", "qpos0"} <= arrays.keys()
    for name, x in arrays.items():
        np.testing.assert_allclose(getattr(ours, name), x, atol=1e-12, err_msg=name)
    options = [
        name
        for name in dir(theirs.opt)
        if not name.startswith("_") and not callable(getattr(theirs.opt, name))
    ]
    assert {"cone", "integrator", "iterations", "ls_iterations", "timestep"} <= set(options)
    for name in options:
        np.testing.assert_array_equal(getattr(ours.opt, name), getattr(theirs.opt, name), name)


def test_physics_is_pyramidal_with_rk4_and_mujocos_iterations(robot: AntV2) -> None:
    option = robot.mj_model.opt
    assert option.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert (option.iterations, option.ls_iterations, option.timestep) == (100, 50, 0.01)
    assert robot.frame_skip * option.timestep == robot.dt == 0.05


def test_a_start_has_straight_legs_above_the_floor(robot: AntV2) -> None:
    state = robot.reset(jax.random.split(jax.random.key(0), 500), jnp.zeros(500))
    height, angles = np.asarray(state.position[:, 2]), np.asarray(state.physics.qpos[:, 7:])
    assert 0.65 <= height.min() < 0.67 and 0.83 < height.max() <= 0.85
    assert 0.09 < np.abs(angles).max() <= 0.1
    assert state.observation.shape == (500, 111) and not state.fallen.any()


def test_the_robot_is_found_by_its_name_and_made_again(robot: AntV2) -> None:
    made = by_name("ant_v2", "mujoco")
    assert isinstance(made, AntV2) and made.settings == robot.settings
    assert made.settings["solver"] == Solver(iterations=100, line_search=50, elliptic=False)
    again = AntV2(Solver(4, 8, elliptic=False), "mujoco")
    kept = {**again.settings, "solver": {"iterations": 4, "line_search": 8, "elliptic": False}}
    assert remade(kept).mj_model.opt.iterations == 4


def contact_in_c(robot: AntV2, start: Physics, actions: np.ndarray) -> np.ndarray:
    """Wrenches `[B, 14, 6]` at the start of the last physics step of a control step.

    After `mj_step`, MuJoCo's data holds those of RK4's last stage, which is another.
    """
    model, contact = robot.mj_model, []
    for lane, action in enumerate(actions):
        data = mujoco.MjData(model)
        data.qpos, data.qvel = start.qpos[lane], start.qvel[lane]
        data.qacc_warmstart, data.ctrl = start.warmstart[lane], action
        mujoco.mj_step(model, data, robot.frame_skip - 1)
        mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        contact.append(data.cfrc_ext.copy())
    return np.stack(contact)


@pytest.fixture(scope="module")
def one_step(robot: AntV2) -> tuple[Any, ...]:
    """Physics in the middle of random episodes, actions `[B, A]`, and a control step in C."""
    rng = np.random.default_rng(0)
    qpos = np.tile(robot.rest_pose().astype(float), (LANES, 1))
    qpos += rng.uniform(-0.1, 0.1, qpos.shape)
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=-1, keepdims=True)
    physics = Physics(qpos, 0.1 * rng.normal(size=(LANES, 14)), np.zeros((LANES, 14)))
    physics, _ = step_in_c(robot, physics, rng.uniform(-0.3, 0.3, (20, LANES, 8)))
    start = jax.tree.map(lambda x: x.astype(np.float32).astype(float), positive_w(physics))
    actions = rng.uniform(-0.3, 0.3, (LANES, 8)).astype(np.float32)
    after, _ = step_in_c(robot, start, actions[None].astype(float))
    contact = contact_in_c(robot, start, actions)
    assert (np.abs(contact).max((1, 2)) > 1).sum() >= 3  # N: some stand, some are in the air
    return start, actions, positive_w(after), contact


def test_a_step_of_c_is_that_of_mj_step(robot: AntV2, one_step: tuple[Any, ...]) -> None:
    start, actions, after, contact = one_step
    got = jax.jit(robot.engine.step)(placed(robot, start).physics, jnp.asarray(actions))
    got = jax.tree.map(lambda x: np.asarray(x, float), got)
    assert_close(positive_w(got.physics).qpos, after.qpos, atol=1e-6)
    assert_close(got.physics.qvel, after.qvel, atol=1e-5)
    np.testing.assert_allclose(got.readings, contact, atol=1e-4)


@pytest.mark.slow
def test_a_step_of_mjx_is_that_of_mj_step(one_step: tuple[Any, ...]) -> None:
    """In float64, where both solvers converge."""
    start, actions, after, contact = one_step
    with jax.enable_x64(True):
        robot = AntV2(engine="mjx")
        got = jax.jit(robot.engine.step)(jax.tree.map(jnp.asarray, start), jnp.asarray(actions))
        got = jax.tree.map(np.asarray, got)
    assert_close(positive_w(got.physics).qpos, after.qpos, atol=1e-6)
    assert_close(got.physics.qvel, after.qvel, atol=1e-5)
    np.testing.assert_allclose(got.readings, contact, atol=1e-3)
