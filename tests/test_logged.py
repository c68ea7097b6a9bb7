"""From logs without a simulator to a controller, as the README has it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import tiny

from genidm import controller, symmetry
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.fit import fit
from genidm.generalize import Generalize, generalize
from genidm.methods import LR
from genidm.robots import Logged
from genidm.symmetry import Layout


class Mine(Logged):
    name = "mine"
    control_step = 0.02
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
    pairs, residual = generalize(robot, log(), jax.random.key(0), rotate, look_ahead=20)
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


def test_a_look_ahead_that_leaves_little_is_said() -> None:
    with pytest.warns(UserWarning, match="look_ahead 50 leaves 33 of 180 steps"):
        generalize(Mine(), log(), jax.random.key(0), Generalize(mode="rotate"), look_ahead=50)


def test_what_is_told_of_other_sizes_is_refused() -> None:
    for s, way in (((7,), (2,)), ((7,), (1,)), ((6,), (3,)), ((2, 7), (3,))):
        with pytest.raises(BadInput, match=r"s \[..., 7\] and a way \[..., 3\]"):
            Mine().heard(np.zeros(s), np.zeros(way))


def test_a_look_ahead_longer_than_all_episodes_is_said() -> None:
    with pytest.raises(BadInput, match="no episode lasts look_ahead = 61 steps"):
        generalize(Mine(), log(), jax.random.key(0), Generalize(mode="rotate"), look_ahead=61)


def test_nothing_can_be_stepped() -> None:
    robot = Mine()
    for call in (robot.reset, robot.step, robot.place, robot.cost):
        with pytest.raises(BadInput, match="known by its logs alone"):
            call(None, None)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (dict(a=3 * log().a), r"a lies outside \[−1, 1\]"),
        (dict(last=log().last.astype(int)), "last is of int64, not bool"),
        (dict(first=log().first[:, 0]), r"first has shape \(60,\), not that of \[steps, lanes\]"),
        (dict(o=log().o[..., :2]), "o has shape"),
        (dict(s=-log().s), "'orientation' in s is not of length 1 with w ≥ 0"),
        (dict(s=2 * log().s), "'orientation' in s is not of length 1 with w ≥ 0"),
    ],
)
def test_logs_that_are_none_are_refused(changes: dict, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        generalize(
            Mine(), dataclasses.replace(log(), **changes), jax.random.key(0),
            Generalize(mode="rotate"), look_ahead=20,
        )  # fmt: skip
