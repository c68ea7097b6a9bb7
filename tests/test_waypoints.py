"""Runs through waypoints, on a point whose every journey has a closed form."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point, Straight

from genidm import devices
from genidm.errors import BadInput
from genidm.evaluation.waypoints import (
    WaypointRuns,
    WaypointSettings,
    first_unreached,
    follow_waypoints,
)
from genidm.report.waypoint_figure import draw_waypoint_runs

WAYPOINTS = np.array([[2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
SETTINGS = WaypointSettings(max_steps=300, goal_radius=0.2, chunk=40)
COUNT = 5


def journey(robot: Point, pace: float = 1.0, **changes) -> WaypointRuns:
    keys, yaw = jax.random.split(jax.random.key(0), COUNT), jnp.linspace(-1, 1, COUNT)
    given = dict(waypoints=WAYPOINTS, settings=SETTINGS) | changes
    return follow_waypoints(
        robot, Straight(jnp.float32(pace), robot), keys=keys, yaw=yaw, quiet=True, **given
    )


@pytest.fixture(scope="module")
def made() -> WaypointRuns:
    return journey(Point())


def one_way(
    start: np.ndarray, step: float, goal_radius: float
) -> tuple[list[np.ndarray], list[int]]:
    """Positions after each step straight at the waypoint whose turn it is, and arrivals."""
    o, way, arrivals = start.copy(), [start.copy()], []
    for t in range(1, SETTINGS.max_steps + 1):
        to = WAYPOINTS[len(arrivals)] - o
        o = o + step * to / np.linalg.norm(to)
        way.append(o.copy())
        if np.linalg.norm(WAYPOINTS[len(arrivals)] - o) <= goal_radius:
            arrivals.append(t)
        if len(arrivals) == len(WAYPOINTS):
            break
    return way, arrivals


def test_every_journey_is_the_closed_form(made: WaypointRuns) -> None:
    for i in range(COUNT):
        way, arrivals = one_way(np.float64(made.position[i, 0, :2]), 0.05, SETTINGS.goal_radius)
        assert made.arrival[i].tolist() == arrivals and made.steps[i] == arrivals[-1]
        np.testing.assert_allclose(made.position[i, : len(way), :2], way, atol=1e-4)
        after = made.position[i, len(way) :]
        np.testing.assert_array_equal(
            after, np.broadcast_to(made.position[i, len(way) - 1], after.shape)
        )
    assert not made.fell.any() and made.position.shape[1] == made.steps.max() + 1
    np.testing.assert_allclose(made.times, 0.05 * made.arrival)


def test_cross_track_error_is_the_distance_from_the_leg(made: WaypointRuns) -> None:
    for i in range(COUNT):
        corners = np.concatenate([made.position[i, :1, :2], WAYPOINTS])
        for t in range(made.steps[i] + 1):
            leg = int(np.sum(made.arrival[i] < t))
            dense = np.linspace(corners[leg], corners[leg + 1], 20001)
            apart = np.linalg.norm(dense - made.position[i, t, :2], axis=1).min()
            assert made.cross_track_error[i, t] == pytest.approx(apart, abs=2e-3)
        assert np.isnan(made.cross_track_error[i, made.steps[i] + 1 :]).all()
    # A robot that turns at 0.2 m before a corner has left the leg there, and never further.
    assert 0.1 < np.nanmax(made.cross_track_error) <= SETTINGS.goal_radius + 1e-6


def test_heading_error_is_between_heading_and_course(made: WaypointRuns) -> None:
    i, t, side = 2, 30, 5  # a quarter of a second of 0.05 s steps
    step = made.position[i, t + side] - made.position[i, t - side]
    expected = abs(math.remainder(made.heading[i, t] - math.atan2(step[1], step[0]), 2 * math.pi))
    assert made.heading_error[i, t] == pytest.approx(expected, abs=1e-5)
    assert np.isnan(made.heading_error[i, made.steps[i] + 1 :]).all()


def test_speed_is_that_of_the_point(made: WaypointRuns) -> None:
    """1 m/s, but for the half second around a corner, where the way is longer than the line."""
    for i in range(COUNT):
        speed, steps = made.speed[i], made.steps[i]
        corner = np.abs(np.arange(steps + 1)[:, None] - made.arrival[i, :2]).min(1) <= 5
        np.testing.assert_allclose(speed[: steps + 1][~corner], 1.0, atol=1e-3)
        assert (speed[: steps + 1][corner] <= 1.001).all() and np.isnan(speed[steps + 1 :]).all()
    np.testing.assert_allclose(made.leg_speed, 1.0, atol=0.06)
    slow = journey(Point(), pace=0.5).summary()
    assert slow["speed"] == pytest.approx(0.5, abs=0.02) and slow["all"] == 1.0
    assert journey(Point(), pace=0.0).heading_error.size
    assert journey(Point(), pace=0.0).summary()["heading_error"] is None


def test_the_typical_run_is_the_median_one() -> None:
    still = np.zeros((5, 11, 3))
    arrival = np.asarray([[5, -1], [3, 7], [4, 9], [-1, -1], [3, 8]])
    steps = np.asarray([10, 7, 9, 10, 8])
    runs = WaypointRuns(
        np.zeros((5, 2, 3)), still, still[..., 0], steps, arrival, np.zeros(5, bool), 0.1
    )
    assert runs.typical == 2  # better: 1 and 4, which are faster; worse: 0 and 3
    found = runs.summary()
    assert found["all"] == 0.6 and found["reached"] == [0.8, 0.6] and found["speed"] == 0.0
    assert found["seconds"] == pytest.approx([0.375, 0.8])


def test_the_number_of_devices_changes_nothing(made: WaypointRuns) -> None:
    alone = journey(Point(), mesh=devices.mesh(jax.devices()[:1]))
    np.testing.assert_array_equal(alone.arrival, made.arrival)
    np.testing.assert_allclose(alone.position, made.position, atol=1e-5)


def test_who_falls_or_is_late_has_reached_what_it_has_reached() -> None:
    fallen = journey(Point(falls_at=2.1))
    assert (
        fallen.fell.all()
        and (fallen.arrival[:, 0] > 0).all()
        and (fallen.arrival[:, 1] == -1).all()
    )
    late = journey(Point(), settings=WaypointSettings(max_steps=60, goal_radius=0.2, chunk=40))
    assert (late.steps == 60).all() and not late.fell.any() and late.position.shape[1] == 61
    assert np.isnan(late.times[:, 1:]).all()
    found = late.summary()
    assert found["reached"] == [1.0, 0.0, 0.0] and found["seconds"][1] is None
    assert found["cross_track_error"] < 0.2 and found["runs"] == COUNT


def test_any_planner_will_do() -> None:
    """One that goes round the outside of each corner."""

    def outside(o: jax.Array, waypoints: jax.Array, left: jax.Array) -> jax.Array:
        return first_unreached(o, waypoints, left) + jnp.asarray([0.1, 0.0, 0.0])

    there = journey(Point(), planner=outside)
    assert (there.arrival > 0).all() and there.position[..., 0].max() > 2.0


def test_a_planner_sees_the_heading_if_it_has_an_argument_for_it() -> None:
    def abreast(o: jax.Array, waypoints: jax.Array, left: jax.Array, heading: jax.Array):
        return o + jnp.stack([-jnp.sin(heading), jnp.cos(heading), 0 * heading], axis=-1)

    for planner in (abreast, jax.jit(abreast), functools.partial(abreast)):
        there = journey(Point(), planner=planner, settings=WaypointSettings(4, 0.2, chunk=4))
        step = there.position[:, 1] - there.position[:, 0]
        side = np.arctan2(step[:, 1], step[:, 0]) - there.heading[:, 0]
        np.testing.assert_allclose(np.cos(side - np.pi / 2), 1.0, atol=1e-4)


@pytest.mark.parametrize(
    ("planner", "answer"),
    [
        (
            lambda o, waypoints, left: first_unreached(o, waypoints, left)[:, :2],
            r"float32\[\d, 2\]",
        ),
        (lambda o, waypoints, left: o[:, :1], r"float32\[\d, 1\]"),
        (lambda o, waypoints, left: o[0], r"float32\[3\]"),
        (lambda o, waypoints, left: o.sum(), r"float32\[\]"),
        (lambda o, waypoints, left: left[:, :3], r"bool\[\d, 3\]"),
        (lambda o, waypoints, left: waypoints, r"float32\[\d, 3, 3\]"),
        (lambda o, waypoints, left: None, "None"),
        (lambda o, waypoints, left: 1.0, r"1\.0"),
        (lambda o, waypoints, left: [2.0, 0.0, 0.5], r"\[2\.0, 0\.0, 0\.5\]"),
    ],
)
def test_a_planner_that_answers_something_else_is_refused(planner, answer: str) -> None:
    said = rf"the planner must return .* of shape \(\d, 3\), one row per robot, not {answer}"
    with pytest.raises(BadInput, match=said):
        journey(Point(), planner=planner)


@pytest.mark.parametrize(
    "planner",
    [
        lambda o, waypoints, left: np.asarray(waypoints)[:, 0],
        lambda o, waypoints, left: waypoints[:, 0] if left.any() else o,
        lambda o, waypoints, left: waypoints[:, int(left.sum())],
        lambda o, waypoints, left: o + [float(x) for x in o[0]],
    ],
)
def test_a_planner_that_looks_at_numbers_on_the_host_is_told_how_to(planner) -> None:
    with pytest.raises(BadInput, match="the planner is called inside a compiled program"):
        journey(Point(), planner=planner)


def test_a_planner_may_answer_with_numpys_constant() -> None:
    """So long as it has a row a robot: of each device its own robots."""
    ahead = journey(
        Point(),
        planner=lambda o, w, left: np.full(o.shape, 3.0),
        mesh=devices.mesh(jax.devices()[:1]),
    )
    assert (ahead.arrival == -1).all()
    np.testing.assert_allclose(ahead.position[:, -1, :2], 3.0, atol=0.1)


@pytest.mark.parametrize(
    "controller", [lambda s, way: s, lambda s, way: way[0], lambda s, way: None]
)
def test_a_controller_that_answers_something_else_is_refused(controller) -> None:
    keys = jax.random.split(jax.random.key(0), 2)
    with pytest.raises(BadInput, match=r"the controller must return .* of shape \(1, 3\)"):
        follow_waypoints(Point(), controller, WAYPOINTS, keys, np.zeros(2), quiet=True)


def test_waypoints_may_have_a_height_and_must_be_finite() -> None:
    level = journey(Point(), waypoints=np.c_[WAYPOINTS, [0.5] * 3])
    np.testing.assert_array_equal(level.waypoints[..., 2], 0.5)
    for wrong in (np.zeros((0, 2)), np.zeros(3), [[1.0, np.nan]], np.zeros((2, 4))):
        with pytest.raises(BadInput, match="waypoints"):
            journey(Point(), waypoints=wrong)
    with pytest.raises(BadInput, match="all of the same length"):
        journey(Point(), waypoints=[[1.0, 2.0], [3.0]])
    with pytest.raises(BadInput, match=r"goal_radius must lie in \(0, ∞\)"):
        WaypointSettings(goal_radius=0.0)


def test_a_robot_has_a_key_and_a_yaw() -> None:
    keys = jax.random.split(jax.random.key(0), 2)
    for yaw in (np.zeros(3), 0.0):
        with pytest.raises(BadInput, match=r"keys \[B\] and yaw \[B\]"):
            follow_waypoints(Point(), lambda s, way: way, WAYPOINTS, keys, yaw)
    with pytest.raises(BadInput, match="there are no robots"):
        follow_waypoints(Point(), lambda s, way: way, WAYPOINTS, keys[:0], np.zeros(0))


def test_each_robot_may_have_waypoints_of_its_own(made: WaypointRuns) -> None:
    shift = np.linspace(0.0, 1.0, COUNT)[:, None, None] * [1.0, -1.0]
    own = journey(Point(), waypoints=WAYPOINTS + shift)
    np.testing.assert_allclose(own.waypoints[..., :2], WAYPOINTS + shift, atol=1e-6)
    np.testing.assert_array_equal(own.position[0, : own.steps[0]], made.position[0, : own.steps[0]])
    for i in range(COUNT):
        assert own.steps[i] == own.arrival[i, -1]
        reached = own.position[i, own.arrival[i], :2]
        apart = np.linalg.norm(reached - own.waypoints[i, :, :2], axis=-1)
        assert (apart <= SETTINGS.goal_radius + 1e-6).all() and (
            apart > SETTINGS.goal_radius - 0.06
        ).all()
    with pytest.raises(BadInput, match="for each of the 5"):
        journey(Point(), waypoints=np.zeros((COUNT - 1, 3, 2)))


def test_what_is_recorded_is_kept_of_every_state(made: WaypointRuns) -> None:
    kept = journey(
        Point(), record=lambda state: {"s": state.observation, "x": state.physics}
    ).recorded
    assert kept["s"].shape[:2] == made.heading.shape and made.recorded == ()
    np.testing.assert_array_equal(kept["x"].position, made.position)
    np.testing.assert_array_equal(kept["s"][..., 0], made.position[..., 2])


def test_the_figure_shows_every_method(made: WaypointRuns, tmp_path: Path) -> None:
    fig = draw_waypoint_runs({"LR": made, "VGCP": made}, SETTINGS.goal_radius, tmp_path / "w.png")
    assert (tmp_path / "w.png").stat().st_size > 10_000
    above, speed, error = fig.axes[0], fig.axes[2], fig.axes[4]
    assert above.get_title() == "LR: 100% reach all"
    assert {text.get_text() for text in above.texts} == {"1", "2", "3", "100%"}
    ways = [line for line in above.lines if line.get_linestyle() == "-"]
    assert len(ways) == COUNT + 1  # the median one once more, on top
    np.testing.assert_array_equal(
        ways[-1].get_xdata(), made.position[made.typical, : made.steps[made.typical] + 1, 0]
    )
    # At 1 m/s and between corners, a mean over a second changes nothing.
    shown = speed.lines[-1].get_ydata()
    assert shown[20] == pytest.approx(made.speed[made.typical, 20], abs=1e-3)
    middle, around = error.lines[-1].get_ydata()[20], made.heading_error[made.typical, 10:31]
    assert middle == pytest.approx(np.degrees(around.mean()), abs=1e-3)


def test_the_figure_marks_falls(tmp_path: Path) -> None:
    fallen = journey(Point(falls_at=2.1))
    fig = draw_waypoint_runs({"LR": fallen}, SETTINGS.goal_radius, tmp_path / "w.png")
    assert fig.axes[0].get_title() == "LR: 0% reach all, 100% fell"
    falls = [line for line in fig.axes[0].lines if line.get_marker() == "x"]
    ends = fallen.position[np.arange(COUNT), fallen.steps, 0]
    assert [line.get_xdata()[0] for line in falls] == ends.tolist()


def test_the_figure_draws_robots_that_stand_still(tmp_path: Path) -> None:
    still = journey(Point(), pace=0.0, settings=WaypointSettings(20, 0.2, chunk=20))
    fig = draw_waypoint_runs({"LR": still}, SETTINGS.goal_radius, tmp_path / "w.png")
    assert fig.axes[0].get_title() == "LR: 0% reach all" and np.nanmax(still.speed) == 0
