"""From logs without a simulator to a controller, as the README has it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import tiny

from genidm import controller, files, symmetry
from genidm.errors import BadInput
from genidm.experience import Experience, load
from genidm.paper.fit import fit
from genidm.paper.generalize import Generalize, generalize
from genidm.paper.methods import LR
from genidm.paper.pairs import Pairs
from genidm.robots import Logged
from genidm.symmetry import Layout


class Mine(Logged):
    name = "mine"
    dt = 0.02
    standing_height = 0.4
    observation = Layout((symmetry.quaternion("orientation"), symmetry.vector("velocity", "m/s")))
    action = Layout((symmetry.joints("torque", [1, 0], [1, 1], "of full torque"),))


def log(steps: int = 60, lanes: int = 3) -> Experience:
    """Lanes that go straight on, each on a heading of its own."""
    heading = np.tile(np.linspace(-1, 1, lanes), (steps, 1))
    half, zero = heading / 2, np.zeros_like(heading)
    velocity = np.stack([np.cos(heading), np.sin(heading), zero], -1)
    way = np.cumsum(0.02 * velocity, 0)
    first, last = np.zeros((2, steps, lanes), bool)
    first[0], last[-1] = True, True
    orientation = np.stack([np.cos(half), zero, zero, np.sin(half)], -1)
    return Experience(
        s=np.concatenate([orientation, velocity], -1).astype(np.float32),
        o=(way - 0.02 * velocity).astype(np.float32),
        o_next=way.astype(np.float32),
        a=np.random.default_rng(0).uniform(-1, 1, (steps, lanes, 2)).astype(np.float32),
        first=first,
        last=last,
        valid=np.ones_like(last),
    )


def test_a_log_becomes_a_controller(tmp_path: Path) -> None:
    robot, rotate = Mine(), Generalize(mode="rotate")
    pairs, residual = generalize(robot, log(), jax.random.key(0), rotate, goal_horizon=20)
    assert residual["median"].max() < 1e-6
    model = fit(robot, pairs, jax.random.key(1), tiny(LR).fit, quiet=True)
    model.save(tmp_path / "run" / "controller")
    again = controller.load(tmp_path / "run", robot)  # the run's directory will do
    s, way = log().s[0], jnp.asarray([[1.0, 0.0, 0.0]] * 3)
    np.testing.assert_allclose(again(s, way), model(s, way), atol=1e-6)
    # −q is the orientation that q is.
    other = jnp.concatenate([-s[:, :4], s[:, 4:]], axis=-1)
    np.testing.assert_array_equal(model(other, way), model(s, way))
    with pytest.raises(BadInput, match="no robot is called 'mine'"):
        controller.load(tmp_path / "run")


def test_a_goal_horizon_that_leaves_little_is_said() -> None:
    with pytest.warns(UserWarning, match="goal_horizon 50 leaves 33 of 180 steps"):
        generalize(Mine(), log(), jax.random.key(0), Generalize(mode="rotate"), goal_horizon=50)


def test_what_is_told_of_other_sizes_is_refused() -> None:
    for s, way in (((7,), (2,)), ((7,), (1,)), ((6,), (3,)), ((2, 7), (3,))):
        with pytest.raises(BadInput, match=r"s \[..., 7\] and a relative goal \[..., 3\]"):
            Mine().check_inputs(np.zeros(s), np.zeros(way))


def test_a_goal_horizon_longer_than_all_episodes_is_said() -> None:
    with pytest.raises(BadInput, match="no episode lasts goal_horizon = 61 steps"):
        generalize(Mine(), log(), jax.random.key(0), Generalize(mode="rotate"), goal_horizon=61)


def test_a_record_is_checked_once_and_again_when_it_changes() -> None:
    robot, prepared = Mine(), log().prepared(Mine())
    assert prepared.prepared(robot) is prepared
    half = prepared.part(0.5)
    assert half.prepared(robot) is half
    with pytest.raises(BadInput, match="a lies outside"):
        prepared.replace(a=2 + prepared.a).prepared(robot)

    class Other(Mine):
        name = "other"
        action = Layout((symmetry.joints("torque", [0], [1], "of full torque"),))

    with pytest.raises(BadInput, match="a has shape"):
        prepared.prepared(Other())


def test_a_log_without_episodes_is_refused() -> None:
    nothing = np.zeros_like(log().first)
    with pytest.raises(BadInput, match="no step is marked as the first or the last"):
        log().replace(first=nothing, last=nothing).prepared(Mine())
    for flags in ({"first": nothing}, {"last": nothing}):
        log().replace(**flags).prepared(Mine())


def test_nothing_can_be_stepped() -> None:
    robot = Mine()
    for call in (robot.reset, robot.step, robot.set_state, robot.cost):
        with pytest.raises(BadInput, match="it has logs, but no simulator"):
            call(None, None)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (dict(a=3 * log().a), r"a lies outside \[−1, 1\]"),
        (dict(last=log().last.astype(int)), "last has dtype int64, expected bool"),
        (dict(first=log().first[:, 0]), r"first has shape \(60,\), expected \[steps, lanes\]"),
        (dict(o=log().o[..., :2]), "o has shape"),
        (dict(s=-log().s), "'orientation' is not of length 1 with w ≥ 0"),
        (dict(s=2 * log().s), "'orientation' is not of length 1 with w ≥ 0"),
    ],
)
def test_logs_that_are_none_are_refused(changes: dict, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        generalize(
            Mine(), dataclasses.replace(log(), **changes), jax.random.key(0),
            Generalize(mode="rotate"), goal_horizon=20,
        )  # fmt: skip


# ── what logs are like (each was seen on somebody's) ────────────────────────────────────


def ways(experience: Experience, goal_horizon: int = 20) -> np.ndarray:
    """d of the record and of its turned copy, `[2, N, 3]`."""
    rotate = Generalize(mode="rotate")
    pairs, _ = generalize(Mine(), experience, jax.random.key(0), rotate, goal_horizon=goal_horizon)
    return np.asarray(pairs.d)


def with_(name: str, where, value) -> np.ndarray:
    """A copy of one of the log's arrays, changed in one place."""
    array = getattr(log(), name).copy()
    array[where] = value
    return array


def headings(d: np.ndarray) -> list[float]:
    return np.unique(np.arctan2(d[0, :, 1], d[0, :, 0]).round(2)).tolist()


def test_flags_that_contradict_each_other_are_refused() -> None:
    for name, row in (("first", 30), ("last", 29)):
        wrong = dataclasses.replace(log(), **{name: with_(name, (row, 1), True)})
        with pytest.raises(BadInput, match=r"step \[30, 1\] is (not first|first, but)"):
            ways(wrong)


def test_a_jump_inside_an_episode_is_refused_and_between_two_is_not() -> None:
    aside = np.zeros((60, 3, 3), np.float32)
    aside[30:, 1, 0] = 3.0
    moved = dataclasses.replace(log(), o=log().o + aside, o_next=log().o_next + aside)
    with pytest.raises(BadInput, match=r"jumps by 3.* m to o \[30, 1\]"):
        ways(moved)
    with pytest.raises(BadInput, match=r"jumps by 3.* m to o_next \[29, 1\]"):
        ways(dataclasses.replace(moved, o_next=np.concatenate([moved.o[1:], moved.o_next[-1:]])))
    ended = dataclasses.replace(
        moved, first=with_("first", (30, 1), True), last=with_("last", (29, 1), True)
    )
    assert headings(ways(ended)) == [-1, 0, 1]


def test_a_step_that_is_not_valid_is_no_goal_either() -> None:
    astray = dataclasses.replace(
        log(), valid=with_("valid", 25, False), o_next=with_("o_next", 25, 50.0)
    )
    assert ways(astray).shape[1] == 3 * (60 - 19 - 2)
    assert headings(ways(astray)) == [-1, 0, 1]


def test_steps_that_are_not_valid_may_hold_anything() -> None:
    """Gaps, and lanes of unequal length."""
    gone = (slice(45, None), 2)
    holes = {name: with_(name, gone, np.nan) for name in ("s", "o", "o_next", "a")}
    short = dataclasses.replace(
        log(), **holes, valid=with_("valid", gone, False), last=with_("last", (44, 2), True)
    )
    assert ways(short).shape[1] == 2 * (60 - 19) + (45 - 19)
    with pytest.raises(BadInput, match=r"s holds NaN or infinity, first in \[45, 2\]"):
        ways(dataclasses.replace(short, valid=log().valid, last=log().last))


def test_positions_of_utm_size_are_turned_as_well_as_small_ones() -> None:
    north = np.asarray([448_251.7, 5_411_932.3, 35.0])
    near = dataclasses.replace(log(), o=np.float64(log().o), o_next=np.float64(log().o_next))
    far = dataclasses.replace(near, o=near.o + north, o_next=near.o_next + north)
    np.testing.assert_allclose(ways(far), ways(near), atol=1e-5)
    rotate = Generalize(mode="rotate")
    _, residual = generalize(Mine(), far, jax.random.key(0), rotate, goal_horizon=20)
    assert residual["median"].max() < 1e-6


def test_quaternions_in_the_order_of_ros_are_refused() -> None:
    for heading in (log().s, np.abs(log().s)):
        wrong = dataclasses.replace(log(), s=np.abs(heading[..., [1, 2, 3, 0, 4, 5, 6]]))
        with pytest.raises(BadInput, match=r"the order is \(w, x, y, z\), not \(x, y, z, w\)"):
            ways(wrong)


class Euler(Mine):
    name = "euler"
    observation = Layout((symmetry.euler("orientation"), symmetry.vector("velocity", "m/s")))


def angles(scale: float = 1.0, turns: float = 0.0) -> Experience:
    yaw = np.tile(np.linspace(-1, 1, 3), (60, 1)) * scale + 2 * np.pi * turns
    tilt = np.full_like(yaw, 0.03 * scale)
    s = np.stack([tilt, tilt, yaw, *np.moveaxis(log().s[..., 4:], -1, 0)], -1)
    return dataclasses.replace(log(), s=s.astype(np.float32))


def samples(robot: Logged, experience: Experience) -> Pairs:
    rotate = Generalize(mode="rotate")
    return generalize(robot, experience, jax.random.key(0), rotate, goal_horizon=20)[0]


def test_an_angle_and_the_same_a_turn_on_are_one_state() -> None:
    once, twice = (samples(Euler(), angles(turns=n)) for n in (0, 2))
    np.testing.assert_allclose(once.s, twice.s, atol=1e-5)
    model = fit(Euler(), once, jax.random.key(1), tiny(LR).fit, quiet=True)
    way = np.asarray([[1.0, 0.0, 0.0]] * 3)
    once, twice = (np.asarray(model(angles(turns=n).s[0], way)) for n in (0, 1))
    np.testing.assert_allclose(once, twice, atol=1e-3)


def test_degrees_are_refused() -> None:
    with pytest.raises(BadInput, match="the unit is the radian"):
        samples(Euler(), angles(scale=180 / np.pi))


@pytest.mark.parametrize(
    "as_logs_have_it",
    [
        lambda x: x.astype(">f4"),
        lambda x: x.astype(object),
        lambda x: x.tolist(),
        lambda x: np.ma.masked_array(x, np.zeros_like(x, bool)),
        lambda x: np.asfortranarray(x),
    ],
)
def test_arrays_as_logs_have_them_are_converted(as_logs_have_it, tmp_path: Path) -> None:
    names = ("s", "o", "o_next", "a")
    odd = dataclasses.replace(log(), **{n: as_logs_have_it(getattr(log(), n)) for n in names})
    np.testing.assert_allclose(ways(odd), ways(log()), atol=1e-6)
    odd.save(tmp_path / "log")
    np.testing.assert_allclose(ways(load(tmp_path / "log", Mine())), ways(log()), atol=1e-6)


def test_what_no_number_stands_for_is_refused(tmp_path: Path) -> None:
    masked = np.ma.masked_array(log().a, log().a > 0.9)
    words = log().a.astype(object)
    words[3, 1, 0] = "left"
    for a, why in ((masked, "is masked"), (words, "something other than numbers")):
        with pytest.raises(BadInput, match=why):
            ways(dataclasses.replace(log(), a=a))
    with pytest.raises(BadInput, match="a holds NaN"):
        dataclasses.replace(log(), a=with_("a", (3, 1), np.nan)).save(tmp_path / "log")
    log().save(tmp_path / "log")
    with pytest.raises(BadInput, match="exists already"):
        log().save(tmp_path / "log")


def test_a_controller_knows_the_layout_it_was_made_for(tmp_path: Path) -> None:
    model = fit(Mine(), samples(Mine(), log()), jax.random.key(1), tiny(LR).fit, quiet=True)
    model.save(tmp_path / "controller")
    other, fields = Mine(), Mine.observation.fields
    for observation in (Layout(fields[::-1]), Layout((*fields, symmetry.invariant("height")))):
        other.observation = observation
        with pytest.raises(BadInput, match=r"another observation of the mine: it has orientation "):
            controller.load(tmp_path / "controller", other)
    more = Mine()
    more.action = Layout((symmetry.joints("torque", [1, 0, 2], [1, 1, 1], "of full torque"),))
    with pytest.raises(BadInput, match="another action"):
        controller.load(tmp_path / "controller", more)


def spoil(directory: Path, name: str, change) -> None:
    """Changes a file of a controller, and makes its manifest say so."""
    file = directory / name
    np.save(file, change(np.load(file)))
    manifest = files.load_json(directory / "manifest.json")
    files.save_json(directory / "manifest.json", manifest | {name: files.measure(file)})


def foreign(directory: Path, **changes: Any) -> None:
    """Changes what a controller's directory says of it, and makes its manifest say so."""
    meta = files.load_json(directory / "meta.json") | changes
    files.save_json(directory / "meta.json", meta)
    manifest = files.load_json(directory / "manifest.json")
    measured = files.measure(directory / "meta.json")
    files.save_json(directory / "manifest.json", manifest | {"meta.json": measured})


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (dict(idm=[8, 0]), "idm holds a width"), (dict(idm=[-1]), "idm holds a width"),
        (dict(lfm=[10**30]), "lfm holds a width"), (dict(idm="8"), "idm must be a list"),
        (dict(idm=[8] * 999), "idm must be a list"), (dict(lfm=[8.5]), "lfm holds a width"),
        (dict(latent_size=10**18), "latent_size must be at most"),
        (dict(latent_size=-1), "latent_size must be at least"),
        (dict(latent_size=3), "but its architecture needs"),
        (dict(action_size=3), "action_size must be"), (dict(input_frame="body"), "frame must be"),
        (dict(input_frame=None), "frame must be"), (dict(robot=None), "a controller for None"),
        (dict(robot=["mine"]), "a controller for"),
        (dict(robot="a\x1b[2J\nb"), r"for 'a\\x1b\[2J\\n"),
        (dict(observation=[["a\n\x1b[31m", 1, 2, 3]]), r"'a\\n\\x1b\[31m' \(2 × 3, 1\); the robot"),
        (dict(observation=7), "it has no list of fields"),
    ],
)  # fmt: skip
def test_what_a_controllers_directory_says_may_be_anything(
    tmp_path: Path, changes: dict, why: str
) -> None:
    model = fit(Mine(), samples(Mine(), log()), jax.random.key(1), tiny(LR).fit, quiet=True)
    model.save(tmp_path / "controller")
    foreign(tmp_path / "controller", **changes)
    with pytest.raises(BadInput, match=why) as refused:
        controller.load(tmp_path / "controller", Mine())
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda x: x.T, r"is float32\[\d+, \d+\], but its architecture needs"),
        (lambda x: x * np.nan, "holds NaN or infinity"),
        (lambda x: x.astype(np.float64), "is float64"),
        (lambda x: x.astype("U3"), "is <U3"),
    ],
)
def test_parameters_that_do_not_fit_the_architecture_are_refused(
    tmp_path: Path, change, why: str
) -> None:
    model = fit(Mine(), samples(Mine(), log()), jax.random.key(1), tiny(LR).fit, quiet=True)
    model.save(tmp_path / "controller")
    (name,) = (p.name for p in (tmp_path / "controller").glob("params.lfm*Dense_0.kernel.npy"))
    spoil(tmp_path / "controller", name, change)
    with pytest.raises(BadInput, match=why):
        controller.load(tmp_path / "controller", Mine())


def test_a_controller_is_not_asked_with_what_is_not_finite() -> None:
    model = fit(Mine(), samples(Mine(), log()), jax.random.key(1), tiny(LR).fit, quiet=True)
    s, way = log().s[0], np.asarray([[1.0, 0.0, 0.0]] * 3)
    for wrong in ((s * np.nan, way), (s, way * np.inf)):
        with pytest.raises(BadInput, match="holds NaN or infinity"):
            model(*wrong)


# ── more of the same kinds ──────────────────────────────────────────────────────────────


def test_episodes_given_by_their_first_steps_alone_are_refused() -> None:
    first = with_("first", ([0, 20, 40], slice(None)), True)
    with pytest.raises(
        BadInput, match=r"step \[20, 0\] is first, but the step before it is not last"
    ):
        ways(dataclasses.replace(log(), first=first, last=np.zeros_like(first)))


def test_a_jump_behind_steps_that_are_not_valid_is_refused() -> None:
    """They were carried in that time: what follows is no way to go for what was before."""
    aside = np.zeros((60, 3, 3), np.float32)
    aside[30:, 1, 0] = 3.0
    gap = dict(valid=with_("valid", (slice(27, 30), 1), False))
    moved = dataclasses.replace(log(), o=log().o + aside, o_next=log().o_next + aside, **gap)
    with pytest.raises(BadInput, match=r"jumps by 3.* m to o \[30, 1\]"):
        ways(moved)
    assert headings(ways(dataclasses.replace(log(), **gap))) == [-1, 0, 1]
    ended = dict(first=with_("first", (30, 1), True), last=with_("last", (29, 1), True))
    assert headings(ways(dataclasses.replace(moved, **ended))) == [-1, 0, 1]


def test_jumps_that_come_each_second_are_jumps() -> None:
    """Two steps in a hundred: an outlier is not what most of the largest are."""
    o = np.cumsum(np.full((300, 1, 3), [0.02, 0, 0]), axis=0)
    o[:, 0, 1] = 0.4 * (np.arange(300) // 50 % 2)
    one = jax.tree.map(lambda x: np.repeat(x[:1, :1], 300, axis=0), log())
    o_next = np.append(o[1:], o[-1:] + np.asarray([0.02, 0, 0]), axis=0)
    first, last = (np.arange(300)[:, None] == t for t in (0, 299))
    with pytest.raises(BadInput, match=r"jumps by 0\.4.* m to o_next \[\d*9, 0\]"):
        ways(one.replace(o=o, o_next=o_next, first=first, last=last))


def test_steps_that_are_not_valid_are_counted_and_may_be_infinite() -> None:
    gone = dataclasses.replace(
        log(), valid=with_("valid", (7, 2), False), o_next=with_("o_next", (7, 2), np.inf)
    )
    with pytest.warns(
        UserWarning, match=r"1 of 180 steps are not valid and left out, first \[7, 2\]"
    ):
        assert headings(ways(gone)) == [-1, 0, 1]


def test_positions_far_away_count_from_the_first_step_that_is_valid() -> None:
    north = np.asarray([448_251.7, 5_411_932.3, 35.0])
    o, o_next = (np.float64(x) + north for x in (log().o, log().o_next))
    o[:3, 1] = np.nan
    valid = with_("valid", (slice(0, 3), 1), False)
    far = dataclasses.replace(log(), o=o, o_next=o_next, valid=valid)
    near = dataclasses.replace(log(), valid=valid)
    np.testing.assert_allclose(ways(far), ways(near), atol=1e-5)
    rotate = Generalize(mode="rotate")
    _, residual = generalize(Mine(), far, jax.random.key(0), rotate, goal_horizon=20)
    assert residual["p90"].max() < 1e-5


class Counting(Mine):
    name = "counting"
    observation = Layout((symmetry.invariant("touches", 2), symmetry.vector("velocity", "m/s")))


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, np.float16, np.longdouble])
def test_numbers_of_any_kind_are_learned_from_as_floats(dtype: Any) -> None:
    s = np.random.default_rng(0).integers(0, 2, (60, 3, 5)).astype(dtype)
    a = np.zeros((60, 3, 2), dtype)
    made, same = (
        samples(Counting(), dataclasses.replace(log(), s=s.astype(kind), a=a.astype(kind)))
        for kind in (dtype, np.float32)
    )
    assert made.s.dtype == made.a.dtype == np.float32
    np.testing.assert_array_equal(made.s, same.s)


def test_positions_in_whole_numbers_go_backwards_too() -> None:
    """Unsigned integers have no difference below 0."""
    back = np.arange(60, 0, -1, dtype=np.uint8)
    o = np.zeros((60, 3, 3), np.uint8)
    o[..., 0] = back[:, None]
    after = o - np.asarray([1, 0, 0], np.uint8)
    d = ways(dataclasses.replace(log(), o=o, o_next=after))[0]
    np.testing.assert_allclose(d, np.broadcast_to([-1.0, 0.0, 0.0], d.shape), atol=1e-6)


@pytest.mark.parametrize("change", [lambda x: x[::-1][::-1], lambda x: np.asfortranarray(x)])
def test_arrays_laid_out_otherwise_are_the_same(change) -> None:
    odd = jax.tree.map(change, log())
    np.testing.assert_array_equal(ways(odd), ways(log()))


def test_an_empty_record_is_said_to_be_empty() -> None:
    for cut in (np.s_[:0], np.s_[:, :0]):
        with pytest.raises(BadInput, match="the record is empty"):
            ways(jax.tree.map(lambda x, cut=cut: x[cut], log()))


def test_a_record_of_one_step_is_learned_from() -> None:
    one = jax.tree.map(lambda x: x[:1], log())
    one = dataclasses.replace(one, last=~one.valid | True)
    assert ways(one, goal_horizon=1).shape == (2, 3, 3)
    with pytest.raises(BadInput, match="no episode lasts goal_horizon = 2 steps"):
        ways(one, goal_horizon=2)


@pytest.mark.parametrize("wrong", [1.5, 0, -1, True, "20", np.nan, 10**30, None])
def test_a_goal_horizon_that_is_no_number_of_steps_is_refused(wrong: Any) -> None:
    with pytest.raises(BadInput, match="goal_horizon must be"):
        ways(log(), goal_horizon=wrong)


def walking(yaw: np.ndarray, aside: float = 0.0) -> tuple[Experience, np.ndarray]:
    """A log of walking along `yaw [T]` (radians), and a slight lean `[T, B]`."""
    heading = np.tile(yaw[:, None], (1, 3))
    zero = np.zeros_like(heading)
    course = heading + aside
    way = np.cumsum(0.02 * np.stack([np.cos(course), np.sin(course), zero], -1), 0)
    step = np.diff(way, axis=0, prepend=0 * way[:1])
    first, last = np.zeros((2, *heading.shape), bool)
    first[0], last[-1] = True, True
    lean = np.abs(np.random.default_rng(0).normal(0.02, 0.01, heading.shape))
    made = Experience(
        s=None, o=way - step, o_next=way, a=np.zeros((*heading.shape, 2)), first=first, last=last,
        valid=~last | True,
    )  # fmt: skip
    return made, lean


@pytest.mark.parametrize("aside", [0.0, np.pi / 2, np.pi])
def test_degrees_that_turn_slowly_are_refused_and_radians_are_not(aside: float) -> None:
    yaw = np.linspace(0, 4 * np.pi, 600)
    made, lean = walking(yaw, aside)
    heading = np.tile(yaw[:, None], (1, 3))
    velocity = np.zeros((600, 3, 3))
    s = np.concatenate([np.stack([lean, lean, heading], -1), velocity], -1)
    samples(Euler(), made.replace(s=s))
    if aside:  # who goes sideways does not tell them apart
        return
    s[..., :3] = np.degrees(s[..., :3])
    s[..., :2] = np.clip(s[..., :2], -1.5, 1.5)
    assert np.abs(np.diff(s[..., 2], axis=0)).max() < 2 and s.max() > 719
    with pytest.raises(BadInput, match=r"'orientation' fits .* degrees: the unit is the radian"):
        samples(Euler(), made.replace(s=s))


@pytest.mark.parametrize("aside", [0.0, np.pi / 2, np.pi])
def test_ros_quaternions_of_a_robot_that_leans_are_refused_and_others_are_not(aside: float) -> None:
    yaw = 0.5 * np.sin(np.linspace(0, 9, 600))
    made, lean = walking(yaw, aside)
    w, z = np.cos(yaw / 2)[:, None] + 0 * lean, np.sin(yaw / 2)[:, None] + 0 * lean
    q = np.stack([w, lean, 0 * lean, z], -1)
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    velocity = np.zeros((600, 3, 3))
    samples(Mine(), made.replace(s=np.concatenate([q, velocity], -1)))
    if aside == 0:
        ros = np.concatenate([q[..., [1, 2, 3, 0]], velocity], -1)
        with pytest.raises(BadInput, match=r"the order is \(w, x, y, z\)"):
            samples(Mine(), made.replace(s=ros))


@pytest.mark.parametrize("wrong", ["a\nb", "\x1b[2J", "  ", "", "a/b", ".hidden", 7, None])
def test_names_that_reach_a_terminal_or_a_path_are_checked(wrong: Any) -> None:
    with pytest.raises(BadInput, match="the name of a robot must"):
        type("Wrong", (Mine,), {"name": wrong})
    if wrong not in ("a/b", ".hidden"):  # of a field nothing is named
        with pytest.raises(BadInput, match="the name of a field must"):
            symmetry.vector(wrong)
