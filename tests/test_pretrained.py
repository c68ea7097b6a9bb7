"""Controllers that come with genidm."""

from __future__ import annotations

import functools
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from genidm.controller import PRETRAINED, load, pretrained
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings, evaluate
from genidm.evaluation.scenarios import scenarios
from genidm.files import load_json, verify
from genidm.robots import ROBOTS, Ant

Change = Callable[[jax.Array], jax.Array]
NAMES = sorted(path.name for path in PRETRAINED.iterdir())


def kept(way: jax.Array) -> jax.Array:
    return way


def anothers(way: jax.Array) -> jax.Array:
    """To the target of the next robot."""
    return jnp.roll(way, 1, axis=0)


def mirrored(way: jax.Array) -> jax.Array:
    return way * jnp.asarray([1.0, -1.0, 1.0])


def away(way: jax.Array) -> jax.Array:
    return -way


def changed(change: Change, controller: Any, s: jax.Array, way: jax.Array) -> jax.Array:
    return controller(s, change(way))


@pytest.mark.parametrize("name", NAMES)
def test_it_steers_the_robot_that_it_is_named_after(name: str) -> None:
    controller = pretrained(name)
    robot = controller.robot
    assert robot.name == name == load_json(PRETRAINED / name / "done.json")["robot"]
    state = jax.jit(robot.reset)(jax.random.split(jax.random.key(0), 4), jnp.zeros(4))
    left, right = (jnp.tile(jnp.asarray([0.5, y, 0.0]), (4, 1)) for y in (3.0, -3.0))
    actions = np.asarray([controller(state.observation, way) for way in (left, right)])
    assert np.isfinite(actions).all() and np.abs(actions).max() <= 1
    assert np.abs(actions[0] - actions[1]).max() > 0.05  # it minds where it is to go


# ── how near it gets ────────────────────────────────────────────────────────────────────


@functools.cache
def closest(change: Change = kept) -> np.ndarray:
    """Closest distance `[48]`, metres, of the Ant's controller, told another way to the target."""
    ant = Ant(engine="mujoco")
    controller = jax.tree_util.Partial(
        functools.partial(changed, change), load(PRETRAINED / "ant", ant)
    )
    tested_scenarios = scenarios(ant, seeds=2, episodes=24)
    return evaluate(
        ant,
        controller,
        tested_scenarios,
        EvaluationSettings(max_steps=300, num_envs=48),
        quiet=True,
    ).closest


def test_the_ant_goes_to_its_targets() -> None:
    """Within 15 s; on 10 × 1000 episodes of 50 s the mean is 0.18 m."""
    far = closest()
    assert far.mean() < 0.4 and np.mean(far <= 0.5) > 0.85


@pytest.mark.parametrize("change", [anothers, mirrored, away])
def test_told_another_way_it_goes_there(change: Change) -> None:
    """So the bound above is none that any controller keeps."""
    assert closest(change).mean() > 1.0


def test_there_is_none_for_others() -> None:
    assert "ant" in NAMES and set(NAMES) <= set(ROBOTS)
    with pytest.raises(BadInput, match="no pretrained controller for 'cat'; available: ant"):
        pretrained("cat")


def test_a_clone_that_turns_line_ends_leaves_it_whole(tmp_path: Path) -> None:
    """As git on Windows does: but for .gitattributes no file is as its manifest has it."""
    root = Path(__file__).parents[1]
    if not shutil.which("git") or not (root / ".git").exists():
        pytest.skip("there is no git here, or this is no clone")
    clone = ["git", "clone", "-q", "-c", "core.autocrlf=true", "--no-hardlinks", str(root), "there"]
    subprocess.run(clone, cwd=tmp_path, check=True, capture_output=True)
    there = tmp_path / "there"
    assert b"\r\n" in (there / "pyproject.toml").read_bytes()  # line ends were turned
    for name in NAMES:
        assert verify(there / "genidm" / "pretrained" / name / "controller")
        load(there / "genidm" / "pretrained" / name)
