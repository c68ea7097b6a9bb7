"""Offline learners: the dataset and its goals, training, the policy, and the rows of the table."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_cells
from point import Point

from genidm import checkpoints, controller, files, symmetry
from genidm.errors import BadInput
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.evaluate import EvaluationSettings, evaluate
from genidm.evaluation.scenarios import scenarios
from genidm.experience import Experience
from genidm.offline import data as data_module
from genidm.offline.crl import CRL
from genidm.offline.data import Dataset, Goals, Sample, dataset, draw_goals, draw_samples, measured
from genidm.offline.gcbc import GCBC
from genidm.offline.gcivl import GCIVL
from genidm.offline.hiql import HIQL
from genidm.offline.learner import Learner, log_prob, loss_awr
from genidm.offline.methods import EXTENDED, LEARNERS, OfflineGoalConditioned, by_name
from genidm.offline.networks import Actor, Architecture
from genidm.offline.policy import GoalPolicy
from genidm.offline.train import train
from genidm.paper import methods
from genidm.paper.generalize import Generalize, replay, rotate_exactly
from genidm.progress import Progress
from genidm.robots import ROBOTS, State
from genidm.robots.base import select
from genidm.runs.cell import make_run
from genidm.runs.resolve import Options
from genidm.store import Stage

ROBOT = Point()
HOLD = 20


@functools.cache
def walk(steps: int = 200, lanes: int = 64, episode: int = 100) -> Experience:
    """A random walk: each lane keeps a random action for 20 steps, and starts anew."""
    key = jax.random.key(0)
    held = jax.random.uniform(key, (steps // HOLD, lanes, 3), minval=-1.0)
    a = jnp.repeat(held, HOLD, axis=0) * jnp.float32([1, 1, 0.3])
    first = jnp.broadcast_to((jnp.arange(steps) % episode == 0)[:, None], (steps, lanes))

    def fresh(key: jax.Array) -> State:
        return ROBOT.reset(jax.random.split(key, lanes), jnp.zeros(lanes))

    def step(state: State, row: tuple[jax.Array, ...]) -> tuple[State, tuple[Any, ...]]:
        key, first, a = row
        state = select(first, fresh(key), state)
        after = ROBOT.step(state, a)
        return after, (state.observation, state.position, after.position, state.physics)

    rows = (jax.random.split(key, steps), first, a)
    _, (s, o, o_next, physics) = jax.jit(lambda rows: jax.lax.scan(step, fresh(key), rows))(rows)
    last = np.roll(first, -1, axis=0)
    made = Experience(s, o, o_next, a, first, last, np.ones((steps, lanes), bool), physics)
    return jax.tree.map(np.asarray, made)


# ── the dataset ─────────────────────────────────────────────────────────────────────────


def small_data(generalize: bool = False, **changes: Any) -> Dataset:
    """Two lanes of 40 steps with episodes of 20; lane by lane, as the dataset stores it."""
    record = jax.tree.map(lambda x: x[:40, :2], walk(200, 64, 20)).replace(**changes)
    turned = rotate_exactly(ROBOT, record, jax.random.key(5), copies=2) if generalize else None
    return dataset(ROBOT, record, turned)


def test_a_dataset_holds_the_record_lane_by_lane() -> None:
    record, data = walk(200, 64, 20), small_data()
    for name in ("s", "o"):
        there = getattr(record, name)[:40, :2]
        np.testing.assert_array_equal(getattr(data, name)[0, 40:], there[:, 1])
    np.testing.assert_array_equal(data.a[:40], record.a[:40, 0])
    np.testing.assert_array_equal(data.end, np.repeat([19, 39, 59, 79], 20))
    np.testing.assert_array_equal(data.starts, np.delete(np.arange(80), [19, 39, 59, 79]))


def test_invalid_steps_end_a_trajectory_and_are_no_goals() -> None:
    valid = np.ones((40, 2), bool)
    valid[[5, 30], [0, 1]] = False
    data = small_data(valid=valid)
    assert data.end[4] == 4 and data.end[6] == 19 and data.end[69] == 69
    assert not {4, 5, 19, 69, 70} & set(data.starts.tolist())
    assert {3, 6, 68, 71} <= set(data.starts.tolist())
    n = jnp.asarray(data.starts).repeat(50)
    for goals in (Goals(), Goals(geometric=True), Goals(future=0, random=1)):
        drawn = np.asarray(draw_goals(data, jax.random.key(0), n, goals, 0.9))
        assert not {5, 70} & set(drawn.tolist())


def test_goals_come_from_where_they_are_asked() -> None:
    data = jax.tree.map(jnp.asarray, small_data())
    n = jnp.full(20_000, 3)
    draw = functools.partial(draw_goals, data, jax.random.key(0), n, discounting=0.8)
    evenly = np.bincount(draw(goals=Goals()), minlength=80) / n.size
    # Rounding halves the chance of both ends, as in OGBench.
    assert evenly[:4].sum() == evenly[20:].sum() == 0
    np.testing.assert_allclose(evenly[5:19], 1 / 15, atol=0.01)
    np.testing.assert_allclose(evenly[[4, 19]], 1 / 30, atol=0.01)
    geometric = np.bincount(draw(goals=Goals(geometric=True)), minlength=80) / n.size
    ahead = np.arange(1, 16)
    np.testing.assert_allclose(geometric[4:19], 0.2 * 0.8 ** (ahead - 1), atol=0.01)
    assert geometric[19] == pytest.approx(0.8**15, abs=0.01)
    mixed = np.bincount(draw(goals=Goals(0.2, 0.5, 0.3)), minlength=80) / n.size
    assert mixed[3] == pytest.approx(0.2 + 0.3 / 76, abs=0.015)
    assert mixed[20:].sum() == pytest.approx(0.3 * 57 / 76, abs=0.015)


def test_a_rotated_copy_shows_the_same_sample_rotated() -> None:
    data = jax.tree.map(jnp.asarray, small_data(generalize=True))
    n = jnp.arange(18)
    record = Sample(jnp.zeros_like(n), n)
    for view in (1, 2):
        copy = Sample(jnp.full_like(n, view), n)
        yaw = data.yaw[view, n]
        assert np.abs(yaw).max() > 1
        for step in (n, n + 1, jnp.full_like(n, 19)):
            s, o = data.at(record, step)
            there = data.at(copy, step)
            np.testing.assert_allclose(ROBOT.observation.rotate(s, yaw), there[0], atol=1e-5)
            np.testing.assert_allclose(symmetry.rotate_vector(o, yaw), there[1], atol=1e-5)


def test_a_replayed_segment_is_followed_to_its_end() -> None:
    """The point's replay is exact, so both sources of a next state agree; they have other bits."""
    record = jax.tree.map(lambda x: x[:40, :2], walk(200, 64, 20)).prepared(ROBOT)
    turned = replay(ROBOT, record, jax.random.key(0), Generalize(segment=8, num_envs=8), quiet=True)
    data = jax.tree.map(jnp.asarray, dataset(ROBOT, record, turned))
    n = jnp.arange(19)
    inside = np.asarray(data.segment[n + 1] == data.segment[n])
    assert inside.sum() == 17  # segments begin at 0, 8 and 16
    s, o = data.at(Sample(jnp.ones_like(n), n), n + 1)
    np.testing.assert_array_equal(s[inside], turned.s[0, 1:20, 0][inside])
    np.testing.assert_array_equal(o[inside], turned.o[0, 1:20, 0][inside])
    rotated = symmetry.rotate_vector(jnp.asarray(record.o[1:20, 0]), data.yaw[1, n])
    np.testing.assert_allclose(o, rotated, atol=1e-5)
    assert np.abs(turned.o[0, 1:20, 0] - o)[~inside].max() > 0.01


def test_inputs_are_normalised_by_what_is_drawn() -> None:
    data = measured(jax.tree.map(jnp.asarray, small_data(generalize=True)), jax.random.key(0))
    sample = draw_samples(data, jax.random.key(1), 20_000)
    goal = draw_goals(data, jax.random.key(2), sample.n, Goals(), 0.99)
    x = np.asarray(data.seen(sample, sample.n, goal))
    moving = np.asarray(data.std) > data_module.STD_FLOOR
    np.testing.assert_allclose(x.mean(0)[moving], 0, atol=0.05)
    np.testing.assert_allclose(x.std(0)[moving], 1, atol=0.05)


@pytest.mark.parametrize("learner", [GCIVL(batch_size=4000), HIQL(batch_size=4000)])
def test_only_the_step_s_own_position_is_reached(learner: GCIVL | HIQL) -> None:
    data = jax.tree.map(jnp.asarray, small_data())
    batch = learner.draw(data, jax.random.key(0))
    here = np.abs(np.asarray(batch.value[:, -3:])).max(-1) == 0
    np.testing.assert_array_equal(batch.reward, np.where(here, 0, -1))
    np.testing.assert_array_equal(batch.mask, np.where(here, 0, 1))
    assert here.mean() == pytest.approx(0.2 + 0.3 / 76, abs=0.03)
    step = np.asarray(batch.value_next - batch.value)[:, -3:]
    assert np.abs(step).max() < 0.06  # the goal moves by a step, against the robot


def test_a_subgoal_lies_before_the_goal() -> None:
    data = jax.tree.map(jnp.asarray, small_data())
    batch = HIQL(batch_size=2000, subgoal_steps=6).draw(data, jax.random.key(0))
    way, left = np.asarray(batch.subgoal[:, -3:]), np.asarray(batch.high_next[:, -3:])
    np.testing.assert_allclose(way + left, batch.high[:, -3:], atol=1e-5)
    assert np.linalg.norm(way, axis=-1).max() <= 6 * 0.05 + 1e-5
    assert (np.linalg.norm(batch.low[:, -3:], axis=-1) <= 6 * 0.05 + 1e-5).all()
    assert np.linalg.norm(batch.high[:, -3:], axis=-1).max() > 0.4


@pytest.mark.parametrize("wrong", [(0.5, 0.4, 0.0), (1.5, -0.5, 0.0)])
def test_probabilities_must_add_up(wrong: tuple[float, ...]) -> None:
    with pytest.raises(BadInput, match=r"add up|must lie"):
        Goals(*wrong)


def test_a_record_without_two_steps_in_a_row_is_refused() -> None:
    valid = np.arange(40)[:, None] % 2 == np.zeros((1, 2))
    with pytest.raises(BadInput, match="no valid step has a valid next step"):
        small_data(valid=valid)


# ── networks and losses: what test_ogbench does not see ─────────────────────────────────


def test_an_actor_starts_near_zero_with_glorot_s_weights() -> None:
    params = Actor((300, 200), 4).init(jax.random.key(0), jnp.zeros(50))["params"]
    hidden, last = params["MLP_0"]["hidden_1"]["kernel"], params["Dense_0"]["kernel"]
    assert np.abs(hidden).max() == pytest.approx(np.sqrt(6 / 500), rel=0.01)
    assert np.abs(last).max() == pytest.approx(0.1 * np.sqrt(6 / 204), rel=0.05)


def test_the_log_likelihood_is_that_of_a_normal_distribution() -> None:
    mean, x = jnp.float32([[0.3, -0.4]]), jnp.float32([[0.1, 0.5]])
    expected = jax.scipy.stats.norm.logpdf(x, mean).sum(-1)
    np.testing.assert_allclose(log_prob(mean, x), expected, rtol=1e-6)


def test_awr_weights_are_capped() -> None:
    mean, x = jnp.zeros((2, 1)), jnp.float32([[0.0], [1.0]])
    loss, _ = loss_awr(mean, x, jnp.float32([0.0, 50.0]), 3.0)
    own = np.log(2 * np.pi) / 2 + np.array([0, 0.5])
    assert float(loss) == pytest.approx((own[0] + 100 * own[1]) / 2, rel=1e-5)


# ── training ────────────────────────────────────────────────────────────────────────────

NETWORKS: dict[str, Any] = dict(policy_hidden_layer_sizes=(8,), updates=40, batch_size=16)
VALUES: dict[str, Any] = dict(value_hidden_layer_sizes=(8,))
SMALL: dict[str, Learner] = {
    "GCBC": GCBC(**NETWORKS),
    "GCIVL": GCIVL(**NETWORKS, **VALUES),
    "HIQL": HIQL(**NETWORKS, **VALUES, representation_size=3),
    "CRL": CRL(**NETWORKS, **VALUES, latent_size=4),
}
ALL = pytest.mark.parametrize("name", SMALL)


def same(a: Any, b: Any) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


class Killed(BaseException):
    """Stands for kill -9."""


@pytest.mark.parametrize("name", ["HIQL", "CRL"])  # with a target, and without
def test_a_killed_training_goes_on_to_the_same_bits(name: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(checkpoints, "CHECKPOINT_SECONDS", 0)
    data = small_data(generalize=True)
    run = functools.partial(train, data, jax.random.key(0), SMALL[name], quiet=True)
    whole, stage = run(chunk=40), Stage.open(tmp_path, "train", {})
    advance, calls = Progress.advance, []

    def dying(self, *args, **kwargs):
        calls.append(args)
        if len(calls) == 3:
            raise Killed
        advance(self, *args, **kwargs)

    with monkeypatch.context() as m:
        m.setattr(Progress, "advance", dying)
        with pytest.raises(Killed):
            run(stage=stage, chunk=10)
    assert stage.checkpoints().steps() == [10, 20]
    assert same(run(stage=stage, chunk=10), whole)
    assert not same(train(data, jax.random.key(1), SMALL[name], quiet=True), whole)


def test_training_that_ends_in_nan_is_refused() -> None:
    learner = dataclasses.replace(SMALL["GCIVL"], learning_rate=1e30)
    with pytest.raises(BadInput, match="NaN or infinity after 40 updates: the training has failed"):
        train(small_data(), jax.random.key(0), learner, quiet=True)


TEST = EvaluationSettings(max_steps=200, num_envs=64)


class Random(flax.struct.PyTreeNode):
    """Acts as if at random: by the last digits of the goal."""

    key: jax.Array

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        return jnp.sin(1e6 * relative_goal)


# HIQL's lower policy learns from the representation of the upper one, so it learns last.
UPDATES, NEARER = {"HIQL": 3000}, {"HIQL": 0.85}


@functools.cache
def by_chance() -> Episodes:
    """The test of random actions."""
    random = Random(jnp.zeros(()))
    return evaluate(ROBOT, random, scenarios(ROBOT, 1, 64), TEST, quiet=True)


@pytest.mark.parametrize(
    "generalize", [pytest.param(False, marks=pytest.mark.slow), True], ids=["record", "G"]
)
@ALL
def test_each_learns_to_reach_goals_from_a_random_walk(name: str, generalize: bool) -> None:
    record = walk().prepared(ROBOT)
    turned = rotate_exactly(ROBOT, record, jax.random.key(1)) if generalize else None
    learner = dataclasses.replace(
        SMALL[name], policy_hidden_layer_sizes=(64, 64), batch_size=128,
        updates=UPDATES.get(name, 1000),
        learning_rate=1e-3, **({} if name == "GCBC" else dict(value_hidden_layer_sizes=(64, 64))),
    )  # fmt: skip
    policy = train(dataset(ROBOT, record, turned), jax.random.key(0), learner, quiet=True)
    found = evaluate(ROBOT, policy, scenarios(ROBOT, 1, 64), TEST, quiet=True)
    print(name, generalize, found.start.mean(), found.closest.mean(), by_chance().closest.mean())
    assert found.closest.mean() < NEARER.get(name, 0.75) * found.start.mean()
    assert by_chance().closest.mean() > 0.85 * found.start.mean()


# ── the policy ──────────────────────────────────────────────────────────────────────────


def policy(representation_size: int | None) -> GoalPolicy:
    architecture = Architecture(3, (8, 7), representation_size)
    rng = np.random.default_rng(0)
    params = jax.tree.map(
        lambda x: jnp.float32(rng.normal(size=x.shape)), architecture.init(jax.random.key(0), 10)
    )
    mean, std = (jnp.float32(x) for x in (rng.normal(size=13), rng.uniform(0.5, 2, size=13)))
    return GoalPolicy(params, mean, std, jnp.float32(3.25), architecture, ROBOT)


LEVELS = pytest.mark.parametrize("representation_size", [None, 4])


def states(count: int = 16) -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(1)
    s = ROBOT.observation.canonical(jnp.float32(rng.normal(size=(count, 10))))
    return s, jnp.float32(rng.normal(size=(count, 3)))


@LEVELS
def test_a_policy_comes_back_from_the_disk_as_it_was(
    tmp_path: Path, representation_size: int | None
) -> None:
    one = policy(representation_size)
    one.save(tmp_path / "controller")
    back = controller.load(tmp_path, ROBOT)
    assert same(one, back) and jax.tree.structure(one) == jax.tree.structure(back)
    np.testing.assert_array_equal(one(*states()), back(*states()))
    with pytest.raises(BadInput, match="not overwritten"):
        one.save(tmp_path / "controller")


@LEVELS
def test_a_far_goal_is_seen_at_the_longest_distance(representation_size: int | None) -> None:
    one = policy(representation_size)
    s, way = states()
    way /= jnp.linalg.norm(way, axis=-1, keepdims=True)
    np.testing.assert_allclose(one(s, 3.25 * way), one(s, 50 * way), atol=1e-4)
    assert np.abs(one(s, 3.25 * way) - one(s, 1.0 * way)).max() > 0.1
    assert np.isfinite(one(s, 0 * way)).all() and np.abs(one(s, way)).max() <= 1


def test_the_low_level_sees_a_subgoal_of_fixed_length() -> None:
    one = policy(4)
    grown = jax.tree.map(lambda x: x, one.params)
    last = grown["high_actor"]["params"]["Dense_0"]
    grown["high_actor"]["params"]["Dense_0"] = jax.tree.map(lambda x: 7 * x, last)
    np.testing.assert_allclose(one(*states()), one.replace(params=grown)(*states()), atol=1e-5)


@pytest.mark.parametrize(
    ("field", "value"),
    [("longest_goal", -1.0), ("action_size", 4), ("representation_size", 0),
     ("policy_hidden_layer_sizes", ["x"]), ("policy_hidden_layer_sizes", [8, 6])],
)  # fmt: skip
def test_metadata_that_fits_no_policy_is_refused(tmp_path: Path, field: str, value: Any) -> None:
    policy(None).save(tmp_path / "made")
    tree, meta = files.load_arrays(tmp_path / "made")
    files.save_arrays(tmp_path / "other", tree, meta | {field: value})
    with pytest.raises(BadInput, match="other"):
        controller.load(tmp_path / "other", ROBOT)


# ── the rows of the table ───────────────────────────────────────────────────────────────


def test_rows_learn_from_the_records_of_rl_and_ge() -> None:
    assert EXTENDED == ("GCBC", "GCBC_G", "GCIVL", "GCIVL_G", "HIQL", "HIQL_G", "CRL", "CRL_G")
    assert not set(EXTENDED) & set(methods.ORDER)
    for robot in ROBOTS:
        for name in EXTENDED:
            row, record = (
                by_name(name, robot),
                methods.by_name("GE" if "_G" in name else "RL", robot),
            )
            assert isinstance(row, OfflineGoalConditioned)
            assert isinstance(record, methods.FromRecord)
            assert row.name == name and row.learner == LEARNERS[name.removesuffix("_G")]
            for field in ("agent", "task", "fraction", "generalize"):
                assert getattr(row, field) == getattr(record, field)
    assert by_name("LR", "humanoid") == methods.by_name("LR", "humanoid")
    with pytest.raises(BadInput, match=r"'X_G'; there are: RS, .*, CRL_G$"):
        by_name("X_G")


@pytest.mark.parametrize("scale", ["quick", "0.25", "paper"])
@pytest.mark.parametrize("robot", ["ant", "humanoid"])
def test_a_row_shares_the_stages_of_its_record(robot: str, scale: str, tmp_path: Path) -> None:
    options = Options(scale=scale, run_dir=tmp_path)
    made = ROBOTS[robot]()
    runs = {n: make_run(made, by_name(n, robot), options) for n in ("RL", "GE", "HIQL", "HIQL_G")}
    for record, row in (("RL", "HIQL"), ("GE", "HIQL_G")):
        assert runs[row].sources[:-1] == runs[record].sources[:-1]
        assert runs[row].controller_stage != runs[record].controller_stage
    updates = round(20_000 * runs["HIQL"].scale.updates)
    assert runs["HIQL"].method.learner.updates == updates


def test_the_paper_s_settings_do_not_apply_to_a_row(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="--paper-settings changes nothing in CRL"):
        make_run(ROBOT, by_name("CRL"), Options(run_dir=tmp_path, paper_settings=True))


def test_a_row_is_made_tested_and_shown(tmp_path: Path, one_bank: None, capsys) -> None:
    row = by_name("HIQL_G")
    ge = small_cells.GE
    row = dataclasses.replace(
        row, agent=ge.agent, task=ge.task, generalize=ge.generalize, learner=SMALL["HIQL"]
    )
    small_cells.command(tmp_path, method=ge)
    with small_cells.counted() as calls:
        small_cells.command(tmp_path, "--method.learner.updates", "30", method=row)
    assert calls["collect"] == calls["replay"] == 0 and calls["run"] == 1
    shown = capsys.readouterr().out
    assert shown.index("\nGE ") < shown.index("\nHIQL_G ")
    stage = small_cells.stage_of(tmp_path, "HIQL_G")
    assert isinstance(controller.load(stage, ROBOT), GoalPolicy)
    assert Stage(stage).summary()["settings"]["learner"]["updates"] == 30
