"""Every engine of the MuJoCo robots against `mj_step`, and what the Engine contract promises."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import bits
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from in_c import step_in_c

from genidm import engines
from genidm.agents.collect import collect
from genidm.agents.ppo import PPO
from genidm.engines import ENGINES, Physics, Stepped
from genidm.engines.mujoco import MuJoCo
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.paper.generalize import Generalize, replay, residual
from genidm.robots import Ant, Humanoid, by_name
from genidm.robots.mujoco import MujocoRobot

LANES = 16
STEPS = 20
KINDS: dict[str, type[Ant] | type[Humanoid]] = {"ant": Ant, "humanoid": Humanoid}


@functools.cache
def made(kind: str, engine: str) -> MujocoRobot:
    """A robot whose engine is compiled: one program for all of this file's steps in float32."""
    robot = KINDS[kind](engine=engine)
    robot.engine.step = jax.jit(robot.engine.step)
    return robot


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module", params=ENGINES)
def robot(kind: str, request: pytest.FixtureRequest) -> MujocoRobot:
    return made(kind, request.param)


@pytest.fixture
def in_c(kind: str) -> MujocoRobot:
    return made(kind, "mujoco")


def as_dtype(tree: Any, dtype: type[np.floating]) -> Any:
    return jax.tree.map(lambda x: np.asarray(x, dtype), tree)


def oracle(robot: MujocoRobot, start: Physics, actions: np.ndarray) -> tuple[Physics, np.ndarray]:
    """Physics after actions `[T, B, A]`, and the wrenches, by `mj_step` in float64."""
    return step_in_c(robot, as_dtype(start, np.float64), actions.astype(np.float64))


@functools.cache
def starts(kind: str) -> Physics:
    """Float32 physics `[B, ...]` in the middle of random episodes, facing all ways."""
    robot, rng = made(kind, "mujoco"), np.random.default_rng(0)
    yaw = jnp.linspace(-3.0, 3.0, LANES)
    fresh = robot.reset(jax.random.split(jax.random.key(0), LANES), yaw).physics
    strength = rng.uniform(0, 0.3, (LANES, 1))  # the weak stay on their feet
    actions = strength * rng.choice([-1.0, 1.0], (25, LANES, robot.action.size))
    return as_dtype(oracle(robot, fresh, actions)[0], np.float32)


def actions_of(robot: MujocoRobot, steps: int, seed: int = 1) -> np.ndarray:
    """Float32 actions `[T, B, A]`."""
    shape = (steps, LANES, robot.action.size)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def walk(robot: MujocoRobot, physics: Physics, actions: np.ndarray) -> Stepped:
    """What the engine makes of actions `[T, B, A]`, after the last of them."""
    for action in actions:
        stepped = robot.engine.step(physics, jnp.asarray(action))
        physics = stepped.physics
    return stepped


def lanes(tree: Any, of: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x)[of], tree)


def apart(got: Any, expected: Any) -> np.ndarray:
    """For each leaf and lane `[n, B]` the greatest difference, as a share of the greatest number.

    Numbers below 1 count as 1.
    """

    def of(x: Any, y: Any) -> np.ndarray:
        x, y = (np.asarray(a, np.float64).reshape(LANES, -1) for a in (x, y))
        return np.abs(x - y).max(1) / np.maximum(1.0, np.abs(y).max(1))

    return np.stack(jax.tree.leaves(jax.tree.map(of, got, expected)))


# ── against mj_step ─────────────────────────────────────────────────────────────────────────


def test_a_step_is_that_of_mj_step(kind: str, robot: MujocoRobot) -> None:
    """Rounding can end a line search elsewhere: then a lane is off by the solver's error."""
    actions = actions_of(robot, 1)
    expected = oracle(robot, starts(kind), actions)
    touching = np.abs(expected[1]).max((1, 2)) > 0
    assert touching.sum() >= LANES // 4  # or the wrenches would be compared with nothing
    error = apart(tuple(walk(robot, starts(kind), actions)), expected)
    assert (np.median(error, axis=1) < 2e-5).all() and error.max() < 1e-2


def test_a_trajectory_is_that_of_mj_step(kind: str, robot: MujocoRobot) -> None:
    """Physics is chaotic: most lanes stay near, and a few may not."""
    actions = 0.5 * actions_of(robot, STEPS)
    error = apart(tuple(walk(robot, starts(kind), actions)), oracle(robot, starts(kind), actions))
    assert (np.median(error, axis=1) < 2e-3).all()
    assert (np.quantile(error, 0.75, axis=1) < 1e-2).all()


def test_wrenches_are_of_the_last_physics_steps_start(kind: str, robot: MujocoRobot) -> None:
    """After `mj_forward` they would be those of its end."""
    actions = actions_of(robot, 1)
    wrenches = walk(robot, starts(kind), actions).readings
    after, expected = oracle(robot, starts(kind), actions)
    data, late = mujoco.MjData(robot.mj_model), []
    for qpos, qvel, warmstart in zip(after.qpos, after.qvel, after.warmstart, strict=True):
        data.qpos, data.qvel, data.qacc_warmstart = qpos, qvel, warmstart
        mujoco.mj_forward(robot.mj_model, data)
        mujoco.mj_rnePostConstraint(robot.mj_model, data)
        late.append(data.cfrc_ext.copy())
    touching = np.abs(expected).max((1, 2)) > 0
    assert np.median(apart(wrenches, expected)[0, touching]) < 1e-4
    assert np.median(apart(np.stack(late), expected)[0, touching]) > 1e-2


def test_float64_rows_are_not_rounded(kind: str, robot: MujocoRobot) -> None:
    """Then MJX and C do the same sums; a line search or two end elsewhere."""
    actions = actions_of(robot, 1)
    after, contact = oracle(robot, starts(kind), actions)
    with jax.enable_x64(True):
        unrounded = KINDS[kind](engine=robot.engine.name).engine
        physics = as_dtype(starts(kind), np.float64)
        got = jax.jit(unrounded.step)(physics, jnp.asarray(actions[0], np.float64))
        assert {x.dtype for x in jax.tree.leaves(got)} == {np.dtype(np.float64)}
        error = apart(tuple(got), (after, contact))
    assert (np.median(error, axis=1) < 1e-10).all() and error.max() < 1e-3


def test_mujoco_in_c_gives_the_bits_of_mj_step(kind: str, in_c: MujocoRobot) -> None:
    """In float64 along a trajectory; in float32 it rounds once a control step."""
    actions = actions_of(in_c, STEPS)
    one = oracle(in_c, starts(kind), actions[:1])
    bits.same(tuple(walk(in_c, starts(kind), actions[:1])), as_dtype(one, np.float32))
    with jax.enable_x64(True):
        start = jax.tree.map(jnp.asarray, as_dtype(starts(kind), np.float64))
        got = walk(in_c, start, actions.astype(np.float64))
        bits.same(tuple(got), oracle(in_c, starts(kind), actions))


# ── the contract ────────────────────────────────────────────────────────────────────────────


def test_a_lost_lane_comes_back_as_nan_alone(
    kind: str, robot: MujocoRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT where it runs
    physics = jax.tree.map(np.copy, starts(kind))
    physics.qpos[3, 0], physics.qvel[5] = np.nan, 1e9
    actions = actions_of(robot, 1)
    got, whole = (walk(robot, start, actions) for start in (physics, starts(kind)))
    lost = np.any([np.isnan(x).reshape(LANES, -1).any(1) for x in jax.tree.leaves(got)], axis=0)
    assert np.flatnonzero(lost).tolist() == [3, 5]
    bits.same(lanes(got, ~lost), lanes(whole, ~lost))
    robots = robot.set_state(physics, jnp.zeros(LANES))
    assert np.array_equal(robot.step(robots, jnp.asarray(actions[0])).diverged, lost)
    assert not list(tmp_path.iterdir())


def test_the_oracle_would_have_left_a_log(
    in_c: MujocoRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    data = mujoco.MjData(in_c.mj_model)
    data.qpos[0] = np.nan
    mujoco.mj_step(in_c.mj_model, data)
    assert [file.name for file in tmp_path.iterdir()] == ["MUJOCO_LOG.TXT"]


def test_a_step_depends_on_its_rows_alone(kind: str, robot: MujocoRobot) -> None:
    a, b = actions_of(robot, 2)
    first = robot.engine.step(starts(kind), a)
    robot.engine.step(lanes(starts(kind), slice(None, None, -1)), b)
    bits.same(robot.engine.step(starts(kind), a), first)


def test_lanes_are_alike(kind: str, robot: MujocoRobot) -> None:
    """A lane's place changes nothing; in XLA up to rounding, as it treats an array's rest apart."""
    order, (action,) = np.random.default_rng(0).permutation(LANES), actions_of(robot, 1)
    got = robot.engine.step(lanes(starts(kind), order), action[order])
    expected = lanes(robot.engine.step(starts(kind), action), order)
    error = apart(tuple(got), tuple(expected))
    assert (np.median(error, axis=1) < 2e-5).all() and error.max() < 1e-2
    if isinstance(robot.engine, MuJoCo):
        assert error.max() == 0


def test_threads_change_no_bit(kind: str, in_c: MujocoRobot) -> None:
    (action,) = actions_of(in_c, 1)
    for threads in (1, 2, 3):
        engine = MuJoCo(in_c.visual_model(), in_c.frame_skip, threads)
        assert engine.threads == threads
        bits.same(engine.step(starts(kind), action), in_c.engine.step(starts(kind), action))


def test_engines_observe_alike(kind: str) -> None:
    """They also agree on who has fallen: lane 0 is high in the air, lane 1 lies on its side."""
    start = jax.tree.map(np.copy, starts(kind))
    start.qpos[:2, 2], start.qpos[1, 3:7] = (3.0, 0.7), np.sqrt([0.5, 0.5, 0, 0])
    (action,) = actions_of(made(kind, "mujoco"), 1)
    c, x = (
        robot.step(robot.set_state(start, jnp.zeros(LANES)), jnp.asarray(action))
        for robot in (made(kind, "mujoco"), made(kind, "mjx"))
    )
    fields = ("observation", "position", "heading")
    error = apart([getattr(x, f) for f in fields], [getattr(c, f) for f in fields])
    assert (np.median(error, axis=1) < 2e-5).all() and error.max() < 1e-2
    assert np.array_equal(c.fallen, x.fallen) and 0 < c.fallen.sum() < LANES
    assert not c.diverged.any() and not x.diverged.any()


# ── 𝒢 ───────────────────────────────────────────────────────────────────────────────────────


def record(robot: MujocoRobot, actions: np.ndarray) -> Experience:
    """The experience of actions `[T, B, A]`, all valid and of one episode."""
    states = [robot.set_state(starts(robot.name), jnp.zeros(LANES))]
    for action in actions:
        states.append(robot.step(states[-1], jnp.asarray(action)))
    before, after = (jax.tree.map(lambda *x: np.stack(x), *s) for s in (states[:-1], states[1:]))
    first = np.zeros(actions.shape[:2], bool)
    first[0] = True
    return Experience(
        s=before.observation, o=before.position, o_next=after.position, a=actions,
        first=first, last=first[::-1], valid=~after.diverged, physics=before.physics,
    )  # fmt: skip


def test_turned_replays_drift_alike() -> None:
    """MuJoCo in C rounds once a control step and MJX in each sum, so C drifts less."""
    median = {}
    for engine in ENGINES:
        robot = made("ant", engine)
        experience = record(robot, actions_of(robot, STEPS))
        settings = Generalize(segment=STEPS, num_envs=LANES)
        turned = replay(robot, experience, jax.random.key(0), settings, quiet=True)
        drift = residual(experience, turned)
        assert drift["step"].tolist() == list(range(1, STEPS + 1))
        median[engine] = drift["median"]
        assert drift["median"][0] < 1e-6 and drift["median"][-1] < 1e-3
    assert median["mujoco"][-1] < median["mjx"][-1]


# ── the choice of an engine ─────────────────────────────────────────────────────────────────


def test_an_engine_is_a_setting_of_a_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Ant(engine="mjx").settings["engine"] == "mjx"
    assert by_name("humanoid", "mjx").settings["engine"] == "mjx"
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert Ant().settings["engine"] == "mujoco"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert engines.choose(None, Ant.engines, "ant") == "mjx"
    assert engines.choose(None, ["bullet"], "minitaur") == "bullet"


def test_an_unknown_engine_is_refused() -> None:
    sentence = "^the ant is stepped by mjx or mujoco, not by 'warp'$"
    with pytest.raises(BadInput, match=sentence):
        engines.choose("warp", Ant.engines, "ant")
    with pytest.raises(BadInput, match=sentence):
        by_name("ant", "warp")


@pytest.mark.parametrize("threads", [2, 3])
def test_a_record_does_not_depend_on_the_threads(threads: int) -> None:
    """Through a whole stage: PPO walks and learns on MuJoCo in C."""
    agent, records = (
        PPO(num_envs=12, unroll_length=8, num_minibatches=2, num_updates_per_batch=1),
        [],
    )
    for count in (1, threads):
        robot = Ant(engine="mujoco")
        assert isinstance(robot.engine, MuJoCo)
        robot.engine.threads = count
        records.append(collect(robot, agent, 3 * 12 * 8, quiet=True)[0])
    bits.same(*records)
