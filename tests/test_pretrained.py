"""Controllers that come with genidm."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from genidm.controller import PRETRAINED, pretrained
from genidm.errors import BadInput
from genidm.files import load_json
from genidm.robots import ROBOTS

NAMES = sorted(path.name for path in PRETRAINED.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_it_steers_the_robot_that_it_is_named_after(name: str) -> None:
    steering = pretrained(name)
    robot = steering.robot
    assert robot.name == name == load_json(PRETRAINED / name / "done.json")["robot"]
    state = jax.jit(robot.reset)(jax.random.split(jax.random.key(0), 4), jnp.zeros(4))
    left, right = (jnp.tile(jnp.asarray([0.5, y, 0.0]), (4, 1)) for y in (3.0, -3.0))
    actions = np.asarray([steering(state.observation, way) for way in (left, right)])
    assert np.isfinite(actions).all() and np.abs(actions).max() <= 1
    assert np.abs(actions[0] - actions[1]).max() > 0.05  # it minds where it is to go


def test_there_is_none_for_others() -> None:
    assert "ant" in NAMES and set(NAMES) <= set(ROBOTS)
    with pytest.raises(BadInput, match="no controller comes for 'cat'; there are some for: ant"):
        pretrained("cat")
