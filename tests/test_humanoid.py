"""The Humanoid against MuJoCo in C on the same model, and against PyBullet's own."""

from __future__ import annotations

import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_c import assert_close, assert_commutes, placed, positive_w, step_in_c
from one_step import advance
from scipy.spatial.transform import Rotation

from experiments.humanoid_world import in_world
from genidm.engines import Physics
from genidm.robots import Humanoid, HumanoidWorld
from genidm.robots.humanoid import POWER
from genidm.tasks import WalkForward

LANES = 16


@pytest.fixture(scope="module")
def humanoid() -> Humanoid:
    return Humanoid()


@pytest.fixture(scope="module")
def robot(humanoid: Humanoid) -> Humanoid:
    """The Humanoid with compiled functions: one program for all of this file's steps."""
    robot = copy.copy(humanoid)
    robot.step, robot.reset = jax.jit(humanoid.step), jax.jit(humanoid.reset)
    return robot


def observed_in_c(physics: Physics, contact: np.ndarray, frame: str = "heading") -> np.ndarray:
    """s `[B, 43]` as the class's docstring puts it, number by number."""
    limits = Humanoid().mj_model.jnt_range[1:]
    rows = []
    for qpos, qvel, wrenches in zip(physics.qpos, physics.qvel, contact, strict=True):
        yaw, pitch, roll = Rotation.from_quat(qpos[3:7], scalar_first=True).as_euler("ZYX")
        velocity = qvel[:3]
        if frame == "heading":
            velocity = Rotation.from_euler("z", -yaw).apply(velocity)
        joints = []
        for (low, high), angle, rate in zip(limits, qpos[7:], qvel[6:], strict=True):
            joints += [2 * (angle - (low + high) / 2) / (high - low), 0.1 * rate]
        feet = [1.0 * (np.linalg.norm(wrenches[body, 3:]) > 1) for body in (6, 9)]
        rows.append([qpos[2] - 0.8, *(0.3 * velocity), roll, pitch, yaw, *joints, *feet])
    return np.clip(rows, -5, 5)


@pytest.fixture(scope="module")
def starts(humanoid: Humanoid) -> Physics:
    """Physics `[B, ...]` in the middle of random episodes: landing, tipping over."""
    rng = np.random.default_rng(0)
    nv = humanoid.mj_model.nv
    qpos = np.tile(humanoid.rest_pose().astype(float), (LANES, 1))
    qpos[:, 7:] += rng.uniform(-0.1, 0.1, (LANES, 17))
    physics = Physics(qpos, np.zeros((LANES, nv)), np.zeros((LANES, nv)))
    actions = rng.uniform(0, 0.5, (LANES, 1)) * rng.choice([-1.0, 1.0], (25, LANES, 17))
    physics, _ = step_in_c(humanoid, physics, actions)
    # Numbers that float32 holds too: what differs later is the stepping alone.
    return jax.tree.map(lambda x: x.astype(np.float32).astype(float), positive_w(physics))


@pytest.fixture(scope="module")
def one_step(humanoid: Humanoid, starts: Physics) -> tuple[Any, ...]:
    """A control step in C from `starts`: actions `[B, A]`, physics after it, wrenches."""
    actions = np.random.default_rng(1).uniform(-1, 1, (LANES, 17)).astype(np.float32)
    after, contact = step_in_c(humanoid, starts, actions[None])
    on_floor = np.abs(contact[:, [6, 9]]).max(-1) > 0
    assert LANES // 4 <= on_floor.sum() < 2 * LANES
    assert not np.delete(contact, [6, 9], axis=1).any()  # only feet touch the floor
    return actions, positive_w(after), contact


@pytest.mark.parametrize("kind", [Humanoid, HumanoidWorld])
def test_state_is_read_as_in_c(starts: Physics, kind: type[Humanoid]) -> None:
    robot = kind()
    state = placed(robot, starts)
    contact = np.zeros((LANES, robot.mj_model.nbody, 6))
    assert_close(state.observation, observed_in_c(starts, contact, kind.velocity), atol=2e-6)
    assert_close(state.position, starts.qpos[:, :3], atol=0)
    assert robot.observation.size == 43 and robot.action.size == 17


def test_next_state_is_that_of_c(starts: Physics, one_step: tuple[Any, ...]) -> None:
    """In float64 MJX and C do the same sums; a line search or two end elsewhere."""
    actions, after, contact = one_step
    with jax.enable_x64(True):
        robot = Humanoid()
        state = jax.jit(robot.step)(robot.set_state(starts, jnp.zeros(LANES)), jnp.asarray(actions))
        got, observation = positive_w(state.physics), np.asarray(state.observation)
    expected = observed_in_c(after, contact)
    assert_close(got.qpos, after.qpos, atol=1e-5)
    assert_close(got.qvel, after.qvel, atol=1e-3)
    assert np.median(np.abs(observation - expected).max(-1)) < 1e-10
    assert_close(observation, expected, atol=1e-3)


def test_next_state_is_that_of_c_in_float32(
    robot: Humanoid, starts: Physics, one_step: tuple[Any, ...]
) -> None:
    actions, after, contact = one_step
    state = robot.step(placed(robot, starts), jnp.asarray(actions))
    assert not state.diverged.any()
    assert_close(positive_w(state.physics).qpos, after.qpos, atol=1e-3)
    assert_close(state.observation, observed_in_c(after, contact), atol=0.02)
    assert np.array_equal(state.fallen, after.qpos[:, 2] < 0.78)


@pytest.fixture(scope="module")
def episode(starts: Physics, humanoid: Humanoid) -> tuple[Any, ...]:
    """20 control steps from `starts`: actions, physics after them, wrenches."""
    actions = np.random.default_rng(2).uniform(-0.25, 0.25, (20, LANES, 17))
    after, contact = step_in_c(humanoid, starts, actions)
    assert (np.abs(contact).max((1, 2)) > 0).sum() >= LANES // 4
    return actions, after, contact


def test_yaw_commutes_with_physics(
    humanoid: Humanoid, starts: Physics, episode: tuple[Any, ...]
) -> None:
    yaw = np.linspace(-3, 3, LANES)
    assert_commutes(humanoid, observed_in_c, starts, episode, lambda part, x: part.rotate(x, yaw))


def test_mirror_commutes_with_physics(
    humanoid: Humanoid, starts: Physics, episode: tuple[Any, ...]
) -> None:
    assert_commutes(humanoid, observed_in_c, starts, episode, lambda part, x: part.mirror(x))


def test_world_frame_turns_the_velocity(starts: Physics) -> None:
    robot, yaw = HumanoidWorld(), np.linspace(-3, 3, LANES).astype(np.float32)
    state = placed(robot, starts)
    turned = robot.set_state(state.physics, jnp.asarray(yaw))
    got = robot.observation.rotate(state.observation, yaw)
    assert_close(turned.observation, got, atol=5e-6)
    assert np.abs(turned.observation[:, 1:3] - state.observation[:, 1:3]).max() > 0.1


def test_a_record_is_read_as_the_world_has_it(humanoid: Humanoid, starts: Physics) -> None:
    yaw = jnp.linspace(-3, 3, LANES)
    turned = humanoid.set_state(starts, yaw)
    expected = HumanoidWorld().set_state(starts, yaw).observation
    assert_close(in_world(turned.observation), expected, atol=5e-6)
    assert np.abs(turned.observation - expected).max() > 0.1


# ── PyBullet ────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def bullet() -> Any:
    """PyBullet's own humanoid: client, body, joints by name."""
    client = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    import pybullet_data

    client.connect(client.DIRECT)
    folder = pybullet_data.getDataPath()
    (body,) = client.loadMJCF(f"{folder}/mjcf/humanoid_symmetric.xml")
    infos = [client.getJointInfo(body, j) for j in range(client.getNumJoints(body))]
    yield client, body, {i[1].decode(): i for i in infos if i[2] == client.JOINT_REVOLUTE}
    client.disconnect()


def test_motors_are_pybullets(humanoid: Humanoid, bullet: Any) -> None:
    _, _, joints = bullet
    model = humanoid.mj_model
    assert list(joints) == list(POWER)
    assert [model.actuator(i).name for i in range(17)] == list(joints)
    assert [model.joint(j + 1).name for j in range(17)] == list(joints)
    limits = np.array([joint[8:10] for joint in joints.values()])
    assert_close(model.jnt_range[1:], limits, atol=1e-6)
    assert_close(model.actuator_gear[:, 0], 0.41 * np.array(list(POWER.values())), rtol=1e-12)


def test_state_is_pybullets(humanoid: Humanoid, starts: Physics, bullet: Any) -> None:
    """The same pose and motion in PyBullet, read as `WalkerBase.calc_state` reads it."""
    client, body, joints = bullet
    ours = np.asarray(placed(humanoid, starts).observation)
    for qpos, qvel, s in zip(starts.qpos, starts.qvel, ours, strict=True):
        w, *xyz = qpos[3:7]
        client.resetBasePositionAndOrientation(body, qpos[:3], [*xyz, w])
        spin = Rotation.from_quat(qpos[3:7], scalar_first=True).apply(qvel[3:6])
        client.resetBaseVelocity(body, qvel[:3], spin)
        for joint, angle, rate in zip(joints.values(), qpos[7:], qvel[6:], strict=True):
            client.resetJointState(body, joint[0], angle, rate)
        (_, _, z), orientation = client.getBasePositionAndOrientation(body)
        roll, pitch, yaw = client.getEulerFromQuaternion(orientation)
        velocity = Rotation.from_euler("z", -yaw).apply(client.getBaseVelocity(body)[0])
        numbers = []
        for joint in joints.values():
            angle, rate, *_ = client.getJointState(body, joint[0])
            low, high = joint[8:10]
            numbers += [2 * (angle - 0.5 * (low + high)) / (high - low), 0.1 * rate]
        theirs = [z - 0.8, *(0.3 * velocity), roll, pitch, yaw, *numbers]
        assert_close(s[:41], np.clip(theirs, -5, 5), atol=1e-5)


def test_links_lie_where_pybullet_has_them(
    humanoid: Humanoid, starts: Physics, bullet: Any
) -> None:
    import mujoco

    client, body, joints = bullet
    data = mujoco.MjData(humanoid.mj_model)
    links = {client.getJointInfo(body, j)[12].decode(): j for j in range(client.getNumJoints(body))}
    for qpos in starts.qpos:
        data.qpos = qpos
        mujoco.mj_forward(humanoid.mj_model, data)
        w, *xyz = qpos[3:7]
        client.resetBasePositionAndOrientation(body, qpos[:3], [*xyz, w])
        for joint, angle in zip(joints.values(), qpos[7:], strict=True):
            client.resetJointState(body, joint[0], angle)
        for name in ("pelvis", "right_shin", "left_foot", "right_lower_arm"):
            theirs = client.getLinkState(body, links[name], computeForwardKinematics=True)[4]
            # PyBullet leaves out the slight pitch of the waist (0.23°).
            assert_close(data.body(name).xpos, theirs, atol=0.02)


# ── resets and rewards ──────────────────────────────────────────────────────────────────────


def test_starts_are_upright_at_rest_and_all_different(robot: Humanoid) -> None:
    keys = jax.random.split(jax.random.key(0), LANES)
    state = robot.reset(keys, jnp.linspace(-3, 3, LANES))
    assert_close(state.heading, np.linspace(-3, 3, LANES), atol=1e-5)
    assert_close(state.observation[:, 4:6], 0.0, atol=1e-6)
    assert_close(state.position, np.tile([0, 0, 1.4], (LANES, 1)), atol=1e-6)
    assert not state.physics.qvel.any() and not state.fallen.any()
    angles = np.asarray(state.physics.qpos[:, 7:])
    assert np.abs(angles).max() <= 0.1 and len(np.unique(angles[:, 0])) == LANES


def test_a_limp_humanoid_falls(robot: Humanoid) -> None:
    state = robot.reset(jax.random.split(jax.random.key(0), LANES), jnp.zeros(LANES))
    fallen = np.zeros(LANES, bool)
    for _ in range(150):
        state = robot.step(state, jnp.zeros((LANES, 17)))
        fallen |= np.asarray(state.fallen)
    assert fallen.all() and not state.diverged.any()


def test_reward_is_pybullets(robot: Humanoid) -> None:
    """Speed + 2 alive − 2 mean |a · 0.1 q̇| − 0.1 mean a² − 0.1 a joint at its limit."""
    task = WalkForward()
    lanes = task.start(robot, jax.random.split(jax.random.key(0), LANES))
    for t in range(12):
        action = jax.random.uniform(jax.random.key(t), (LANES, 17), minval=-1.0)
        lanes, step = advance(task, robot, lanes, action)
    a, after = np.asarray(step.action), np.asarray(step.after.observation)
    place, rate = after[:, 7:41:2], after[:, 8:41:2]
    forward = np.asarray(step.after.position - step.before.position)[:, 0] / 0.0165
    expected = forward + 2 - 2 * np.abs(a * rate).mean(-1) - 0.1 * (a**2).mean(-1)
    expected -= 0.1 * (np.abs(place) > 0.99).sum(-1)
    assert not step.terminal.any()
    assert_close(step.reward, expected, atol=1e-4)
