"""The test of A.1.3, on a robot whose every episode has a closed form."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from killing import Killed, dies_at
from point import Point, Straight

from genidm import checkpoints, devices
from genidm.errors import BadInput
from genidm.evaluation import stats
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.evaluate import EvaluationSettings, evaluate, flatten, run, walking_speed
from genidm.evaluation.scenarios import Scenarios, fig8_scenarios, scenarios
from genidm.progress import METRICS, Progress, read_metrics
from genidm.robots import State
from genidm.store import Stage

SEEDS, EPISODES = 2, 15
FAST = dict(num_envs=64, chunk=50)


@functools.cache
def tested_scenarios() -> Scenarios:
    """The same for all points: they do not see how they go, fall or diverge."""
    return scenarios(Point(), SEEDS, EPISODES)


def steer(robot: Point, pace: float = 1.0, mesh=None, stage=None, **settings) -> Episodes:
    return evaluate(
        robot,
        Straight(jnp.float32(pace), robot),
        tested_scenarios(),
        EvaluationSettings(**(FAST | settings)),
        mesh=mesh,
        stage=stage,
        quiet=True,
    )


@functools.cache
def starts_and_targets() -> list[tuple[np.ndarray, np.ndarray]]:
    start, flat = starts(Point(), tested_scenarios()), flatten(tested_scenarios())
    return list(zip(np.float64(start.position), np.float64(flat.target), strict=True))


def closed_form(
    robot: Point, pace: float, max_steps: int = 1000, goal_radius: float = 0.1
) -> tuple[Episodes, list[np.ndarray]]:
    """What becomes of each episode of the scenarios, and its way, in NumPy and float64."""
    rows = [
        one_episode(robot, pace, max_steps, goal_radius, *ends) for ends in starts_and_targets()
    ]
    outcome = {
        f.name: np.array([getattr(row, f.name) for row in rows]).reshape(SEEDS, EPISODES)
        for f in dataclasses.fields(Episodes)
    }
    return Episodes(**outcome), [row.way for row in rows]


def one_episode(robot, pace, max_steps, goal_radius, start, target) -> SimpleNamespace:
    stride = pace * robot.speed * robot.dt
    level = (target - start) * [1, 1, 0]
    there = np.linalg.norm(level)
    n = np.arange(max_steps + 1)
    way = start + n[:, None] * stride * level / there
    far, out = np.abs(there - n * stride), np.linalg.norm(way[:, :2], axis=-1)
    reached, fell, lost = far <= goal_radius, out > robot.falls_at, out > robot.diverges_at
    steps = next(i for i in n[1:] if reached[i] or fell[i] or lost[i] or i == max_steps)
    moves = steps - lost[steps]  # the step in which it diverges leads nowhere
    way = np.concatenate([way[: moves + 1], way[moves : moves + steps - moves]])
    return SimpleNamespace(
        closest=far[: moves + 1].min(), start=there, reached=reached[moves] & (moves == steps),
        fell=fell[steps] & ~lost[steps], diverged=lost[steps], steps=steps,
        path_length=moves * abs(stride), way=way,
    )  # fmt: skip


def agree(a: Episodes, b: Episodes, atol: float = 1e-4) -> None:
    for f in dataclasses.fields(Episodes):
        x, y = getattr(a, f.name), getattr(b, f.name)
        assert x.shape == y.shape == (SEEDS, EPISODES)
        np.testing.assert_allclose(x, y, rtol=0, atol=atol, err_msg=f.name)


def test_straight_to_the_target_every_column_is_the_closed_form() -> None:
    robot = Point()
    episodes = steer(robot)
    agree(episodes, closed_form(robot, 1.0)[0])
    assert episodes.reached.all() and not (episodes.fell | episodes.diverged).any()
    assert (episodes.steps > 30).all() and (episodes.closest > 0.05).all()


def test_what_leaves_the_circle_falls_and_keeps_the_distance_it_came_to() -> None:
    robot = Point(falls_at=3.0)
    episodes = steer(robot)
    agree(episodes, closed_form(robot, 1.0)[0])
    assert 0 < episodes.fell.sum() < episodes.fell.size
    assert (episodes.fell | episodes.reached).all()


def test_what_flees_makes_all_its_steps_and_comes_no_nearer() -> None:
    robot = Point()
    episodes = steer(robot, pace=-0.5, chunk=333)
    agree(episodes, closed_form(robot, -0.5)[0], atol=1e-3)
    assert (episodes.steps == 1000).all() and not episodes.reached.any()
    np.testing.assert_array_equal(episodes.closest, episodes.start)


def test_what_diverges_is_counted_and_is_in_no_mean() -> None:
    robot = Point(diverges_at=3.0)
    episodes, (expected, _) = steer(robot), closed_form(robot, 1.0)
    agree(episodes, expected)
    lost = episodes.diverged
    assert 0 < lost.sum() < lost.size and not episodes.fell.any()
    assert all(np.isfinite(x).all() for x in dataclasses.astuple(episodes))
    summary = stats.summary(episodes)
    assert summary["diverged"] == lost.mean()
    assert summary["mean"] == pytest.approx(expected.closest[~lost].mean(), abs=1e-4)
    assert summary["steps"] == pytest.approx(expected.steps[~lost].mean())


def test_an_episode_ends_at_the_step_limit_and_at_the_reach_radius() -> None:
    robot = Point()
    agree(steer(robot, max_steps=60), closed_form(robot, 1.0, max_steps=60)[0])
    episodes = steer(robot, goal_radius=1.0)
    agree(episodes, closed_form(robot, 1.0, goal_radius=1.0)[0])
    assert (episodes.closest > 0.9).all()


@pytest.mark.parametrize(
    ("lanes", "chunk", "cores"), [(1, 100, 1), (7, 33, 1), (7, 33, 2), (64, 1, 2), (1000, 400, 2)]
)
def test_nothing_depends_on_lanes_or_chunk_or_devices(lanes: int, chunk: int, cores: int) -> None:
    robot = Point(falls_at=4.0, diverges_at=4.02)
    mesh = devices.mesh(jax.devices()[:cores])
    episodes = steer(robot, num_envs=lanes, chunk=chunk, mesh=mesh)
    agree(episodes, closed_form(robot, 1.0)[0])
    assert all(x.any() for x in (episodes.fell, episodes.diverged, episodes.reached))


def test_ways_are_traced_from_start_to_end() -> None:
    robot = Point(diverges_at=3.5)
    controller = Straight(jnp.float32(1.0), robot)
    outcome, ways = run(
        robot,
        controller,
        flatten(tested_scenarios()),
        EvaluationSettings(num_envs=6, chunk=50),
        traced=9,
        quiet=True,
    )
    expected, closed = closed_form(robot, 1.0)
    np.testing.assert_array_equal(outcome.steps, expected.steps.ravel())
    assert len(ways) == 9 and outcome.diverged[:9].any() and outcome.reached[:9].any()
    for way, exact in zip(ways, closed[:9], strict=True):
        np.testing.assert_allclose(way, exact, rtol=0, atol=1e-4)


def test_one_lane_wastes_no_step(tmp_path: Path) -> None:
    robot, stage = Point(), Stage.open(tmp_path, "test", {})
    episodes = steer(
        robot, num_envs=1, chunk=100, mesh=devices.mesh(jax.devices()[:1]), stage=stage
    )
    calls = -(-episodes.steps.sum() // 100)
    last = read_metrics(stage.path(METRICS))[-1]
    assert last["useful"] == pytest.approx(episodes.steps.sum() / (100 * calls))
    assert last["step"] == SEEDS * EPISODES


@pytest.mark.parametrize(("cores", "lanes"), [(2, 8), (1, 8), (2, 6)])
def test_a_killed_test_goes_on_to_the_same_bits(
    tmp_path: Path, monkeypatch, cores: int, lanes: int
) -> None:
    """On other devices it begins anew: its queues belong to them, and lanes go by their memory."""
    robot, stage = Point(falls_at=4.0), Stage.open(tmp_path, "test", {})
    whole = steer(robot, num_envs=8)
    monkeypatch.setattr(checkpoints, "CHECKPOINT_SECONDS", 0)
    with monkeypatch.context() as m:
        m.setattr(Progress, "advance", dies_at(3))
        with pytest.raises(Killed):
            steer(robot, num_envs=8, stage=stage)
    calls = []
    count = Progress.advance
    monkeypatch.setattr(Progress, "advance", lambda *a, **k: (calls.append(a), count(*a, **k)))
    resumed = steer(robot, num_envs=lanes, stage=stage, mesh=devices.mesh(jax.devices()[:cores]))
    goes_on = (cores, lanes) == (2, 8)
    if goes_on:
        for x, y in zip(dataclasses.astuple(whole), dataclasses.astuple(resumed), strict=True):
            np.testing.assert_array_equal(x, y)
    agree(resumed, closed_form(robot, 1.0)[0])
    steps = [line["step"] for line in read_metrics(stage.path(METRICS))]
    assert steps == sorted(steps) and steps[-1] == SEEDS * EPISODES
    assert len(calls) == len(steps) - 2 * goes_on


@pytest.mark.parametrize(
    "wrong", [{"num_envs": 0}, {"max_steps": 0}, {"chunk": 0}, {"goal_radius": -0.1}]
)
def test_settings_that_make_no_test_are_refused(wrong: dict) -> None:
    with pytest.raises(BadInput, match=next(iter(wrong))):
        EvaluationSettings(**wrong)


# ── scenarios ───────────────────────────────────────────────────────────────────────────


def starts(robot: Point, of: Scenarios) -> State:
    flat = flatten(of)
    return jax.jit(robot.reset)(flat.keys, flat.yaw)


def same(a: Scenarios, b: Scenarios) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(numbers(a), numbers(b), strict=True))


def numbers(tested_scenarios: Scenarios) -> list[np.ndarray]:
    return [
        np.asarray(x)
        for x in (
            jax.random.key_data(tested_scenarios.keys),
            tested_scenarios.yaw,
            tested_scenarios.target,
        )
    ]


@pytest.mark.parametrize(
    ("answer", "given"),
    [
        (lambda s, way: way[:, :2], r"float32\[\d+, 2\]"), (lambda s, way: way[:, :1], "float32"),
        (lambda s, way: way.sum(), r"float32\[\]"), (lambda s, way: None, "None"),
        (lambda s, way: way > 0, r"bool\[\d+, 3\]"),
    ],
)  # fmt: skip
def test_a_controller_that_answers_something_else_is_refused(answer, given: str) -> None:
    with pytest.raises(BadInput, match=rf"the controller must return .* not {given}"):
        evaluate(Point(), answer, tested_scenarios(), EvaluationSettings(**FAST), quiet=True)


@pytest.mark.parametrize(
    "wrong",
    [
        dict(seeds=10**30), dict(episodes=10**30), dict(seeds=10**4, episodes=10**4),
        dict(episodes=1.5), dict(first_seed=-1), dict(first_seed=2**32 - 1), dict(first_seed=2**70),
        dict(first_seed=0.5), dict(seeds=True),
    ],
)  # fmt: skip
def test_a_bank_of_no_such_numbers_is_refused(wrong: dict) -> None:
    with pytest.raises(BadInput, match=r"(seeds?|episodes) of a test must"):
        scenarios(Point(), **({"seeds": 2, "episodes": 2} | wrong))


def test_seeds_go_up_to_32_bits() -> None:
    last = scenarios(Point(), 2, 3, first_seed=2**32 - 2)
    assert not same(last, scenarios(Point(), 2, 3)) and len(np.unique(last.yaw)) == 6
    assert same(jax.tree.map(lambda x: x[1:], last), scenarios(Point(), 1, 3, first_seed=2**32 - 1))


@pytest.mark.parametrize("wrong", [dict(episodes=0), dict(episodes=10**12), dict(seed=2**32)])
def test_how_fast_nobody_walks_is_not_told(wrong: dict) -> None:
    with pytest.raises(BadInput, match=rf"{next(iter(wrong))} must"):
        walking_speed(Point(), Straight(jnp.float32(1.0), Point()), **wrong)


def test_a_bank_is_a_function_of_robot_and_seed_alone() -> None:
    more = scenarios(Point(speed=9.0), 5, 40)
    assert more.shape == (5, 40)
    assert same(jax.tree.map(lambda x: x[:SEEDS, :EPISODES], more), tested_scenarios())
    assert same(jax.tree.map(lambda x: x[3:, :7], more), scenarios(Point(), 2, 7, first_seed=3))
    keys = np.asarray(jax.random.key_data(more.keys)).reshape(200, -1)
    assert len(np.unique(keys, axis=0)) == len(np.unique(more.yaw)) == 200


def test_targets_lie_where_the_paper_puts_them() -> None:
    robot = Point()
    many = scenarios(robot, 4, 250)
    flat, start = flatten(many), starts(robot, many)
    way = np.asarray(flat.target - start.position, np.float64)
    distance = np.hypot(way[:, 0], way[:, 1])
    bearing = np.arctan2(way[:, 1], way[:, 0]) - start.heading
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    covers(distance, 2.0, 5.0)
    covers(bearing, -np.pi / 4, np.pi / 4)
    covers(np.asarray(flat.yaw), -np.pi, np.pi)
    assert np.abs(np.corrcoef([distance, bearing, flat.yaw]) - np.eye(3)).max() < 0.1
    assert (flat.target[:, 2] == robot.standing_height).all()
    # The bearing is from where the robot faces, which is not the yaw it was turned by.
    assert np.abs(start.heading - flat.yaw).max() > 0.1


def covers(x: np.ndarray, low: float, high: float) -> None:
    """Lies within the range, and is spread evenly over it."""
    assert low - 1e-4 <= x.min() and x.max() <= high + 1e-4
    share = np.histogram(x, bins=5, range=(low - 1e-4, high + 1e-4))[0] / x.size
    assert np.abs(share - 0.2).max() < 0.05


def test_another_robot_has_other_targets() -> None:
    class Near(Point):
        target_distance = (1.5, 2.5)

    robot = Near()
    near = scenarios(robot, SEEDS, EPISODES)
    way = np.asarray(flatten(near).target - starts(robot, near).position)
    distance = np.hypot(way[:, 0], way[:, 1])
    assert 1.5 - 1e-4 < distance.min() < 1.7 and 2.3 < distance.max() < 2.5 + 1e-4


def test_the_digest_is_stable_and_sees_every_number() -> None:
    one = tested_scenarios()
    assert one.digest() == scenarios(Point(), SEEDS, EPISODES).digest() and len(one.digest()) == 64
    ulp = [jnp.nextafter(x, jnp.inf) for x in (one.yaw[1, -1], one.target[1, -1, 2])]
    others = [
        one.replace(keys=one.keys.at[1, -1].set(jax.random.key(0))),
        one.replace(yaw=one.yaw.at[1, -1].set(ulp[0])),
        one.replace(target=one.target.at[1, -1, 2].set(ulp[1])),
        jax.tree.map(lambda x: x[:, :-1], one),
        scenarios(Point(), SEEDS, EPISODES, first_seed=1),
    ]
    assert len({one.digest(), *(other.digest() for other in others)}) == 6


def test_the_tours_start_alike_and_one_row_faces_away() -> None:
    robot = Point()
    walks = fig8_scenarios(robot)
    start = jax.tree.map(lambda x: np.asarray(x).reshape(2, 10, -1), starts(robot, walks))
    assert walks.shape == (2, 10) and np.ptp(start.heading[0]) == 0
    way, turned = np.asarray(walks.target) - start.position
    np.testing.assert_allclose(np.hypot(way[:, 0], way[:, 1]), np.linspace(3.5, 5.0, 10), rtol=1e-5)
    angle = np.arctan2(turned[:, 1], turned[:, 0]) - np.arctan2(way[:, 1], way[:, 0])
    np.testing.assert_allclose(np.mod(angle, 2 * np.pi), 0.75 * np.pi, atol=1e-5)


@pytest.mark.parametrize(("seeds", "episodes"), [(0, 1), (1, 0)])
def test_an_empty_bank_is_refused(seeds: int, episodes: int) -> None:
    with pytest.raises(BadInput, match="must be at least 1"):
        scenarios(Point(), seeds, episodes)
