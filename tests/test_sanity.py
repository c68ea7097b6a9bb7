"""A controller that stands still, or does not mind where it is to go, is told of."""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point, Straight

from genidm import symmetry
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.evaluate import EvaluationSettings, evaluate, trace
from genidm.evaluation.sanity import heeds, walked
from genidm.evaluation.scenarios import FIG8_EPISODES, fig8_scenarios, scenarios

ROBOT = Point()


@pytest.mark.parametrize(("pace", "share"), [(1.0, 1.0), (0.0, 0.0), (0.02, 0.08), (-1.0, None)])
def test_how_far_it_walks_is_told_and_that_it_does_not(pace: float, share, capsys) -> None:
    tested_scenarios = scenarios(ROBOT, 1, 20)
    found = evaluate(
        ROBOT,
        Straight(jnp.float32(pace), ROBOT),
        tested_scenarios,
        EvaluationSettings(300),
        quiet=True,
    )
    capsys.readouterr()
    got = walked("LR", found)["walked"]
    expected = found.path_length.mean() / found.start.mean()
    assert got == pytest.approx(expected, rel=1e-5)
    if share is not None:
        assert got == pytest.approx(share, abs=0.05)
    # To flee is to move.
    assert ("warning: LR hardly moves" in capsys.readouterr().err) == (abs(pace) < 0.1)


def test_episodes_that_diverged_are_in_no_mean(capsys) -> None:
    one = np.ones((1, 4))
    found = Episodes(
        closest=one, start=4 * one, reached=one > 2, fell=one > 2, steps=one,
        diverged=np.array([[True, False, True, False]]),
        path_length=np.array([[99.0, 1.0, np.nan, 3.0]]),
    )  # fmt: skip
    assert walked("GE", found) == {"walked": 0.5} and capsys.readouterr().err == ""
    gone = dataclasses.replace(found, diverged=one > 0)
    assert walked("GE", gone) == {"walked": 0.0}


class Elsewhere(flax.struct.PyTreeNode):
    """Steers a point to where it is told, turned by an angle from ± `spread`."""

    spread: jax.Array
    straight: Straight

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        a = self.straight(s, relative_goal)
        angle = self.spread * jnp.sin(1e4 * relative_goal[:, 0].sum() + 1e4 * relative_goal[:, 1])
        return symmetry.rotate_vector(a, angle)


class Ahead(flax.struct.PyTreeNode):
    """Walks straight ahead, whatever it is told."""

    pace: jax.Array

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        return jnp.zeros_like(relative_goal).at[:, 0].set(self.pace)


TO_THE_TARGET = Straight(jnp.float32(1.0), ROBOT)


@pytest.mark.parametrize(
    ("controller", "minds"),
    [
        (TO_THE_TARGET, True), (Straight(jnp.float32(0.1), ROBOT), True),
        (Ahead(jnp.float32(1.0)), False), (Ahead(jnp.float32(0.0)), False),
        (Elsewhere(jnp.float32(np.pi), TO_THE_TARGET), False),
        (Straight(jnp.float32(-1.0), ROBOT), False),
    ],
    ids=["to the target", "slowly", "ahead", "still", "at random", "away"],
)  # fmt: skip
def test_whether_it_minds_where_it_is_to_go_is_told(controller, minds: bool, capsys) -> None:
    walks = fig8_scenarios(ROBOT)
    _, ways = trace(ROBOT, controller, walks, EvaluationSettings(200))
    capsys.readouterr()
    target = np.asarray(walks.target)
    found, said = heeds("HF", ways, target)["heeds"], capsys.readouterr().err
    assert ("warning: HF hardly reacts to its goal" in said) == (not minds), found
    bearing = np.linspace(-np.pi / 4, np.pi / 4, FIG8_EPISODES)
    pairs = np.cos(bearing[:, None] - bearing).sum() - FIG8_EPISODES
    if minds:  # each way is that to its own target
        assert found == pytest.approx(1 - pairs / (FIG8_EPISODES * (FIG8_EPISODES - 1)), abs=0.01)
    if isinstance(controller, Ahead):
        assert found == pytest.approx(0, abs=0.01)
