"""𝒢 and the pairs it gives, on a point whose turned replay is exact, and once on the Ant."""

from __future__ import annotations

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point

from genidm import devices, experience, symmetry
from genidm.agents.collect import collect
from genidm.agents.random import RandomActions
from genidm.controller import in_frame
from genidm.errors import BadInput
from genidm.experience import Experience, goal_step
from genidm.paper.generalize import Generalize, generalize, replay, residual
from genidm.paper.pairs import pairs, with_reflection
from genidm.paper.replaying import RotatedReplay
from genidm.robots import Ant
from genidm.tasks import WalkForward

KEY = jax.random.key(3)
H = 7  # steps of a segment; the record's 30 are no multiple
MODES = ("segments", "episodes", "rotate")
ROBOT = Point(speed=2.0, falls_at=0.25)
STEP, PLACE = jax.jit(ROBOT.step), jax.jit(ROBOT.set_state)


@functools.cache
def record(robot: Point = ROBOT) -> Experience:
    """30 steps of 5 lanes that walk at random; episodes end by falls and after 13 steps."""
    agent = RandomActions(num_envs=6, unroll_length=10)
    out, _ = collect(robot, agent, 180, seed=1, task=WalkForward(13), quiet=True)
    return jax.tree.map(lambda x: x[:, :5], out)


@functools.cache
def turned(mode: str, robot: Point = ROBOT, copies: int = 1) -> RotatedReplay:
    return replay(robot, record(robot), KEY, Generalize(mode, H, copies, num_envs=9), quiet=True)


def close(a, b, atol: float = 1e-5) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=atol)


# ── the robot ───────────────────────────────────────────────────────────────────────────


def states(count: int = 9):
    keys = jax.random.split(jax.random.key(0), count)
    return jax.jit(ROBOT.reset)(keys, jnp.linspace(-3.0, 3.0, count))


def actions(count: int = 9) -> jax.Array:
    return jax.random.uniform(jax.random.key(1), (count, 3), minval=-1.0)


def test_a_turned_or_mirrored_point_goes_the_turned_or_mirrored_way() -> None:
    before, a, yaw = states(), actions(), jnp.linspace(-3.0, 2.0, 9)
    after = STEP(before, a)
    turn = STEP(PLACE(before.physics, yaw), a)
    close(turn.position, symmetry.rotate_vector(after.position, yaw))
    close(turn.observation, ROBOT.observation.rotate(after.observation, yaw))
    close(symmetry.wrap(turn.heading - after.heading - yaw), 0)
    across = PLACE(ROBOT.mirror_physics(before.physics), 0 * yaw)
    across = STEP(across, ROBOT.action.mirror(a))
    close(across.position, after.position * np.asarray([[1, -1, 1]]))
    close(across.observation, ROBOT.observation.mirror(after.observation))
    assert np.abs(after.position - before.position).max() > 0.05


# ── the record ──────────────────────────────────────────────────────────────────────────


def test_the_record_has_what_these_tests_need() -> None:
    r = record()
    ends = np.asarray(r.last).sum(0)
    assert r.first.shape == (30, 5) and (ends >= 2).all() and len(set(ends)) > 1
    assert not r.last[-1].all()  # an episode that the record's end cuts off


@pytest.mark.parametrize("goal_horizon", [1, 2, 9, 100])
def test_the_goal_is_ahead_in_the_same_episode(goal_horizon: int) -> None:
    last = np.asarray(record().last)
    expected, there = np.zeros(last.shape, int), np.zeros(last.shape, bool)
    for t, lane in np.ndindex(last.shape):
        goal = t
        while goal < t + goal_horizon - 1 and not last[goal, lane] and goal < len(last) - 1:
            goal += 1
        expected[t, lane], there[t, lane] = goal, goal == t + goal_horizon - 1
    goals, exist = goal_step(jnp.asarray(last), goal_horizon)
    np.testing.assert_array_equal(goals, expected)
    np.testing.assert_array_equal(exist, there)


def test_what_ends_before_the_goal_horizon_is_left_out() -> None:
    r = record()
    _, exist = goal_step(jnp.asarray(r.last), 4)
    assert 0 < np.asarray(exist).sum() < r.interactions
    samples = pairs(ROBOT, r, goal_horizon=4)
    close(samples.a, np.asarray(r.a)[np.asarray(exist)])
    with pytest.raises(BadInput, match="no episode lasts goal_horizon = 100 steps"):
        pairs(ROBOT, r, goal_horizon=100)


def test_a_step_that_is_not_valid_is_no_goal_of_others() -> None:
    r, goal_horizon = record(), 3
    valid = np.ones((30, 5), bool)
    valid[[4, 11, 20], [0, 1, 3]] = False
    goal, exist = map(np.asarray, goal_step(jnp.asarray(r.last), goal_horizon))
    kept = exist & valid & np.take_along_axis(valid, goal, axis=0)
    assert kept.sum() < (exist & valid).sum()
    samples = pairs(ROBOT, r.replace(valid=valid), goal_horizon=goal_horizon)
    np.testing.assert_array_equal(samples.a, np.asarray(r.a)[kept])


@pytest.mark.parametrize("goal_horizon", [1, 4, 9])
@pytest.mark.parametrize("mode", MODES)
def test_directions_point_to_the_goal_in_every_view(mode: str, goal_horizon: int) -> None:
    r, g = record(), turned(mode)
    samples = pairs(ROBOT, r, g, goal_horizon=goal_horizon)
    goal, exist = map(np.asarray, goal_step(jnp.asarray(r.last), goal_horizon))
    expected = np.zeros((2, *r.first.shape, 3))
    for t, lane in np.ndindex(r.first.shape):
        end, yaw = r.o_next[goal[t, lane], lane], g.yaw[0, t, lane]
        ways = end - r.o[t, lane], np.asarray(symmetry.rotate_vector(end, yaw)) - g.o[0, t, lane]
        expected[:, t, lane] = [way / np.linalg.norm(way) for way in ways]
    close(samples.d, expected[:, exist], atol=1e-4)


def test_at_goal_horizon_1_the_goal_of_a_copy_is_its_own_next_position() -> None:
    r, g = record(), turned("segments")
    moved = g.replace(o_next=g.o_next + np.float32([0, 0, 1]))
    way = moved.o_next - moved.o
    samples = pairs(ROBOT, r, moved, goal_horizon=1)
    close(samples.d[1], (way / np.linalg.norm(way, axis=-1, keepdims=True)).reshape(-1, 3))


# ── 𝒢 ───────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("mode", MODES)
def test_where_physics_is_exact_so_is_the_replay(mode: str) -> None:
    r, g = record(), turned(mode)
    off = residual(r, g)
    longest = {"segments": H, "episodes": 13, "rotate": 1}[mode]
    assert off["step"].tolist() == list(range(1, longest + 1))
    assert off["p90"].max() < 1e-5
    close(g.s[0], ROBOT.observation.rotate(jnp.asarray(r.s), jnp.asarray(g.yaw[0])))
    close(g.o[0], symmetry.rotate_vector(jnp.asarray(r.o), jnp.asarray(g.yaw[0])))
    assert np.asarray(g.valid).all()


def test_the_residual_tells_of_a_robot_that_is_not_equivalent() -> None:
    robot = Point(speed=2.0, falls_at=0.25, frame="world")
    off = residual(record(robot), turned("segments", robot))
    assert off["median"][0] > 0.01 and off["median"][-1] > 1.5 * off["median"][0]
    assert (off["p90"] > off["median"]).all()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("goal_horizon", [1, 6])
def test_the_views_of_a_sample_are_one_sample_turned(mode: str, goal_horizon: int) -> None:
    samples = pairs(ROBOT, record(), turned(mode), goal_horizon=goal_horizon)
    s, d = in_frame(ROBOT, "heading", jnp.asarray(samples.s), jnp.asarray(samples.d))
    close(s[0], s[1], atol=1e-4)
    close(d[0], d[1], atol=1e-4)
    assert np.abs(samples.d[0] - samples.d[1]).max() > 1
    _, exist = goal_step(jnp.asarray(record().last), goal_horizon)
    np.testing.assert_array_equal(samples.a, record().a[np.asarray(exist)])


def test_a_segment_lies_in_one_episode_and_has_one_yaw() -> None:
    r, g = record(), turned("segments")
    time = np.arange(30)[:, None]
    begun = np.maximum.accumulate(np.where(r.first, time, 0))
    np.testing.assert_array_equal(g.start, np.maximum(begun, time // H * H))
    one_piece = g.start[1:] == g.start[:-1]
    np.testing.assert_array_equal(g.yaw[0, 1:] == g.yaw[0, :-1], one_piece)
    assert len(np.unique(g.yaw)) == (~one_piece).sum() + 5


def test_a_whole_episode_has_one_yaw() -> None:
    r, g = record(), turned("episodes")
    np.testing.assert_array_equal(g.yaw[0, 1:] != g.yaw[0, :-1], r.first[1:])


def test_every_copy_is_turned_by_yaws_of_its_own() -> None:
    g = turned("segments", copies=3)
    assert g.yaw.shape == (3, 30, 5) and len(np.unique(g.yaw[:, 0])) == 15
    assert np.abs(g.yaw).max() <= np.pi and g.yaw.min() < -2 and g.yaw.max() > 2
    samples = pairs(ROBOT, record(), g, goal_horizon=1)
    assert samples.s.shape == (4, 150, 10) and samples.d.shape == (4, 150, 3)
    assert residual(record(), g)["p90"].max() < 1e-5


@pytest.mark.parametrize(("mode", "segment"), [("segments", H), ("episodes", 11)])
@pytest.mark.parametrize(("lanes", "cores"), [(512, 2), (4, 1)])
def test_the_replay_does_not_depend_on_blocks_or_devices(
    mode: str, segment: int, lanes: int, cores: int
) -> None:
    mesh = devices.mesh(jax.devices()[:cores])
    settings = Generalize(mode, segment, num_envs=lanes)
    other, this = replay(ROBOT, record(), KEY, settings, mesh=mesh, quiet=True), turned(mode)
    np.testing.assert_array_equal(other.yaw, this.yaw)
    jax.tree.map(functools.partial(close, atol=1e-6), other, this)


def test_another_key_gives_other_yaws() -> None:
    other = replay(ROBOT, record(), jax.random.key(4), Generalize("rotate"), quiet=True)
    assert not np.isin(other.yaw, turned("rotate").yaw).any()


def test_exact_turns_are_by_any_yaw() -> None:
    yaw = np.asarray(turned("rotate", copies=3).yaw).ravel()
    counts = np.histogram(yaw, 6, (-np.pi, np.pi))[0]
    assert counts.sum() == 450 and abs(counts - 75).max() < 4 * np.sqrt(75)


def test_generalize_is_replay_and_pairs_and_residual_in_one() -> None:
    settings = Generalize("rotate", copies=2)
    samples, off = generalize(ROBOT, record(), KEY, settings, goal_horizon=5, mirror=True)
    expected = pairs(ROBOT, record(), turned("rotate", copies=2), goal_horizon=5, mirror=True)
    jax.tree.map(np.testing.assert_array_equal, samples, expected)
    assert off["step"].tolist() == [1]


# ── what is left out, and what is added ─────────────────────────────────────────────────


def test_samples_of_diverged_physics_are_dropped() -> None:
    robot = Point(speed=2.0, diverges_at=0.3)
    r, g = record(robot), turned("episodes", robot)
    lost = np.asarray(~r.valid)
    assert lost.any() and np.asarray(r.last)[lost].all()
    for x in jax.tree.leaves((r, g)):
        assert np.isfinite(x).all()
    samples = pairs(robot, r, g, goal_horizon=1)
    kept = np.asarray(r.valid & g.valid[0])
    assert kept.sum() == samples.a.shape[0] < r.interactions
    np.testing.assert_array_equal(samples.a, r.a[kept])
    assert residual(r, g)["p90"].max() < 1e-5


def test_a_replay_that_diverges_is_followed_no_further() -> None:
    """From there on its samples are dropped, and goals beyond are the record's own, turned."""
    robot = Point(speed=2.0, falls_at=0.25, diverges_at=0.2)
    r = record()  # of a point that does not diverge
    g = replay(robot, r, KEY, Generalize("episodes", H), quiet=True)
    whole = turned("episodes")
    lost = np.asarray(~g.valid[0])
    onward = ~np.asarray(r.first[1:])
    assert lost.any() and (lost[1:] >= lost[:-1])[onward].all()
    samples, exact = (pairs(ROBOT, r, x, goal_horizon=5) for x in (g, whole))
    exist = np.asarray(goal_step(jnp.asarray(r.last), 5)[1])
    close(samples.d[1], exact.d[1][~lost[exist]], atol=1e-4)
    assert samples.a.shape[0] == (exist & ~lost).sum()


def test_a_sample_without_a_direction_is_dropped_and_none_at_all_is_refused() -> None:
    r = record()
    still = r.replace(o_next=np.where(np.arange(30)[:, None, None] < 2, r.o, r.o_next))
    assert pairs(ROBOT, still, goal_horizon=1).a.shape[0] == 28 * 5
    with pytest.raises(BadInput, match="no sample"):
        pairs(ROBOT, r.replace(o_next=r.o), goal_horizon=1)
    with pytest.raises(BadInput, match="no step is valid"):
        pairs(ROBOT, r.replace(valid=np.zeros((30, 5), bool)), goal_horizon=1)


def test_a_replay_that_is_lost_whole_has_no_residual() -> None:
    g = turned("segments")
    off = residual(record(), g.replace(valid=np.zeros_like(g.valid)))
    assert [x.size for x in off.values()] == [0, 0, 0]


def test_mirrored_samples_are_samples_of_the_mirrored_robot() -> None:
    r = record()
    samples = pairs(ROBOT, r, turned("segments"), goal_horizon=1, mirror=True)
    assert samples.s.shape == (2, 300, 10) and samples.a.shape == (300, 3)
    a, across = np.split(samples.a, 2)
    np.testing.assert_array_equal(across, a * [1, -1, -1])
    # The mirrored robot, told the mirrored action, goes the mirrored way.
    flat = jax.tree.map(lambda x: x.reshape(150, *x.shape[2:]), r.physics)
    before = PLACE(jax.jit(ROBOT.mirror_physics)(flat), jnp.zeros(150))
    way = STEP(before, jnp.asarray(across)).position - before.position
    close(samples.d[0, 150:], way / np.linalg.norm(way, axis=-1, keepdims=True), atol=1e-4)
    s = np.asarray(samples.s[:, 150:])
    np.testing.assert_array_equal(s[..., 8:], samples.s[:, :150, [9, 8]])
    back = with_reflection(ROBOT, jax.tree.map(lambda x: x, samples))
    np.testing.assert_array_equal(back.s[:, 450:], samples.s[:, :150])


# ── records that cannot be used ─────────────────────────────────────────────────────────


@pytest.mark.parametrize("mode", ["segments", "episodes"])
def test_a_log_without_physics_can_be_turned_but_not_replayed(tmp_path: Path, mode: str) -> None:
    record().replace(physics=None).save(tmp_path / "log")
    log = experience.load(tmp_path / "log", ROBOT)
    with pytest.raises(BadInput, match='use mode "rotate"'):
        replay(ROBOT, log, KEY, Generalize(mode))
    rotated = replay(ROBOT, log, KEY, Generalize("rotate"))
    jax.tree.map(np.testing.assert_array_equal, rotated, turned("rotate"))


def test_a_record_comes_back_from_the_disk_as_it_was(tmp_path: Path) -> None:
    record().save(tmp_path / "record")
    back = experience.load(tmp_path / "record", ROBOT)
    assert jax.tree.structure(back) == jax.tree.structure(record())
    jax.tree.map(np.testing.assert_array_equal, back, record())


def spoilt(**changes) -> Experience:
    def one_nan(x):
        return np.where(np.arange(x.size).reshape(x.shape) == x.size - 1, np.nan, x)

    nan = {name: jax.tree.map(one_nan, getattr(record(), name)) for name in changes.pop("nan", ())}
    return record().replace(**nan, **changes)


def save_and_load(record: Experience, path: Path) -> None:
    record.save(path)
    experience.load(path, ROBOT)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (dict(nan=["s"]), "s holds NaN"),
        (dict(nan=["o"]), "o holds NaN"),
        (dict(nan=["o_next"]), "o_next holds NaN"),
        (dict(nan=["a"]), "a holds NaN"),
        (dict(nan=["physics"]), "physics holds NaN"),
        (dict(a=np.zeros((30, 5, 4))), "a has shape"),
        (dict(s=np.zeros((30, 4, 10))), "s has shape"),
        (dict(last=np.zeros((29, 5), bool)), "last has shape"),
        (dict(valid=np.zeros(30, bool)), "valid has shape"),
        (dict(physics=np.zeros((29, 5, 3))), "physics does not begin with"),
    ],
)
def test_a_record_with_nan_or_odd_shapes_is_refused(tmp_path: Path, wrong: dict, why: str) -> None:
    bad = spoilt(**wrong)
    with pytest.raises(BadInput, match=why):
        pairs(ROBOT, bad)
    with pytest.raises(BadInput, match=why):
        replay(ROBOT, bad, KEY)
    with pytest.raises(BadInput, match=f"{why}|not all arrays begin with"):
        save_and_load(bad, tmp_path / "bad")


@pytest.mark.parametrize("wrong", [{"segment": 0}, {"copies": 0}, {"num_envs": 0}])
def test_settings_that_make_no_replay_are_refused(wrong: dict) -> None:
    with pytest.raises(BadInput, match="at least 1"):
        Generalize(**wrong)


def test_a_goal_horizon_below_1_is_refused() -> None:
    with pytest.raises(BadInput, match="goal_horizon"):
        pairs(ROBOT, record(), goal_horizon=0)


# ── the Ant ─────────────────────────────────────────────────────────────────────────────


def test_after_20_steps_a_replayed_ant_is_within_a_centimetre(ant: Ant) -> None:
    """Of two copies, turned apart, one is taken for the record: one program, and no other."""
    key, moves = jax.random.split(KEY)
    start = jax.jit(ant.reset)(jax.random.split(key, 32), jnp.zeros(32))
    every = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], 20, axis=0), start)
    log = Experience(
        s=every.observation, o=every.position, o_next=every.position,
        a=np.asarray(jax.random.uniform(moves, (20, 32, 8), minval=-1.0)),
        first=np.arange(20)[:, None].repeat(32, 1) == 0, last=every.fallen,
        valid=~every.diverged, physics=every.physics,
    )  # fmt: skip
    g = replay(ant, log, KEY, Generalize(segment=20, copies=2), quiet=True)
    one, other = (jax.tree.map(lambda x, c=c: x[c : c + 1], g.replace(start=None)) for c in (0, 1))
    back = symmetry.rotate_vector(jnp.asarray(one.o_next[0]), -jnp.asarray(one.yaw[0]))
    off = residual(log.replace(o_next=np.asarray(back)), other.replace(start=g.start))
    assert off["step"].tolist() == list(range(1, 21))
    assert off["median"][0] < 1e-4 and off["median"][-1] < 1e-2
    assert np.abs(g.yaw[0, 0] - g.yaw[1, 0]).max() > 2
    travelled = np.linalg.norm(back[-1] - log.o[0], axis=-1)
    assert np.median(travelled) > 0.1  # so that standing still would not pass
