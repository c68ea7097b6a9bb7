"""Agents, 𝒢 and the evaluator on the Minitaur: they have no code of their own for it."""

from __future__ import annotations

import dataclasses
import os
import signal
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import same
from killing import Killed, dies_at
from tiny import AGENTS, TEST

from genidm.agents import collect as collecting
from genidm.agents.collect import collect
from genidm.agents.ppo import PPO
from genidm.agents.sac import SAC
from genidm.evaluation.evaluate import evaluate
from genidm.evaluation.scenarios import scenarios
from genidm.experience import Experience
from genidm.paper.generalize import Generalize, replay, residual
from genidm.progress import Progress
from genidm.robots import Minitaur
from genidm.store import Stage
from genidm.tasks import GoToGoal, WalkForward

pytest.importorskip("pybullet", reason="PyBullet is not installed: there is no wheel of it here")

TASK = WalkForward(episode_steps=30)
STEPS = 5 * 16 * 8
STANDING = jax.tree_util.Partial(lambda s, relative_goal: 0 * s[:, :8])


@pytest.fixture(scope="module")
def robot() -> Minitaur:
    return Minitaur()


def gathered(robot: Minitaur, stage: Stage | None = None) -> tuple[Experience, Any]:
    return collect(robot, AGENTS[PPO], STEPS, task=TASK, stage=stage, quiet=True)


@pytest.fixture(scope="module")
def undisturbed(robot: Minitaur) -> tuple[Experience, Any]:
    return gathered(robot)


def test_a_record_is_kept_whole(robot: Minitaur, undisturbed: tuple[Experience, Any]) -> None:
    record, _ = undisturbed
    record.prepared(robot)
    assert record.s.shape == (STEPS // 16, 16, 17) and record.a.shape == (STEPS // 16, 16, 8)
    assert np.asarray(record.valid).all() and np.asarray(record.first).sum() >= 2 * 16
    at = np.asarray(record.o), np.asarray(record.o_next)
    on = ~np.asarray(record.last)[:-1]
    assert np.array_equal(at[0][1:][on], at[1][:-1][on])


def test_killed_it_goes_on_to_the_same_bits(
    robot: Minitaur, undisturbed: tuple[Experience, Any], tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(collecting, "CHUNK", 2 * 16 * 8)
    stage = Stage.open(tmp_path, "collect", {})
    with monkeypatch.context() as m:
        m.setattr(Progress, "advance", dies_at(4))
        with pytest.raises(Killed):
            gathered(robot, stage)
    same(gathered(robot, stage), undisturbed)


def test_workers_that_are_killed_meanwhile_take_nothing_with_them(
    undisturbed: tuple[Experience, Any], monkeypatch
) -> None:
    robot = Minitaur(processes=3)
    advance, shot = Progress.advance, []

    def shoot(self: Progress, *args: Any, **kwargs: Any) -> None:
        for process in robot.engine.pool.processes:
            shot.append(process)
            os.kill(process, signal.SIGKILL)
        advance(self, *args, **kwargs)

    monkeypatch.setattr(Progress, "advance", shoot)
    with pytest.warns(RuntimeWarning, match="another one replaces it"):
        record = gathered(robot)
    assert shot and robot.engine.pool.replaced >= 3
    same(record, undisturbed)


def test_segments_stay_near_the_record(
    robot: Minitaur, undisturbed: tuple[Experience, Any]
) -> None:
    record, _ = undisturbed
    turned = replay(robot, record, jax.random.key(1), Generalize(segment=5), quiet=True)
    assert np.asarray(turned.valid).all() and np.ptp(turned.yaw) > 3
    # Bullet tells yaws apart; how far that goes is in docs/physics.md.
    assert residual(record, turned)["median"].max() < 2e-3


def test_it_is_tested(robot: Minitaur, undisturbed: tuple[Experience, Any]) -> None:
    tested_scenarios = scenarios(robot, seeds=2, episodes=4)
    out = evaluate(robot, STANDING, tested_scenarios, dataclasses.replace(TEST, max_steps=20))
    assert (out.steps == 20).all() and not out.fell.any()
    assert ((out.start >= 1.4) & (out.start <= 2.6)).all()


def test_a_baseline_learns_on_it(robot: Minitaur) -> None:
    _, learner = collect(robot, AGENTS[SAC], 256, task=GoToGoal(), keep=False, quiet=True)
    numbers = [
        x for x in jax.tree.leaves(learner.training_state) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    assert all(jnp.isfinite(x).all() for x in numbers)
