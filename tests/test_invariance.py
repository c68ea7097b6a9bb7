"""How much actions change under a turn, against controllers with known answers."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point, Straight

from genidm.controller import Controller
from genidm.evaluation.invariance import ANGLES, invariance, probes
from genidm.experience import Experience
from genidm.paper.fit import Fit, training
from genidm.paper.pairs import Pairs
from genidm.robots import Ant, Robot


class Pusher(flax.struct.PyTreeNode):
    """Pushes along the world's axes towards the goal: wherever it faces, it does the same."""

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        return relative_goal


def states(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    """Random states `[count, S]` whose orientations are upright to within some radians."""
    rng, parts = np.random.default_rng(seed), []
    for field in robot.observation.fields:
        x = rng.normal(size=(count, field.size))
        if field.yaw is not None:
            x = x * [1, 0.2, 0.2, 1]
            x *= np.sign(x[:, :1]) / np.linalg.norm(x, axis=-1, keepdims=True)
        parts.append(x)
    return np.concatenate(parts, axis=-1).astype(np.float32)


def record(robot: Robot, steps: int = 50, lanes: int = 40) -> Experience:
    rng, shape = np.random.default_rng(1), (steps, lanes)
    o = rng.normal(size=(*shape, 3)).astype(np.float32)
    s = states(robot, steps * lanes).reshape(*shape, -1)
    no = np.zeros(shape, bool)
    return Experience(s, o, o, np.zeros((*shape, robot.action.size)), no, no, ~no)


def untrained(robot: Robot, input_frame) -> Controller:
    """An IDM that has learned nothing; normalised by states that it may see."""
    s = np.asarray(states(robot, 500, seed=2))[None]
    d = np.tile(np.float32([1, 0, 0]), (1, 500, 1))
    samples = Pairs(s, d, np.zeros((500, robot.action.size), np.float32))
    learner, _ = training(robot, samples, jax.random.key(0), Fit(idm=(32,)), input_frame)
    return learner.model


def test_a_controller_in_the_worlds_frame_changes_by_the_chord() -> None:
    """‖R d − d‖ = 2 sin(θ/2) of the horizontal part of d, whatever the state."""
    robot = Point()
    s, relative_goal = probes(robot, record(robot))
    changes = invariance(robot, Pusher(), s, relative_goal, ANGLES)
    assert changes.shape == (13, 1000)
    level = np.linalg.norm(relative_goal[:, :2], axis=-1)
    expected = 2 * np.sin(ANGLES / 2)[:, None] * level
    np.testing.assert_allclose(changes, expected, atol=1e-5)


def test_a_controller_in_its_own_frame_does_not_change() -> None:
    robot = Point()
    asked = probes(robot, record(robot))
    assert invariance(robot, Straight(jnp.float32(1.0), robot), *asked, ANGLES).max() < 1e-5


@pytest.mark.parametrize("robot", [Point(), Ant()], ids=lambda robot: robot.name)
def test_the_heading_frame_is_invariant_to_float_noise_and_the_worlds_is_not(robot: Robot) -> None:
    asked = probes(robot, record(robot))
    heading = invariance(robot, untrained(robot, "heading"), *asked, ANGLES)
    world = invariance(robot, untrained(robot, "world"), *asked, ANGLES)
    assert heading.max() < 1e-4
    assert np.median(world[1:], axis=1).min() > 1e-2
    assert world[0].max() == 0.0, "no turn, no change"


def test_probes_are_states_of_the_record_with_goals_as_in_the_test() -> None:
    robot = Point()
    there = record(robot)
    s, relative_goal = probes(robot, there)
    assert s.shape == (1000, robot.observation.size) and relative_goal.shape == (1000, 3)
    at = {row.tobytes(): i for i, row in enumerate(there.s.reshape(2000, -1))}
    drawn = [at[np.asarray(x).tobytes()] for x in s]
    assert len(set(drawn)) == 1000, "none is drawn twice"
    o = there.o.reshape(2000, 3)[drawn]
    level = np.linalg.norm(relative_goal[:, :2], axis=-1)
    np.testing.assert_allclose(level, 3.0, rtol=1e-5)
    np.testing.assert_allclose(relative_goal[:, 2], robot.standing_height - o[:, 2], atol=1e-6)
    angle = np.arctan2(relative_goal[:, 1], relative_goal[:, 0]) - robot.observation.yaw(s)
    bearing = (angle + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(bearing).max() <= np.pi / 4 + 1e-5
    assert bearing.max() > 0.7 and bearing.min() < -0.7


def test_probes_leave_out_what_diverged_and_are_no_more_than_there_are() -> None:
    robot, there = Point(), record(Point())
    valid = np.zeros(there.valid.shape, bool)
    valid[7, 3:9] = True
    s, relative_goal = probes(robot, there.replace(valid=valid))
    assert relative_goal.shape == (6, 3)
    np.testing.assert_array_equal(np.asarray(s), there.s[7, 3:9])


def test_a_goal_is_no_farther_than_the_robots_test_has_them() -> None:
    class Near(Point):
        target_distance = (1.5, 2.5)

    _, relative_goal = probes(Near(), record(Point()))
    np.testing.assert_allclose(np.linalg.norm(relative_goal[:, :2], axis=-1), 2.5, rtol=1e-5)


def test_probes_are_the_same_every_time_and_others_with_another_seed() -> None:
    robot, there = Point(), record(Point())
    for a, b in zip(probes(robot, there), probes(robot, there), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(probes(robot, there)[0], probes(robot, there, seed=1)[0])
