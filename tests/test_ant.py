"""The Ant against MuJoCo in C on the same model, and its resets, falls and fresh starts."""

from __future__ import annotations

import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from in_c import assert_close, assert_commutes, placed, positive_w, step_in_c
from one_step import advance
from scipy.spatial.transform import Rotation

from genidm import controller, symmetry
from genidm.controller import Controller
from genidm.engines import Physics
from genidm.errors import BadInput
from genidm.paper.idm import Architecture
from genidm.paper.pairs import Pairs, with_nearest_side
from genidm.robots import Ant, State
from genidm.robots.humanoid import Humanoid
from genidm.robots.mujoco import REFLECTION, image_of
from genidm.tasks import EnvState, Transition, View, WalkForward

LANES = 32


# ── MuJoCo in C ─────────────────────────────────────────────────────────────────────────────


def observed_in_c(physics: Physics, contact: np.ndarray) -> np.ndarray:
    """s `[B, 111]` as A.1.1 and the class's docstring put it, number by number."""
    rows = []
    for qpos, qvel, wrenches in zip(physics.qpos, physics.qvel, contact, strict=True):
        quaternion = qpos[3:7] if qpos[3] >= 0 else -qpos[3:7]
        clipped = wrenches.copy()
        for part in clipped.reshape(-1, 3):
            part[:2] /= max(1.0, np.hypot(part[0], part[1]))
            part[2] = np.clip(part[2], -1, 1)
        rows.append(np.concatenate([qpos[2:3], quaternion, qpos[7:], qvel, clipped.ravel()]))
    return np.stack(rows)


@pytest.fixture(scope="module")
def starts(ant: Ant) -> Physics:
    """Physics `[B, ...]` in the middle of random episodes: standing, hopping, sliding."""
    rng = np.random.default_rng(0)
    qpos = np.tile(ant.rest_pose().astype(float), (LANES, 1))
    qpos += rng.uniform(-0.1, 0.1, qpos.shape)
    nv = ant.mj_model.nv
    physics = Physics(qpos, 0.1 * rng.normal(size=(LANES, nv)), np.zeros((LANES, nv)))
    strength = rng.uniform(0, 0.3, (LANES, 1))  # the weak stay on their feet
    physics, _ = step_in_c(ant, physics, strength * rng.choice([-1.0, 1.0], (20, LANES, 8)))
    # Numbers that float32 holds too: what differs later is the stepping alone.
    return jax.tree.map(lambda x: x.astype(np.float32).astype(float), positive_w(physics))


@pytest.fixture(scope="module")
def robot(ant: Ant) -> Ant:
    """The Ant with compiled functions: one program for all of this file's steps."""
    robot = copy.copy(ant)
    robot.step, robot.reset = jax.jit(ant.step), jax.jit(ant.reset)
    return robot


# ── (a) against C ───────────────────────────────────────────────────────────────────────────


def test_state_is_read_as_in_c(robot: Ant, starts: Physics) -> None:
    state = placed(robot, starts)
    expected = observed_in_c(starts, np.zeros((LANES, robot.mj_model.nbody, 6)))
    assert_close(state.observation, expected, atol=1e-6)
    assert_close(state.position, starts.qpos[:, :3], atol=0)
    body = Rotation.from_quat(starts.qpos[:, 3:7], scalar_first=True)
    assert_close(state.heading, body.as_euler("ZYX")[:, 0], atol=1e-5)


@pytest.fixture(scope="module")
def one_step(ant: Ant, starts: Physics) -> tuple[Any, ...]:
    """A control step in C from `starts`: actions `[B, A]`, physics after it, wrenches."""
    actions = np.random.default_rng(1).uniform(-1, 1, (LANES, 8)).astype(np.float32)
    after, contact = step_in_c(ant, starts, actions[None])
    touching = np.abs(contact).max((1, 2)) > 0
    assert touching.sum() >= LANES // 4  # or the wrenches would be compared with nothing
    assert not contact[:, 0].any()  # MuJoCo gives the world body none
    return actions, positive_w(after), contact


def test_next_state_is_that_of_c(starts: Physics, one_step: tuple[Any, ...]) -> None:
    """In float64 MJX and C do the same sums; a line search or two end elsewhere."""
    actions, after, contact = one_step
    with jax.enable_x64(True):
        robot = Ant()
        state = jax.jit(robot.step)(robot.set_state(starts, jnp.zeros(LANES)), jnp.asarray(actions))
        assert state.physics.qpos.dtype == jnp.float64
        got, observation = positive_w(state.physics), np.asarray(state.observation)
    expected = observed_in_c(after, contact)
    assert_close(got.qpos, after.qpos, atol=1e-5)
    assert_close(got.qvel, after.qvel, atol=1e-3)
    assert_close(observation, expected, atol=1e-3)
    assert np.median(np.abs(observation - expected).max(-1)) < 1e-10
    assert np.median(np.abs(got.warmstart - after.warmstart)) < 1e-10


def test_next_state_is_that_of_c_in_float32(
    robot: Ant, starts: Physics, one_step: tuple[Any, ...]
) -> None:
    """As it is run: where rounding ends a line search elsewhere, the solver's error shows.

    C at 4 iterations is as far from C at 100 (docs/physics.md).
    """
    actions, after, contact = one_step
    state = robot.step(placed(robot, starts), jnp.asarray(actions))
    assert not state.diverged.any()
    got, expected = positive_w(state.physics), observed_in_c(after, contact)
    assert_close(got.qpos, after.qpos, atol=1e-3)
    assert_close(got.qvel, after.qvel, atol=0.05)
    assert_close(state.observation, expected, atol=0.05)
    error = np.abs(np.asarray(state.observation) - expected).max(-1)
    assert np.median(error) < 5e-5 and np.mean(error < 1e-3) > 0.75
    assert np.array_equal(state.fallen, (after.qpos[:, 2] < 0.2) | (after.qpos[:, 2] > 1.0))


# ── (b) yaw and mirror against C ────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def episode(starts: Physics, ant: Ant) -> tuple[Any, ...]:
    """20 control steps from `starts`: actions, physics after them, wrenches."""
    # Weak enough to keep feet on the floor.
    actions = np.random.default_rng(2).uniform(-0.25, 0.25, (20, LANES, 8))
    after, contact = step_in_c(ant, starts, actions)
    assert (np.abs(contact).max((1, 2)) > 0).sum() >= LANES // 4
    return actions, after, contact


def test_yaw_commutes_with_physics(ant: Ant, starts: Physics, episode: tuple[Any, ...]) -> None:
    yaw = np.linspace(-np.pi, np.pi, LANES)
    assert_commutes(ant, observed_in_c, starts, episode, lambda layout, x: layout.rotate(x, yaw))


def test_mirror_commutes_with_physics(ant: Ant, starts: Physics, episode: tuple[Any, ...]) -> None:
    assert_commutes(ant, observed_in_c, starts, episode, lambda layout, x: layout.mirror(x))


def test_quarter_turn_of_the_body_commutes_with_physics(
    ant: Ant, starts: Physics, episode: tuple[Any, ...]
) -> None:
    assert_commutes(ant, observed_in_c, starts, episode, lambda layout, x: layout.turn_body(x))


def test_a_policy_sees_the_nearest_side_as_front(ant: Ant) -> None:
    """Robots that differ by quarter turns of the body look the same, and act the same."""
    states = ant.reset(jnp.repeat(keys(5)[:1], 4), jnp.full(4, 0.2))
    bodies = [states.physics]
    for _ in range(3):
        bodies.append(ant.turn_body_physics(bodies[-1]))
    physics = jax.tree.map(lambda *x: jnp.stack([y[n] for n, y in enumerate(x)]), *bodies)
    robots = ant.set_state(physics, jnp.zeros(4))
    view = View(jnp.full(4, 0.5), nearest_side=True)
    seen = view.state(ant, robots)
    assert_close(seen, np.broadcast_to(seen[0], seen.shape), atol=1e-5)
    assert_close(seen[0], ant.observation.rotate(robots.observation[:1], -0.5)[0], atol=1e-5)
    a = jnp.linspace(-1, 1, 8)
    acted = view.robot_action(ant, robots, jnp.broadcast_to(a, (4, 8)))
    for n in range(4):
        turned = acted[n]
        for _ in range((4 - n) % 4):
            turned = ant.action.turn_body(turned)
        assert_close(turned, a, atol=1e-6)
    assert_close(view.seen_action(ant, robots, acted), np.broadcast_to(a, (4, 8)), atol=1e-6)


def test_samples_face_their_direction_by_their_nearest_side(ant: Ant) -> None:
    """A controller of such samples turns back what it answers, for any robot and goal."""
    yaw = jnp.linspace(-3, 3, LANES)
    s = np.asarray(ant.reset(keys(6), yaw).observation)
    rng = np.random.default_rng(0)
    d = np.float32(controller.direction(jnp.asarray(rng.normal(size=(2, LANES, 3)))))
    samples = Pairs(np.stack([s, s]), np.stack([d[0], d[0]]), rng.uniform(-1, 1, (LANES, 8)))
    turned = with_nearest_side(ant, samples)
    off = controller.relative_bearing(ant, turned.s[0], turned.d[0])
    assert np.abs(off).max() < np.pi / 4 + 1e-3
    before = controller.relative_bearing(ant, s, d[0])
    quarters = np.asarray(symmetry.quarters_to(before, jnp.zeros(LANES)))
    assert len(set(quarters.tolist())) >= 4
    assert_close(turned.a, ant.action.turn_body_by(samples.a, quarters), atol=1e-6)
    assert_close(turned.s[1], ant.observation.turn_body_by(s, quarters), atol=1e-5)

    architecture = Architecture(8, (16,), (16,), None)
    params = architecture.init(jax.random.key(0), ant.observation.size)
    size = ant.observation.size
    plain = Controller(params, jnp.zeros(size), jnp.ones(size), architecture, "heading", ant)
    sided = plain.replace(nearest_side=True)
    answer = ant.action.turn_body_by(plain(turned.s[0], d[0]), -quarters)
    assert_close(sided(s, d[0]), answer, atol=1e-4)
    assert np.abs(sided(s, d[0]) - plain(s, d[0])).max() > 0.1


def test_only_a_body_with_four_sides_has_a_nearest_one() -> None:
    with pytest.raises(BadInput, match="four equal sides, not the humanoid"):
        WalkForward(nearest_side=True).start(Humanoid(engine="mujoco"), keys(0))


def test_quarter_turn_is_read_off_the_model(ant: Ant) -> None:
    """Each leg becomes the next; the ankles' axes differ, so that two of them turn their sign."""
    assert ant.quarter_turn is not None
    assert ant.quarter_turn.hinges == [2, 3, 4, 5, 6, 7, 0, 1]
    assert ant.quarter_turn.signs == [1, -1, 1, 1, 1, -1, 1, 1]
    assert Humanoid(engine="mujoco").quarter_turn is None
    assert not Humanoid(engine="mujoco").can_turn_body


def test_mirror_is_read_off_the_model(ant: Ant) -> None:
    """Legs 1↔4 and 2↔3: hips turn their sign, ankles (whose axes differ) keep it."""
    assert ant.mirror.hinges == [6, 7, 4, 5, 2, 3, 0, 1]
    assert ant.mirror.signs == [-1.0, 1.0] * 4
    assert ant.mirror.actuators == [2, 3, 0, 1, 6, 7, 4, 5]  # the file begins with leg 4
    assert ant.mirror.bodies == [0, 1, *range(11, 14), *range(8, 11), *range(5, 8), *range(2, 5)]


def test_a_lopsided_model_is_refused() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(pos=[0, 1, 1])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    with pytest.raises(ValueError, match="its own image"):
        image_of(spec.compile(), REFLECTION)


# ── (c) resets, placing, divergence, actions ────────────────────────────────────────────────


def keys(seed: int) -> jax.Array:
    return jax.random.split(jax.random.key(seed), LANES)


def distances(qpos: jax.Array) -> np.ndarray:
    """Distance between every two lanes, `[n]`, without a lane's own."""
    x = np.asarray(qpos)
    apart = np.linalg.norm(x[:, None] - x[None], axis=-1)
    return apart[~np.eye(len(x), dtype=bool)]


def test_every_reset_is_fresh_and_healthy(robot: Ant) -> None:
    state, again, other = (robot.reset(keys(s), jnp.zeros(LANES)) for s in (0, 0, 1))
    assert distances(state.physics.qpos).min() > 0.01
    assert distances(state.physics.qvel).min() > 0.01
    assert_close(state, again, atol=0)
    assert (np.abs(state.physics.qpos - other.physics.qpos).max(-1) > 0.01).all()
    height = state.position[:, 2]
    assert (height > 0.2).all() and (height < 1.0).all()
    assert not state.fallen.any() and not state.diverged.any()
    assert_close(np.linalg.norm(state.physics.qpos[:, 3:7], axis=-1), 1.0, atol=1e-6)
    assert np.abs(state.physics.qpos[:, :3] - robot.rest_pose()[:3]).max() <= 0.1 + 1e-6


def test_a_reset_costs_no_physics(ant: Ant) -> None:
    """No loop is in it, so no step and no solver."""
    program = str(jax.make_jaxpr(ant.reset)(keys(0), jnp.zeros(LANES)))
    assert "while[" not in program and "scan[" not in program


def test_resets_are_turned(robot: Ant) -> None:
    yaw = jnp.linspace(-3.0, 3.0, LANES)
    straight, turned = robot.reset(keys(0), jnp.zeros(LANES)), robot.reset(keys(0), yaw)
    assert_close(turned.observation, robot.observation.rotate(straight.observation, yaw), atol=1e-6)
    assert_close(turned.position, symmetry.rotate_vector(straight.position, yaw), atol=1e-6)
    assert_close(symmetry.wrap(turned.heading - straight.heading - yaw), 0.0, atol=1e-5)


def test_placing_turns_the_record(robot: Ant, starts: Physics) -> None:
    yaw, record = jnp.linspace(-3.0, 3.0, LANES), placed(robot, starts)
    state = robot.set_state(record.physics, yaw)
    assert_close(state.physics, robot.rotate_physics(record.physics, yaw), atol=0)
    assert_close(state.observation, robot.observation.rotate(record.observation, yaw), atol=1e-6)
    assert_close(state.position, symmetry.rotate_vector(record.position, yaw), atol=1e-6)
    assert not state.fallen.any() and not state.diverged.any()


def actions_of(seed: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(seed), (LANES, 8), minval=-1.0)


def broken(state: State) -> State:
    """Lanes 3 and 5 with velocities that leave float32 within the step."""
    physics = state.physics
    qvel = physics.qvel.at[3].set(1e30).at[5, 7].set(-3e38)
    return state.replace(physics=physics.replace(qvel=qvel))


def assert_finite(tree: Any) -> None:
    for x in jax.tree.leaves(tree):
        if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            assert np.isfinite(x).all()


def test_diverged_physics_ends_its_lane_alone(robot: Ant, starts: Physics) -> None:
    state = placed(robot, starts)
    action = actions_of(0).at[7, 2].set(jnp.nan)  # a third way to go wrong
    after, sound = robot.step(broken(state), action), robot.step(state, actions_of(0))
    assert np.flatnonzero(after.diverged).tolist() == [3, 5, 7]
    assert_finite(after)
    assert_close(after.observation[7], state.observation[7], atol=0)
    others = np.delete(np.arange(LANES), [3, 5, 7])
    assert_close(*(jax.tree.map(lambda x: x[others], s) for s in (after, sound)), atol=0)


def test_actions_are_clipped(robot: Ant, starts: Physics) -> None:
    state, action = placed(robot, starts), jnp.sign(actions_of(0))
    assert_close(robot.step(state, 7.5 * action), robot.step(state, action), atol=0)


# ── (d) layouts ─────────────────────────────────────────────────────────────────────────────


def test_layouts_have_the_papers_sizes(ant: Ant) -> None:
    assert ant.observation.size == 111
    assert jax.tree.map(lambda layout: layout.size, ant.physics) == Physics(15, 14, 14)
    assert ant.action.size == 8
    assert ant.dt == pytest.approx(ant.frame_skip * ant.mj_model.opt.timestep)


def test_layouts_describe_themselves(ant: Ant) -> None:
    assert ant.observation.describe().splitlines()[2:] == [
        "| 0–0 | height | m | invariant |",
        "| 1–4 | orientation | 1 | quaternion |",
        "| 5–12 | joint angles | rad | joints |",
        "| 13–15 | velocity | m/s | vector |",
        "| 16–18 | spin | rad/s | pseudovector in the body frame |",
        "| 19–26 | joint velocities | rad/s | joints |",
        "| 27–110 | contact | N·m, N | wrenches |",
    ]


def test_numbers_stand_where_gymnasium_has_them(
    ant: Ant, starts: Physics, episode: tuple[Any, ...]
) -> None:
    """Ant-v5's 105 are our 111 without the six of the world body."""
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    pytest.importorskip("gymnasium.envs.mujoco", reason="gymnasium is without MuJoCo")
    env = gymnasium.make("Ant-v5").unwrapped
    _, after, contact = episode
    after = positive_w(after)
    for qpos, qvel, felt, s in zip(
        after.qpos, after.qvel, contact, observed_in_c(after, contact), strict=True
    ):
        env.set_state(qpos, qvel)
        env.data.cfrc_ext[:] = felt
        theirs = env._get_obs()
        assert_close(s[:27], theirs[:27], atol=1e-12)
        # Theirs is clipped along the world's axes, ours by length: alike where neither is.
        free = np.repeat(np.hypot(*felt.reshape(-1, 3)[:, :2].T) <= 1, 3)[6:]
        assert_close(s[33:][free], theirs[27:][free], atol=1e-12)
        assert (np.sign(s[33:]) == np.sign(theirs[27:])).all()


# ── (e) fresh starts inside a task ──────────────────────────────────────────────────────────


def walk(
    robot: Ant, task: WalkForward, lanes: EnvState, steps: int
) -> tuple[EnvState, list[Transition]]:
    made = []
    for t in range(steps):
        lanes, step = advance(task, robot, lanes, actions_of(t))
        made.append(step)
    return lanes, made


def test_lanes_that_end_start_afresh(robot: Ant) -> None:
    task = WalkForward(episode_steps=2, start_yaw=1.0)
    lanes, steps = walk(robot, task, task.start(robot, keys(0)), 5)
    down = np.stack([s.terminal for s in steps])
    assert not down.any()  # two steps are too few to fall
    for t, step in enumerate(steps):
        assert (step.first == (t % 2 == 0)).all()
        assert (step.last == (t % 2 == 1)).all()
    assert (lanes.episode_step == 1).all()
    starts = jnp.concatenate([steps[t].before.physics.qpos for t in (0, 2, 4)])
    assert distances(starts).min() > 0.01  # other lanes' and other episodes'
    assert np.std(np.concatenate([steps[t].before.heading for t in (0, 2, 4)])) > 0.3
    # Inside an episode a step begins where the last one ended.
    assert_close(steps[3].before, steps[2].after, atol=0)


def test_falls_and_divergence_end_an_episode(robot: Ant) -> None:
    task = WalkForward(episode_steps=1000)
    lanes = task.start(robot, keys(0)).replace(episode_step=jnp.full(LANES, 7, jnp.int32))
    robots = broken(lanes.robots)
    high = robots.physics.qpos.at[9, 2].set(5.0)
    robots = robots.replace(physics=robots.physics.replace(qpos=high))
    after, step = advance(task, robot, lanes.replace(robots=robots), actions_of(0))
    ended = [3, 5, 9]
    assert np.flatnonzero(step.terminal).tolist() == ended
    assert np.flatnonzero(step.last).tolist() == ended
    assert not step.first.any()
    assert np.array_equal(after.episode_step, np.where(step.last, 0, 8))
    assert_finite((after, step.reward, step.after))
    assert np.abs(step.reward).max() < 1e3
    fresh = after.robots.physics.qpos[jnp.array(ended)]
    assert distances(fresh).min() > 0.01
    assert (jnp.abs(fresh[:, 2] - robot.rest_pose()[2]) <= 0.1 + 1e-6).all()
    assert not after.robots.fallen.any() and not after.robots.diverged.any()
    alive = np.delete(np.arange(LANES), ended)
    assert_close(*(x.observation[alive] for x in (after.robots, step.after)), atol=0)


def test_reward_is_the_papers(robot: Ant) -> None:
    """Forward velocity + 1 alive − 0.5 |a|² − 5e-4 |clipped wrenches|²."""
    task = WalkForward()
    _, (*_, step) = walk(robot, task, task.start(robot, keys(0)), 6)
    before, after, a = (
        np.asarray(x) for x in (step.before.position, step.after.position, step.action)
    )
    contact = np.asarray(step.after.observation)[:, 27:]
    assert np.abs(contact).max() > 0
    forward = (after[:, 0] - before[:, 0]) / 0.05
    expected = forward + ~np.asarray(step.terminal) - 0.5 * (a**2).sum(-1)
    assert_close(step.reward, expected - 5e-4 * (contact**2).sum(-1), atol=1e-4)
