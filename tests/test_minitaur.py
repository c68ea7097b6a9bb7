"""The Minitaur against pybullet_envs' own, and its pure step against live simulations."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from bits import same
from one_step import advance
from original_minitaur import AFTER, RECORD, actions, original

from genidm import devices, symmetry
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings, flatten
from genidm.evaluation.evaluator import Evaluator
from genidm.evaluation.scenarios import scenarios
from genidm.robots import Minitaur, State, by_name
from genidm.robots.minitaur import Physics, from_rows
from genidm.robots.minitaur_world import (
    ALOFT,
    HOT,
    PATIENT,
    WIDTH,
    Simulation,
    Solver,
    parts,
    stepped,
)
from genidm.tasks import WalkForward

pytest.importorskip("pybullet", reason="PyBullet is not installed: there is no wheel of it here")

LANES = 16
AS_ORIGINAL = Solver(iterations=60, self_collision=True, cone=True)


@pytest.fixture(scope="module")
def minitaur() -> Minitaur:
    """The Minitaur with compiled functions: one program for all of this file's steps."""
    robot = Minitaur(processes=2)
    robot.step, robot.reset = jax.jit(robot.step), jax.jit(robot.reset)  # type: ignore[method-assign]
    return robot


@pytest.fixture(scope="module")
def starts(minitaur: Minitaur) -> State:
    """Robots in the middle of random episodes."""
    rng = np.random.default_rng(0)
    state = minitaur.reset(jax.random.split(jax.random.key(0), LANES), jnp.zeros(LANES))
    for _ in range(15):
        state = minitaur.step(state, jnp.asarray(rng.uniform(-1, 1, (LANES, 8)), jnp.float32))
    return state


def chosen(seed: int = 1) -> jax.Array:
    """Actions `[LANES, 8]`."""
    return jax.random.uniform(jax.random.key(seed), (LANES, 8), minval=-1.0)


def rows(physics: Physics) -> np.ndarray:
    return np.concatenate([physics.pose, physics.motion, physics.motors], axis=-1)


@pytest.fixture(scope="module", params=[Solver(), AS_ORIGINAL], ids=["ours", "original"])
def simulation(request: Any) -> Iterator[Simulation]:
    simulation = Simulation(request.param)
    yield simulation
    simulation.close()


# ── pybullet_envs ───────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def record() -> np.ndarray:
    return np.loadtxt(RECORD, delimiter=",")


def test_motion_is_that_of_pybullet_envs(record: np.ndarray) -> None:
    """40 strong random actions; what differs is the rounding of the leg model, and grows."""
    simulation, reward, seen = Simulation(AS_ORIGINAL), 0.0, []
    for t in range(max(AFTER) + 1):
        x = parts(simulation.read())
        base = [np.roll(x["orientation"], -1), x["position"], x["velocity"], x["spin"]]
        s = [x["angles"][:8], x["rates"][:8], x["torque"]]
        seen.append(np.concatenate([*s, *base, x["heat"], [reward]]))
        if t < max(AFTER):
            simulation.step(actions()[t])
            after = parts(simulation.read())
            energy = abs(after["torque"] @ after["rates"][:8]) * 0.002
            reward = after["position"][0] - x["position"][0] - 0.005 * energy
    simulation.close()
    assert record[:, 37:45].max() >= 10  # motors ran hot
    # There a reward counts Δx from the origin, not from the settled start.
    np.testing.assert_allclose(np.array(seen)[list(AFTER)][:, :45], record[:, :45], atol=1e-6)
    np.testing.assert_allclose(np.array(seen)[list(AFTER)][2:, 45], record[2:, 45], atol=1e-6)


def test_the_record_is_pybullet_envs(record: np.ndarray) -> None:
    for needed in ("gym", "pkg_resources"):
        pytest.importorskip(needed, reason="pybullet_envs needs gym 0.25.2 and setuptools below 81")
    np.testing.assert_allclose(original(), record, atol=1e-6)


def test_a_motor_that_is_hot_for_a_second_is_off_for_good(simulation: Simulation) -> None:
    simulation.reset()
    row = simulation.read()
    heat = slice(WIDTH - 16, WIDTH - 8)
    row[heat] = [PATIENT - 1, 0, 0, 0, 0, 0, 0, PATIENT + 1]
    simulation.set_state(row)
    strong = np.array([0, 0, 0, 0, -1, -1, -1, -1.0])
    given = []
    push = simulation.push
    simulation.push = lambda torques: (given.append(np.abs(torques)), push(torques))  # type: ignore
    simulation.step(strong)
    simulation.push = push  # type: ignore[method-assign]
    assert given[0][0] > HOT and not given[1][0]  # the last of its second; one too many
    assert not np.array(given)[:, 7].any()
    assert np.array(given)[:, 1:7].all()


# ── a step is a function of its row ─────────────────────────────────────────────────────────


def test_a_step_does_not_depend_on_what_came_before(simulation: Simulation, starts: State) -> None:
    asked = np.concatenate([rows(starts.physics), chosen()], axis=-1)
    first = [stepped(simulation, row) for row in asked]
    rng = np.random.default_rng(0)
    for _ in range(3):
        for i in rng.permutation(LANES):
            same(stepped(simulation, asked[i]), first[i])
    simulation.reset(1.0)
    same(stepped(simulation, asked[0]), first[0])


def test_a_step_is_one_of_a_live_simulation(simulation: Simulation) -> None:
    """Contacts that Bullet keeps, and float32, are all that a robot placed anew loses."""
    rng, apart = np.random.default_rng(0), []
    simulation.reset()
    for _ in range(40):
        action, before = rng.uniform(-0.5, 0.5, 8), simulation.read().astype(np.float32)
        simulation.step(action)
        live = simulation.read()
        again = stepped(simulation, np.concatenate([before, action]))
        apart.append(np.abs(again - live)[:23].max())  # m, rad
        simulation.set_state(live)
    assert np.median(apart) < 1e-3 and max(apart) < 0.05


def test_devices_and_processes_change_no_bit(minitaur: Minitaur, starts: State) -> None:
    one = Minitaur(processes=1)
    mesh = devices.mesh()
    assert mesh.size == 2
    sharded = jax.jit(devices.over_lanes(one.step, mesh, [0, 0], 0))
    after = minitaur.step(starts, chosen()).physics
    same(sharded(devices.put(starts, mesh), devices.put(chosen(), mesh)).physics, after)
    half = jax.tree.map(lambda x: x[3:7], starts)
    same(one.step(half, chosen()[3:7]).physics, jax.tree.map(lambda x: x[3:7], after))


def test_steps_in_a_scan_are_steps(minitaur: Minitaur, starts: State) -> None:
    given = jnp.stack([chosen(i) for i in range(4)])
    scanned, _ = jax.lax.scan(lambda s, a: (minitaur.step(s, a), None), starts, given)
    state = starts
    for action in given:
        state = minitaur.step(state, action)
    same(scanned.physics, state.physics)


def test_placing_and_resetting_ask_nothing_of_the_processes(minitaur: Minitaur) -> None:
    keys = jax.random.split(jax.random.key(0), LANES)
    program = jax.make_jaxpr(Minitaur.reset, static_argnums=0)(minitaur, keys, jnp.zeros(LANES))
    assert "callback" not in str(program)
    assert "callback" in str(jax.make_jaxpr(Minitaur.step, static_argnums=0)(
        minitaur, minitaur.reset(keys, jnp.zeros(LANES)), chosen()
    ))  # fmt: skip


# ── symmetry ────────────────────────────────────────────────────────────────────────────────


def thrown(starts: State) -> Physics:
    """Robots high in the air, tumbling: no floor tells yaws apart."""
    push = jax.random.normal(jax.random.key(2), (LANES, 6))
    physics = starts.physics
    return physics.replace(
        pose=physics.pose.at[:, 2].add(ALOFT), motion=physics.motion.at[:, :6].add(push)
    )


def followed(robot: Minitaur, state: State, given: list[jax.Array]) -> State:
    for action in given:
        state = robot.step(state, action)
    return state


def test_yaw_commutes_with_physics_in_the_air(minitaur: Minitaur, starts: State) -> None:
    """Bullet joins the knees axis by axis of the world, and stops before they quite meet."""
    yaw, still = jnp.linspace(-3, 3, LANES), jnp.zeros(LANES)
    given = [chosen(i) for i in range(5)]
    physics = thrown(starts)
    straight = followed(minitaur, minitaur.set_state(physics, still), given)
    turned = followed(minitaur, minitaur.set_state(physics, yaw), given)
    exact = minitaur.rotate_physics(straight.physics, yaw)
    assert_near(turned.physics.pose, exact.pose, 3e-3)
    assert_near(turned.physics.motion, exact.motion, 0.1)
    assert_near(turned.physics.motors, exact.motors, 0.02)
    s = minitaur.observation.rotate(straight.observation, yaw)
    s, got = s.at[:, 16].set(0), turned.observation.at[:, 16].set(0)  # headings wrap
    assert_near(got, s, 0.03)
    assert_near(jnp.cos(turned.heading - straight.heading - yaw), 1.0, 1e-4)
    moved = np.abs(turned.physics.motion - straight.physics.motion)[:, :6]
    assert (np.median(moved, axis=0)[[0, 1, 3, 4]] > 0.1).all()


def test_yaw_commutes_with_physics_on_the_floor(minitaur: Minitaur, starts: State) -> None:
    yaw, given = jnp.linspace(-3, 3, LANES), [chosen(i) for i in range(10)]
    straight = followed(minitaur, minitaur.set_state(starts.physics, jnp.zeros(LANES)), given)
    turned = followed(minitaur, minitaur.set_state(starts.physics, yaw), given)
    apart = symmetry.rotate_vector(straight.position, yaw) - turned.position
    assert np.median(np.linalg.norm(apart, axis=-1)) < 2e-3


def test_mirror_nearly_commutes_with_physics(minitaur: Minitaur, starts: State) -> None:
    """The model is its own mirror image but for 5 mm at the knees and one motor's inertia."""
    given, still = [chosen(i) for i in range(5)], jnp.zeros(LANES)
    physics = thrown(starts)
    there = followed(minitaur, minitaur.set_state(physics, still), given)
    across = followed(
        minitaur, minitaur.set_state(minitaur.mirror_physics(physics), still),
        [minitaur.action.mirror(a) for a in given],
    )  # fmt: skip
    exact = minitaur.mirror_physics(there.physics)
    apart = np.abs(np.asarray(across.physics.pose - exact.pose))
    assert np.median(apart[:, :3]) < 1e-3 and np.median(apart[:, 3:7]) < 5e-3
    assert np.median(apart[:, 7:15]) < 0.02
    swapped = np.abs(np.asarray(there.physics.pose - exact.pose))
    assert np.median(swapped[:, 7:15]) > 0.1
    velocity = np.abs(np.asarray(across.physics.motion - exact.motion))
    assert np.median(velocity[:, :3]) < 0.02 and np.median(velocity[:, 3:6]) < 0.15


def assert_near(x: Any, y: Any, atol: float) -> None:
    np.testing.assert_allclose(x, y, atol=atol)


# ── resets, readings, rewards ───────────────────────────────────────────────────────────────


def test_starts_are_settled_and_all_different(minitaur: Minitaur, simulation: Simulation) -> None:
    yaw = jnp.linspace(-3, 3, LANES)
    state = minitaur.reset(jax.random.split(jax.random.key(0), LANES), yaw)
    assert_near(state.heading, yaw, 0.01)
    assert_near(state.position[:, 2], 0.158, 1e-3)
    assert not state.fallen.any() and not state.diverged.any()
    assert len(np.unique(state.physics.motion[:, 0])) == LANES
    hard = np.array([(simulation.reset(float(y)), simulation.read())[1] for y in yaw])
    # Settling, 0.2 s, is a turned replay too: other yaws end some millimetres apart.
    assert_near(state.physics.pose[:, 7:], hard[:, 7:23], 0.05)
    assert_near(symmetry.yaw_of(jnp.asarray(hard[:, 3:7])), yaw, 0.02)


def test_standing_height_is_that_of_a_standing_robot(minitaur: Minitaur) -> None:
    state = minitaur.reset(jax.random.split(jax.random.key(0), LANES), jnp.zeros(LANES))
    for _ in range(100):
        state = minitaur.step(state, jnp.zeros((LANES, 8)))
    assert_near(state.position[:, 2], minitaur.standing_height, 0.01)
    assert not state.fallen.any()


@pytest.mark.parametrize(("lowered", "tilt", "falls"), [(0, 0, 0), (0.1, 0, 1), (0, 0.6, 1)])
def test_falls(minitaur: Minitaur, starts: State, lowered: float, tilt: float, falls: int) -> None:
    rest = rows(
        minitaur.reset(jax.random.split(jax.random.key(0), LANES), jnp.zeros(LANES)).physics
    )
    rest[:, 2] += 1 - lowered if tilt else -lowered
    rest[:, 3:7] = [math.cos(tilt / 2), math.sin(tilt / 2), 0, 0]
    state = minitaur.set_state(from_rows(jnp.asarray(rest)), jnp.zeros(LANES))
    assert not state.fallen.any()  # a start is not judged
    state = minitaur.step(state, jnp.zeros((LANES, 8)))
    assert (np.asarray(state.fallen) == falls).all()


def test_reward_is_that_of_pybullet_envs_a_second(minitaur: Minitaur) -> None:
    task = WalkForward()
    lanes = task.start(minitaur, jax.random.split(jax.random.key(0), LANES))
    for t in range(5):
        lanes, step = advance(task, minitaur, lanes, chosen(t))
    x = parts(rows(step.after.physics).T)
    energy = np.abs((x["torque"] * x["rates"][:8]).sum(0)) * 0.002
    forward = np.asarray(step.after.position - step.before.position)[:, 0]
    assert not step.terminal.any() and energy.max() > 1e-3
    expected = (forward - 0.005 * energy) / 0.01 + minitaur.healthy_reward
    assert_near(step.reward, expected, 1e-4)


def test_processes_are_kept_busy_and_no_more(minitaur: Minitaur) -> None:
    """A robot whose episode is over costs a step, too: who asks for 512 gets 32 a process."""
    tested_scenarios = flatten(scenarios(minitaur, seeds=1, episodes=600))
    queue = Evaluator(
        minitaur, tested_scenarios, EvaluationSettings(), devices.mesh(jax.devices()[:1])
    ).start()
    assert queue.running.episode.shape == (64,)
    assert minitaur.max_parallel_envs(10) == 10


def test_physics_that_is_not_finite_ends_the_lane(minitaur: Minitaur, starts: State) -> None:
    action = chosen().at[5].set(jnp.nan)
    after, whole = minitaur.step(starts, action), minitaur.step(starts, chosen())
    assert np.flatnonzero(after.diverged).tolist() == [5]
    others = np.arange(LANES) != 5
    same(*(jax.tree.map(lambda x: np.asarray(x)[others], s) for s in (after, whole)))
    before = jax.tree.map(lambda x: x[5:6], starts)
    same(jax.tree.map(lambda x: x[5:6], after).replace(diverged=before.diverged), before)


# ── gymnasium ───────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("observed", ["paper17", "native28"])
@pytest.mark.filterwarnings("ignore:.*A Box observation space")
def test_the_env_sees_what_the_robot_sees(starts: State, observed: Any) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    from gymnasium.utils.env_checker import check_env

    from genidm.robots.minitaur_env import MinitaurEnv

    robot, env = Minitaur(observed=observed), MinitaurEnv(observed=observed)
    check_env(env, skip_render_check=True)
    s, _ = env.reset(options={"row": rows(starts.physics)[3]})
    state = robot.set_state(starts.physics, jnp.zeros(LANES))
    assert_near(s, state.observation[3], 1e-5)
    s, reward, fallen, _, _ = env.step(np.asarray(chosen()[3]))
    after = robot.step(state, chosen())
    assert_near(s, after.observation[3], 1e-4)
    forward = after.position[3, 0] - state.position[3, 0]
    assert_near(reward, forward - 0.01 * robot.cost(after, chosen())[3], 1e-6)
    assert fallen == bool(after.fallen[3])
    s, _ = env.reset(options={"yaw": 1.0})
    orientation = parts(env.simulation.read())["orientation"]
    assert_near(symmetry.yaw_of(jnp.asarray(orientation)), 1.0, 0.01)
    env.close()


def test_the_env_in_processes(strict_ranks: None) -> None:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    from genidm.robots.minitaur_env import MinitaurEnv

    one = MinitaurEnv()
    many = gymnasium.vector.AsyncVectorEnv([MinitaurEnv] * 2, context="forkserver")
    s, _ = one.reset()
    seen, _ = many.reset()
    same(seen, np.stack([s, s]))
    action = np.asarray(chosen()[0])
    expected, *_ = one.step(action)
    got, _, _, _, _ = many.step(np.stack([action, -action]))
    same(got[0], expected)
    assert np.abs(got[1] - expected).max() > 1e-3
    many.close()
    one.close()


# ── absence, deaths ─────────────────────────────────────────────────────────────────────────


def test_the_command_that_is_killed_leaves_no_worker_behind(tmp_path: Any) -> None:
    told = (
        "import jax, time; from genidm.robots import Minitaur; r = Minitaur(processes=2);"
        "s = r.reset(jax.random.split(jax.random.key(0), 4), jax.numpy.zeros(4));"
        "s = r.step(s, jax.numpy.zeros((4, 8))); print('stepped', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", told], stdout=subprocess.PIPE, text=True)
    assert process.stdout and process.stdout.readline() == "stepped\n"
    lists = Path(f"/proc/{process.pid}/task").glob("*/children")
    children = [int(pid) for path in lists for pid in path.read_text().split()]
    assert len(children) == 2
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    deadline = time.monotonic() + 10
    while any(alive(pid) for pid in children):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(BadInput, match="paper17 or native28, not 'all'"):
        Minitaur(observed="all")  # type: ignore[arg-type]
    assert by_name("minitaur").observation.size == 17


def test_the_drawing_lies_as_pybullet_has_it(minitaur: Minitaur, starts: State) -> None:
    model = minitaur.visual_model().compile()
    data, live = mujoco.MjData(model), Simulation()
    bullet, body = live.bullet, live.body
    for row, qpos in zip(rows(starts.physics), minitaur.visual_qpos(starts.physics), strict=True):
        live.set_state(row)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for link in live.motors + live.knees:
            name = bullet.getJointInfo(body, link)[12].decode()
            there = bullet.getLinkState(body, link, computeForwardKinematics=1)[4]
            np.testing.assert_allclose(data.body(name).xpos, there, atol=1e-5)
    live.close()


# ── what MinitaurEnv is given, and what becomes of it ───────────────────────────────────


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    from genidm.robots.minitaur_env import MinitaurEnv

    made = MinitaurEnv()
    yield made
    made.close()


@pytest.mark.parametrize(
    "action",
    [
        np.full(8, np.nan), np.r_[np.zeros(7), np.inf], np.zeros(7), np.zeros((1, 8)), 0.0,
        np.zeros(0), [None] * 8, "forwards",
    ],
    ids=str,
)  # fmt: skip
def test_an_action_that_is_none_is_refused_and_changes_nothing(env: Any, action: Any) -> None:
    env.reset()
    before = env.simulation.read()
    with pytest.raises(BadInput, match="an action must be 8 finite numbers"):
        env.step(action)
    same(env.simulation.read(), before)
    s, reward, fallen, _, _ = env.step(np.zeros(8))
    assert np.isfinite(s).all() and math.isfinite(reward) and not fallen


@pytest.mark.parametrize(("number", "at"), [(np.nan, 0), (np.inf, 7), (-np.inf, 40)])
def test_an_episode_ends_where_the_physics_is_lost(
    env: Any, monkeypatch: pytest.MonkeyPatch, number: float, at: int
) -> None:
    start, _ = env.reset()
    read, calls = env.simulation.read, []

    def lost() -> np.ndarray:
        calls.append(0)
        row = np.array(read())
        if len(calls) > 1:  # after the step, not before it
            row[at] = number
        return row

    monkeypatch.setattr(env.simulation, "read", lost)
    s, reward, over, cut, info = env.step(np.zeros(8))
    assert over and not cut and reward == 0.0
    np.testing.assert_array_equal(s, start)  # what was last seen of it
    assert not np.isfinite(info["row"]).all()
    monkeypatch.undo()
    assert np.isfinite(env.reset()[0]).all()
