"""What a fit does not see, its error there, and the bearings that a controller has seen."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point, upright

from genidm import controller, experience, files, symmetry
from genidm.controller import Controller, pretrained, relative_bearing
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.paper.fit import Fit, fit, training
from genidm.paper.generalize import Generalize, replay
from genidm.paper.held_out import BEARINGS, HEADINGS, LEAST, held_out_error
from genidm.paper.idm import Architecture
from genidm.paper.methods import HF, paper_settings
from genidm.paper.pairs import Pairs, pairs, split_pairs, with_reflection
from genidm.robots.base import Robot
from genidm.robots.logged import Logged

ROBOT = Point()
H = 3


def record(lengths: list[list[int]], seed: int = 0) -> Experience:
    """Lanes of episodes of these lengths, which walk at random; a[..., 0] numbers the steps."""
    steps, lanes = sum(lengths[0]), len(lengths)
    rng = np.random.default_rng(seed)
    s = np.zeros((steps, lanes, 10))
    s[..., 1:5] = upright(jnp.asarray(rng.uniform(-3, 3, (steps, lanes))))
    s[..., 5:] = rng.normal(size=(steps, lanes, 5))
    o = np.cumsum(rng.uniform(-0.1, 0.1, (steps + 1, lanes, 3)), axis=0)
    a = np.stack([np.arange(steps * lanes).reshape(steps, lanes) / (steps * lanes)] * 3, axis=-1)
    last = np.zeros((steps, lanes), bool)
    for lane, of_lane in enumerate(lengths):
        last[np.cumsum(of_lane) - 1, lane] = True
    first = np.concatenate([np.ones_like(last[:1]), last[:-1]])
    return Experience(s, o[:-1], o[1:], a, first, last, np.ones_like(last))


def steps_of(samples: Pairs, made: Experience) -> np.ndarray:
    """The number of the step of each sample."""
    return np.rint(np.asarray(samples.a)[:, 0] * made.interactions).astype(int)


# ── the held-out samples ────────────────────────────────────────────────────────────────


def test_whole_episodes_are_held_out_with_2_percent_of_the_samples() -> None:
    made = record([[5, 20, 15] * 10, [10, 10, 20] * 10, [2, 18, 20] * 10])
    both, apart = split_pairs(ROBOT, made, goal_horizon=H)
    every = pairs(ROBOT, made, goal_horizon=H)
    fitted, held_out = steps_of(both, made), steps_of(apart, made)
    np.testing.assert_array_equal(np.sort(np.append(fitted, held_out)), steps_of(every, made))
    assert 0.01 * len(every.a) < len(held_out) <= 0.02 * len(every.a) + 1
    episode = (np.cumsum(made.first, axis=0) * 3 + np.arange(3)).ravel()
    assert not set(episode[fitted]) & set(episode[held_out])
    # By the number of a step, all of a sample goes where its action goes.
    order = np.argsort(np.append(fitted, held_out))
    for name in ("s", "d"):
        joined = np.concatenate([getattr(both, name), getattr(apart, name)], axis=1)[:, order]
        np.testing.assert_array_equal(joined, getattr(every, name))


def test_fits_to_the_same_steps_have_the_same_held_out_part() -> None:
    made = record([[20] * 60, [30] * 40])
    one = split_pairs(ROBOT, made, goal_horizon=H)[1]
    turned = replay(ROBOT, made, jax.random.key(0), Generalize("rotate"))
    two = split_pairs(ROBOT, made, turned, goal_horizon=H, mirror=True)[1]
    assert (one.s.shape, two.s.shape) == ((1, len(one.a), 10), (2, 2 * len(one.a), 10))
    np.testing.assert_array_equal(two.a[: len(one.a)], one.a)
    np.testing.assert_array_equal(two.a[len(one.a) :], one.a * [1, -1, -1])


def test_of_one_long_episode_consecutive_steps_are_held_out() -> None:
    made = record([[500]])
    fitted, apart = split_pairs(ROBOT, made, goal_horizon=H)
    steps = steps_of(apart, made)
    assert len(steps) == 10 == np.ptp(steps) + 1  # 2 % of 498, and no gap
    assert len(fitted.a) == 488


def test_of_one_sample_none_is_held_out() -> None:
    fitted, apart = split_pairs(ROBOT, record([[H]]), goal_horizon=H)
    assert (len(fitted.a), len(apart.a)) == (1, 0)
    with pytest.raises(BadInput, match="no held-out samples"):
        held_out_error(ROBOT, lambda s, d: s, apart)
    fitted, apart = split_pairs(ROBOT, record([[H + 1]]), goal_horizon=H)
    assert (len(fitted.a), len(apart.a)) == (1, 1)


# ── the error ───────────────────────────────────────────────────────────────────────────


def seen(count: int = 4000, low: float = -180, high: float = 180, seed: int = 0) -> Pairs:
    """Samples at any heading; the bearing of d is uniform, degrees, and a is its cos and sin."""
    rng = np.random.default_rng(seed)
    yaw, angle = rng.uniform(-np.pi, np.pi, count), np.radians(rng.uniform(low, high, count))
    s = np.zeros((count, 10))
    s[:, 1:5], s[:, 5:] = upright(jnp.asarray(yaw)), 1e-3 * rng.normal(size=(count, 5))
    length, height = rng.uniform(0.6, 1.0, count), rng.uniform(-0.3, 0.3, count)
    d = np.stack([length * np.cos(yaw + angle), length * np.sin(yaw + angle), height], axis=-1)
    a = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return Pairs(*(np.float32(x) for x in (s[None], d[None], a)))


def perfect(s: jax.Array, d: jax.Array) -> jax.Array:
    angle = relative_bearing(ROBOT, s, d)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=-1)


def test_a_perfect_controller_has_no_error_and_one_of_2_with_d_shuffled() -> None:
    """E (f(b′) − f(b))² of two independent b is twice the variance."""
    found = held_out_error(ROBOT, perfect, seen())
    assert found.error < 1e-9 and found.shuffled == pytest.approx(2, abs=0.1)
    assert (found.samples, found.nearest) == (4000, None)
    narrow = held_out_error(ROBOT, perfect, seen(low=-31, high=6))
    assert narrow.error < 1e-6 and narrow.shuffled == pytest.approx(2, abs=0.1)


def test_the_mean_action_has_an_error_of_1_and_does_not_use_d() -> None:
    samples = seen(low=-40, high=90)
    found = held_out_error(ROBOT, lambda s, d: jnp.zeros((len(s), 3)) + samples.a.mean(0), samples)
    assert found.error == pytest.approx(1, rel=1e-5)
    assert found.shuffled == pytest.approx(found.error, rel=1e-6)


def test_an_error_is_a_fraction_of_the_variance() -> None:
    samples = seen()
    found = held_out_error(ROBOT, lambda s, d: perfect(s, d) + 0.3, samples)
    assert found.error == pytest.approx(0.09 / samples.a.var(0).mean(), rel=1e-5)
    still = samples.replace(a=0 * samples.a)
    assert held_out_error(ROBOT, lambda s, d: 0 * d, still).error == 0


def test_errors_stand_in_the_bins_where_they_are_made() -> None:
    samples = seen()

    def wrong(s: jax.Array, d: jax.Array) -> jax.Array:
        angle = jnp.degrees(relative_bearing(ROBOT, s, d))
        at = (angle > 15) & (angle < 45)
        return perfect(s, d) + 0.3 * at[:, None]

    by_bearing = held_out_error(ROBOT, wrong, samples)
    one = 0.09 / samples.a.var(0).mean()
    assert BEARINGS[4:6] == (15, 45)
    np.testing.assert_allclose(by_bearing.bearing.error, [0, 0, 0, 0, one, 0, 0], atol=1e-6)
    widths = np.diff(BEARINGS) / 360
    np.testing.assert_allclose(by_bearing.bearing.share, widths, atol=0.02)
    for bins in (by_bearing.bearing, by_bearing.heading):
        total = np.dot(bins.share, np.float64(bins.error))
        assert total == pytest.approx(by_bearing.error, rel=1e-5)

    def lost(s: jax.Array, d: jax.Array) -> jax.Array:
        yaw = jnp.degrees(ROBOT.observation.yaw(s))
        return perfect(s, d) + 0.3 * ((yaw > -90) & (yaw < -45))[:, None]

    by_heading = held_out_error(ROBOT, lost, samples).heading
    assert by_heading.edges == HEADINGS
    np.testing.assert_allclose(by_heading.error, [0, 0, one, 0, 0, 0, 0, 0], atol=1e-6)


def test_bins_with_few_samples_have_no_number() -> None:
    found = held_out_error(ROBOT, perfect, seen(LEAST, low=-10, high=10))
    assert found.bearing.error[:3] == (None,) * 3 and found.bearing.error[3] < 1e-4
    assert found.heading.error == (None,) * 8
    text = str(found).splitlines()
    assert text[0].startswith("held-out action error 0.000, with d shuffled 2.")
    assert text[1].split()[:5] == ["bearing", "of", "d,", "°", "−180…−90"]
    assert text[2].split() == ["samples", *["0", "%"] * 3, "100", "%", *["0", "%"] * 3]
    assert text[3].split() == ["error", *"–––", "0.00", *"–––"]


def test_the_nearest_neighbour_is_found_at_any_heading() -> None:
    samples, yaw = seen(300), np.random.default_rng(5).uniform(-3, 3, 300)
    turned = samples.replace(
        s=np.asarray(ROBOT.observation.rotate(jnp.asarray(samples.s[0]), jnp.float32(yaw)))[None],
        d=np.asarray(symmetry.rotate_vector(jnp.asarray(samples.d[0]), jnp.float32(yaw)))[None],
    )
    same = held_out_error(ROBOT, perfect, samples, turned)
    assert same.nearest == pytest.approx(0, abs=1e-9)
    far = held_out_error(ROBOT, perfect, samples, seen(low=90, high=91))
    variance = samples.a.var(0).mean()
    expected = np.mean((samples.a - [0, 1, 0]) ** 2) / variance
    assert far.nearest == pytest.approx(expected, rel=0.05)


# ── what a controller has seen ──────────────────────────────────────────────────────────

TINY = Fit(updates=2, batch_size=16, idm=(4,))


def bearings(samples: Pairs, robot: Robot = ROBOT) -> np.ndarray:
    start, _ = training(robot, jax.tree.map(jnp.asarray, samples), jax.random.key(0), TINY)
    return np.degrees(start.model.bearings)


def test_a_fit_keeps_the_bearings_of_98_percent_of_its_samples() -> None:
    np.testing.assert_allclose(bearings(seen(low=-31, high=6)), [-30.63, 5.63], atol=0.3)
    np.testing.assert_allclose(bearings(seen(low=100, high=170)), [100.7, 169.3], atol=0.5)
    np.testing.assert_allclose(bearings(seen(low=-150, high=150)), [-147, 147], atol=3)


@pytest.mark.parametrize(("low", "high"), [(-180, 180), (150, 210), (178, 187), (172, 181)])
def test_a_range_that_crosses_the_back_is_the_full_circle(low: float, high: float) -> None:
    np.testing.assert_allclose(bearings(seen(low=low, high=high)), [-180, 180], atol=1e-4)


def test_mirrored_samples_count() -> None:
    both = with_reflection(ROBOT, seen(low=-31, high=6))
    np.testing.assert_allclose(bearings(both), [-30.26, 30.26], atol=0.3)


def test_without_a_heading_bearings_are_those_of_the_world() -> None:
    class Wheel(Logged):
        name, dt, standing_height = "wheel", 0.1, 0.2
        observation = symmetry.Layout((symmetry.vector("velocity", "m/s"),))
        action = symmetry.Layout((symmetry.vector("push", "N"),))

    robot = Wheel()
    angle = np.radians(np.linspace(10, 20, 4000))
    d = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    samples = Pairs(np.float32(d[None]), np.float32(d[None]), np.float32(d))
    np.testing.assert_allclose(bearings(samples, robot), [10.1, 19.9], atol=1e-3)
    found = held_out_error(robot, lambda s, d: d, samples, samples)
    assert (found.error, found.heading.share[4]) == (0, 1)
    assert found.nearest == pytest.approx(0, abs=1e-6)


def model(clip_bearing: bool, low: float = -31, high: float = 6) -> Controller:
    architecture = Architecture(3, (8,), (8,), None)
    return Controller(
        params=architecture.init(jax.random.key(0), 10), mean=jnp.zeros(10), std=jnp.ones(10),
        architecture=architecture, input_frame="heading", robot=ROBOT,
        bearings=np.float32(np.radians([low, high])), clip_bearing=clip_bearing,
    )  # fmt: skip


def test_d_is_kept_at_the_bearings_that_were_seen() -> None:
    samples, one = seen(), model(True)
    s, d = jnp.asarray(samples.s[0]), jnp.asarray(samples.d[0])
    angle = np.degrees(relative_bearing(ROBOT, s, d))
    kept = jax.jit(one.inside)(s, d)
    now = np.degrees(relative_bearing(ROBOT, s, kept))
    np.testing.assert_allclose(now, np.clip(angle, -31, 6), atol=1e-3)
    np.testing.assert_allclose(
        symmetry.horizontal_norm(kept), symmetry.horizontal_norm(d), rtol=1e-5
    )
    np.testing.assert_array_equal(kept[:, 2], d[:, 2])
    inside = (angle > -30.99) & (angle < 5.99)
    np.testing.assert_array_equal(kept[inside], d[inside])
    assert 300 < inside.sum() < 500


def test_a_controller_clips_the_bearing_only_if_it_is_set() -> None:
    samples = seen()
    s, goal = jnp.asarray(samples.s[0]), 3.7 * jnp.asarray(samples.d[0])
    on, off = model(True), model(False)
    act = jax.jit(Controller.__call__)
    np.testing.assert_allclose(act(on, s, goal), act(off, s, on.inside(s, goal)), atol=1e-5)
    assert np.abs(act(on, s, goal) - act(off, s, goal)).max() > 0.1
    full = model(True, -180, 180)
    np.testing.assert_array_equal(act(full, s, goal), act(off, s, goal))
    read = [act.lower(one, s, goal).as_text().count("stablehlo.atan2") for one in (on, off)]
    assert read[1] == 1 < read[0]  # the heading frame alone reads one angle


def test_bearings_and_their_use_come_back_from_the_disk(tmp_path: Path) -> None:
    one = model(True)
    one.save(tmp_path / "controller")
    back = controller.load(tmp_path / "controller", ROBOT)
    assert back.clip_bearing and isinstance(back, Controller)
    np.testing.assert_array_equal(back.bearings, one.bearings)


def test_a_controller_of_an_older_version_has_the_full_circle(tmp_path: Path) -> None:
    model(True).save(tmp_path / "new")
    tree, meta = files.load_arrays(tmp_path / "new")
    del tree["bearings"], meta["clip_bearing"]
    files.save_arrays(tmp_path / "old", tree, meta)
    for old in (controller.load(tmp_path / "old", ROBOT), pretrained("ant")):
        assert isinstance(old, Controller) and not old.clip_bearing
        np.testing.assert_allclose(old.bearings, [-np.pi, np.pi], rtol=1e-6)


def test_a_controller_with_other_bearings_than_two_is_refused(tmp_path: Path) -> None:
    model(True).replace(bearings=np.zeros(3, np.float32)).save(tmp_path / "controller")
    with pytest.raises(BadInput, match="bearings"):
        controller.load(tmp_path / "controller", ROBOT)


def test_the_papers_settings_do_not_clip() -> None:
    assert not HF.clip_bearing
    assert not paper_settings(dataclasses.replace(HF, clip_bearing=True), "ant").clip_bearing


def test_a_fit_prints_what_it_has_seen(capsys) -> None:
    made = fit(ROBOT, seen(low=-31, high=6), jax.random.key(0), TINY, input_frame="heading")
    np.testing.assert_allclose(np.degrees(made.bearings), [-30.63, 5.63], atol=0.3)
    assert "98 % of d lie between −31° and 6° of the heading" in capsys.readouterr().err


def test_experience_is_a_record_of_the_point() -> None:
    """The records of these tests are ones that people could give."""
    made = record([[5, 7], [6, 6]])
    assert isinstance(made.prepared(ROBOT), experience.Prepared)
