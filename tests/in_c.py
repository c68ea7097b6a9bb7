"""The oracle of all physics tests: plain `mj_step` on a robot's own model, in float64.

It shares nothing with the engines. `test_engines` holds each of them against it, and
`test_ant` and `test_humanoid` hold states, turns and mirror images against it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from genidm import symmetry
from genidm.engines import Physics
from genidm.robots import State
from genidm.robots.mujoco import MujocoRobot
from genidm.symmetry import Layout


def step_in_c(
    robot: MujocoRobot, physics: Physics, actions: np.ndarray
) -> tuple[Physics, np.ndarray]:
    """Control steps by `mj_step`: physics `[B, ...]` after them, and wrenches `[B, nbody, 6]`.

    The wrenches are those of the start of the last physics step, as no forward follows it.

    Args:
      robot: whose model.
      physics: before.
      actions: `[T, B, A]`.
    """
    data, lanes = mujoco.MjData(robot.mj_model), []
    for lane in range(actions.shape[1]):
        mujoco.mj_resetData(robot.mj_model, data)
        data.qpos, data.qvel = physics.qpos[lane], physics.qvel[lane]
        data.qacc_warmstart = physics.warmstart[lane]
        for action in actions[:, lane]:
            data.ctrl = action
            mujoco.mj_step(robot.mj_model, data, robot.frame_skip)
        mujoco.mj_rnePostConstraint(robot.mj_model, data)
        lanes.append([data.qpos, data.qvel, data.qacc_warmstart, data.cfrc_ext])
        lanes[-1] = [x.copy() for x in lanes[-1]]
        assert data.time == pytest.approx(len(actions) * robot.dt)  # not reset on the way
    *after, contact = map(np.stack, zip(*lanes, strict=True))
    return Physics(*after), contact


def positive_w(physics: Physics) -> Physics:
    """q and −q are one orientation: the one that the layouts give."""
    sign = np.where(physics.qpos[:, 3:4] < 0, -1.0, 1.0)
    qpos = np.asarray(physics.qpos).copy()
    qpos[:, 3:7] *= sign
    return Physics(qpos, np.asarray(physics.qvel), np.asarray(physics.warmstart))


def assert_close(x: Any, y: Any, **tolerance: float) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **tolerance), x, y)


def placed(robot: MujocoRobot, physics: Physics) -> State:
    physics = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), physics)
    return robot.set_state(physics, jnp.zeros(len(physics.qpos)))


def assert_commutes(
    robot: MujocoRobot,
    observed: Callable[[Physics, np.ndarray], np.ndarray],
    starts: Physics,
    episode: tuple[Any, ...],
    change: Callable[[Layout, Any], jax.Array],
) -> None:
    """Steps in C from the changed start, and compares with the changed outcome.

    Args:
      robot: whose model and layouts.
      observed: (physics, wrenches `[B, nbody, 6]`) → s `[B, S]`.
      starts: physics before.
      episode: actions `[T, B, A]`, physics after them, wrenches.
      change: (layout, x) → x as the layout transforms it.
    """
    actions, after, contact = episode
    quarter = robot.quarter_turn.bodies if robot.quarter_turn else None
    wrenches = Layout((symmetry.wrenches("contact", robot.mirror.bodies, quarter),))
    with jax.enable_x64(True):

        def on(layout: Layout, x: np.ndarray) -> np.ndarray:
            return np.asarray(change(layout, x))

        physics = [jax.tree.map(on, robot.physics, p) for p in (starts, positive_w(after))]
        outcome = on(robot.observation, observed(positive_w(after), contact))
        felt = on(wrenches, contact.reshape(len(contact), -1)).reshape(contact.shape)
        got, got_contact = step_in_c(robot, physics[0], on(robot.action, actions))
    assert_close(positive_w(got), physics[1], atol=1e-6)
    assert_close(got_contact, felt, atol=1e-6)  # unclipped, N: up to hundreds
    assert_close(observed(positive_w(got), got_contact), outcome, atol=1e-6)
