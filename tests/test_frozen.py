"""A frozen agent learns first and collects then; what it ended with is what acts."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from bits import same
from killing import Killed, dies_at
from point import Point
from tiny import AGENTS, TEST, tiny

from genidm import devices, experience
from genidm.agents import collect as collecting
from genidm.agents.collect import collect
from genidm.agents.frozen import Acting, Frozen
from genidm.agents.ppo import PPO
from genidm.agents.sac import SAC
from genidm.errors import BadInput
from genidm.evaluation.scenarios import scenarios
from genidm.paper import methods
from genidm.progress import Progress
from genidm.runs.cell import make_run
from genidm.runs.resolve import Options
from genidm.tasks import WalkForward

TASK = WalkForward(episode_steps=20)
LEARNER = dataclasses.replace(AGENTS[SAC], her=None)


@pytest.mark.parametrize("agent", [AGENTS[PPO], LEARNER], ids=lambda a: type(a).__name__)
def test_it_acts_as_it_had_learned_to(agent: PPO | SAC) -> None:
    """The first program of an iteration, at the learner's end, is all that it does."""
    robot, mesh = Point(), devices.mesh()
    _, learner = collect(robot, agent, 1024, task=TASK, quiet=True)
    learned = agent.policy(robot, TASK, learner)
    acting = Acting(agent, learned)
    learning = acting.learning(robot, TASK, mesh)
    lanes = learning.place(learning.start(jax.random.key(3)))
    programs = agent.programs(robot, TASK, mesh)
    chosen = programs.acting(programs.place(learner).training_state)
    after, expected, _, _ = programs.stepping(*chosen, jax.tree.map(jax.numpy.copy, lanes))
    got_lanes, got, _ = learning.prepare(lanes)(lanes)
    np.testing.assert_array_equal(got.a, expected.a)
    np.testing.assert_array_equal(got.s, expected.s)
    np.testing.assert_array_equal(got_lanes.robots.position, after.robots.position)
    got = jax.device_get(got)
    explored = got.a - learned(got.s, np.zeros_like(got.o))  # which it does as it did
    assert np.std(explored) > 0.05
    assert acting.policy(robot, TASK, got_lanes) is learned


@pytest.fixture(scope="module")
def rl() -> methods.InverseDynamics:
    return tiny(methods.RL, agent=Frozen(LEARNER, fraction=0.5), fraction=1.0, skip=0.0)


def options(out: Path, **changes) -> Options:
    return dataclasses.replace(Options(scale="0.5", run_dir=out, episodes=2, test=TEST), **changes)


def test_its_learning_is_counted_and_not_recorded(
    rl: methods.InverseDynamics, tmp_path: Path
) -> None:
    # At full scale it learns for the share that it has, at a smaller one for most of the time.
    assert make_run(Point(), rl, Options()).method == rl
    this = make_run(Point(), rl, options(tmp_path))
    assert this.scale.interactions == 1024
    this.run_test(scenarios(Point(), 10, 2))
    summary = this.controller_stage.summary()
    # Six iterations of 128 steps each, and two.
    assert (summary["interactions"], summary["learned_from"]) == (768 + 256, 256)
    (stage,) = (tmp_path / "point").glob("agent-SAC-0-*")
    assert json.loads((stage / "done.json").read_text()) == {"interactions": 768}
    assert not (stage / "experience").exists() and not (stage / "checkpoints").exists()


def test_killed_on_its_way_it_ends_with_the_same_bits(
    rl: methods.InverseDynamics, tmp_path: Path, monkeypatch
) -> None:
    whole = make_run(Point(), rl, options(tmp_path / "whole")).experience()
    monkeypatch.setattr(collecting, "CHUNK", 128)
    for calls in (2, 4):  # while it learns, and while it is recorded
        dying = make_run(Point(), rl, options(tmp_path / "killed"))
        with monkeypatch.context() as m:
            m.setattr(Progress, "advance", dies_at(calls))
            with pytest.raises(Killed):
                dying.experience()
    killed = make_run(Point(), rl, options(tmp_path / "killed")).experience()
    jax.tree.map(np.testing.assert_array_equal, killed, whole)


def test_a_record_in_memory_is_not_read_back(
    rl: methods.InverseDynamics, tmp_path: Path, monkeypatch
) -> None:
    def refuse(*args) -> None:
        raise AssertionError("read back")

    with monkeypatch.context() as m:
        m.setattr(experience, "load_chunks", refuse)
        made = make_run(Point(), rl, options(tmp_path)).experience()
    read = make_run(Point(), rl, options(tmp_path)).experience()  # by another process, later
    same(made, read)


def test_a_share_lies_between_0_and_1() -> None:
    for wrong in (0.0, 1.0, -0.5, float("nan")):
        with pytest.raises(BadInput, match="fraction"):
            Frozen(LEARNER, wrong)
