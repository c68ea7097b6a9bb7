"""Paths of a least turning radius, against Dubins' own words and a car that cannot turn tighter."""

from __future__ import annotations

import math

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import TURN_RATE, Point

from genidm.errors import BadInput
from genidm.evaluation.planners import ArcPlanner, first_unreached, shortest_turns
from genidm.evaluation.waypoints import WaypointRuns, WaypointSettings, follow_waypoints

TURN = 2 * math.pi


def length(x: float, y: float, radius: float = 1.0) -> float:
    return float(shortest_turns(jnp.float32(x), jnp.float32(y), radius).length.sum(-1))


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (4.0, 0.0, 4.0),  # straight ahead
        (0.0, 0.0, 0.0),
        (1.0, 1.0, math.pi / 2),  # a quarter of a circle to the left
        (0.0, -2.0, math.pi),  # half a circle to the right
        (-3.0, 2.0, math.pi + 3.0),  # half a circle and back
        # Straight behind, by the tangent from (−2, 0) to the circle around (0, 1).
        (-2.0, 0.0, math.pi + 2 * math.atan(1 / 2) + 2.0),
        # The centre of the left circle: the centre of the right arc, that of the left arc and the
        # point are a triangle of sides 2, 2 and 1.
        (0.0, 1.0, math.acos(7 / 8) + TURN - math.acos(1 / 4)),
    ],
)
def test_lengths_that_are_known(x: float, y: float, expected: float) -> None:
    assert length(x, y) == pytest.approx(expected, abs=1e-4)
    assert length(x, -y) == pytest.approx(expected, abs=1e-4)
    assert length(3 * x, 3 * y, radius=3.0) == pytest.approx(3 * expected, abs=4e-4)


def dubins(alpha: np.ndarray, beta: np.ndarray, d: float) -> np.ndarray:
    """Length of Dubins' path of radius 1 from heading alpha to beta, d apart along +x.

    The six words as Shkel and Lumelsky, "Classification of the Dubins set" (2001), give them.
    """
    sa, sb, ca, cb = np.sin(alpha), np.sin(beta), np.cos(alpha), np.cos(beta)
    apart = np.cos(alpha - beta)

    def root(x: np.ndarray) -> np.ndarray:
        return np.sqrt(np.where(x >= 0, x, np.nan))

    lsl, rsr = (root(2 + d**2 - 2 * apart + 2 * d * k * (sa - sb)) for k in (1, -1))
    lsr, rsl = (root(d**2 - 2 + 2 * apart + 2 * d * k * (sa + sb)) for k in (1, -1))
    left, right = np.arctan2(cb - ca, d + sa - sb), np.arctan2(ca - cb, d - sa + sb)
    to_right = np.arctan2(-ca - cb, d + sa + sb) - np.arctan2(-2, lsr)
    to_left = np.arctan2(ca + cb, d - sa - sb) - np.arctan2(2, rsl)
    words = [
        (left - alpha) % TURN + lsl + (beta - left) % TURN,
        (alpha - right) % TURN + rsr + (right - beta) % TURN,
        (to_right - alpha) % TURN + lsr + (to_right - beta) % TURN,
        (alpha - to_left) % TURN + rsl + (beta - to_left) % TURN,
    ]
    for side in (1, -1):  # RLR, LRL
        cosine = (6 - d**2 + 2 * apart + side * 2 * d * (sa - sb)) / 8
        middle = TURN - np.arccos(np.where(abs(cosine) <= 1, cosine, np.nan))
        first = (side * alpha - np.arctan2(ca - cb, d - side * (sa - sb)) + middle / 2) % TURN
        words.append(first + middle + (side * (alpha - beta) - first + middle) % TURN)
    return np.nanmin(words, axis=0)


def test_no_dubins_path_to_any_final_heading_is_shorter() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (150, 2))
    points[:50] *= 0.5  # many of them inside the two circles
    final = np.linspace(0, TURN, 2880, endpoint=False)
    for x, y in points:
        towards, apart = math.atan2(y, x), math.hypot(x, y)
        best = dubins(np.full_like(final, -towards), final - towards, apart).min()
        assert length(x, y) == pytest.approx(best, abs=2e-4)


def test_the_path_leads_to_the_point_and_turns_no_tighter() -> None:
    x, y = np.random.default_rng(1).uniform(-4, 4, (2, 500)).astype(np.float32)
    path = shortest_turns(jnp.asarray(x), jnp.asarray(y), 1.5)
    total = path.length.sum(-1)
    np.testing.assert_allclose(path.at(total)[:, :2], np.stack([x, y], -1), atol=4e-4)
    steps = jnp.linspace(0, 1, 201)[:, None] * total
    walked = np.asarray(jax.vmap(path.at)(steps))[..., :2]
    pieces = np.diff(walked, axis=0)
    np.testing.assert_allclose(np.linalg.norm(pieces, axis=-1).sum(0), total, rtol=1e-3)
    course = np.unwrap(np.arctan2(pieces[..., 1], pieces[..., 0]), axis=0)
    bend = np.abs(np.diff(course, axis=0)) / (np.asarray(total) / 200)
    assert bend.max() < 1.02 / 1.5
    assert np.abs(course[0]).max() < 0.02  # it begins ahead


# ── the planner ─────────────────────────────────────────────────────────────────────────────


def plan(planner: ArcPlanner, o: list, waypoint: list, heading: float) -> np.ndarray:
    unreached = jnp.ones((1, 1), bool)
    given = jnp.asarray([o]), jnp.asarray([[waypoint]]), unreached, jnp.asarray([heading])
    return np.asarray(jax.jit(planner)(*given))[0]


def test_the_target_lies_along_the_path() -> None:
    # A quarter of a circle of 2 m to the left of a robot at (1, 1) that faces +y.
    planner = ArcPlanner(turning_radius=2.0, look_ahead=math.pi / 3)
    target = plan(planner, [1.0, 1.0, 0.5], [-1.0, 3.0, 0.5], math.pi / 2)
    angle = math.pi / 6  # look_ahead / radius
    expected = [2 * math.cos(angle) - 1, 1 + 2 * math.sin(angle), 0.5]
    np.testing.assert_allclose(target, expected, atol=1e-5)
    # Its bearing is half of that angle, as docs/extending.md says.
    bearing = math.atan2(target[1] - 1, target[0] - 1) - math.pi / 2
    assert bearing == pytest.approx(planner.look_ahead / (2 * planner.turning_radius), abs=1e-5)


def test_the_target_rises_with_the_path_and_ends_at_the_waypoint() -> None:
    planner = ArcPlanner(look_ahead=1.0)
    np.testing.assert_allclose(plan(planner, [0, 0, 0], [4, 0, 2], 0.0), [1, 0, 0.5], atol=1e-6)
    np.testing.assert_allclose(plan(planner, [0, 0, 0], [0.3, 0, 2], 0.0), [0.3, 0, 2], atol=1e-6)
    assert np.isfinite(plan(planner, [0, 0, 0], [0, 0, 0], 0.0)).all()


def test_the_last_waypoint_stays_the_goal() -> None:
    waypoints, heading = jnp.asarray([[[1.0, 0, 0], [5.0, 0, 0]]] * 3), jnp.zeros(3)
    unreached = jnp.asarray([[True, True], [False, True], [False, False]])
    target = ArcPlanner(1.0, 10.0)(jnp.zeros((3, 3)), waypoints, unreached, heading)
    np.testing.assert_allclose(target[:, 0], [1.0, 5.0, 5.0], atol=1e-6)


def test_settings_are_checked() -> None:
    for wrong in ({"turning_radius": 0.0}, {"look_ahead": -1.0}, {"turning_radius": math.nan}):
        with pytest.raises(BadInput, match=next(iter(wrong))):
            ArcPlanner(**wrong)


# ── a car that always drives at full speed, and turns as tightly as it can if it must ───────

TIGHTEST = 1.0 / TURN_RATE  # metres, at 1 m/s


class Car(flax.struct.PyTreeNode):
    """Drives a Point ahead by pure pursuit: the arc through the target, or its tightest arc."""

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        yaw = Point().observation.yaw(s)
        left = -jnp.sin(yaw) * relative_goal[:, 0] + jnp.cos(yaw) * relative_goal[:, 1]
        bend = 2 * left / jnp.maximum((relative_goal[:, :2] ** 2).sum(-1), 1e-6)
        turn = jnp.clip(bend * TIGHTEST, -1.0, 1.0)
        return jnp.stack([jnp.ones_like(turn), jnp.zeros_like(turn), turn], axis=-1)


def drive(planner, waypoints: list[list[float]], count: int = 4) -> WaypointRuns:
    keys = jax.random.split(jax.random.key(0), count)
    return follow_waypoints(
        Point(), Car(), waypoints, keys, jnp.zeros(count), planner,
        WaypointSettings(max_steps=600, goal_radius=0.15), quiet=True,
    )  # fmt: skip


def test_a_car_circles_a_waypoint_at_its_side_but_not_with_a_plan() -> None:
    """The waypoint is the centre of the car's tightest circle."""
    beside = [[0.0, TIGHTEST]]
    aimed = drive(first_unreached, beside)
    assert (aimed.arrival == -1).all()
    late = np.linalg.norm(aimed.position[:, -100:, :2] - [0.0, TIGHTEST], axis=-1)
    assert late.max() < 2 * TIGHTEST  # it circles
    planned = drive(ArcPlanner(1.2 * TIGHTEST, 0.2), beside)
    assert (planned.arrival > 0).all()
    # The path of 1.2 times the tightest radius, from the origin; the starts lie around it.
    shortest = 1.2 * TIGHTEST * length(0.0, 1 / 1.2)
    assert planned.times.mean() == pytest.approx(shortest - 0.15, abs=0.6)


def test_a_car_that_plans_reaches_five_waypoints_close_together() -> None:
    close = [[1.0, 0.0], [1.0, 0.7], [0.4, 0.4], [0.9, -0.3], [0.0, 0.0]]
    planned, aimed = drive(ArcPlanner(1.2 * TIGHTEST, 0.2), close), drive(first_unreached, close)
    assert planned.summary()["all"] == 1.0 and aimed.summary()["all"] < 1.0
    # It drives where it faces, at full speed.
    assert planned.summary()["heading_error"] < 0.3
    assert planned.summary()["speed"] == pytest.approx(1.0, abs=0.1)
