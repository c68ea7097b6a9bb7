"""What is chosen from an accelerator's memory. There is none here: its size is given."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from point import Point

from genidm import devices
from genidm.agents.frozen import Frozen
from genidm.agents.sac import SAC
from genidm.errors import BadInput
from genidm.evaluation.evaluate import Test, flatten
from genidm.evaluation.evaluator import Evaluator
from genidm.evaluation.scenarios import scenarios
from genidm.paper import methods
from genidm.paper.fit import Fit, fit
from genidm.paper.pairs import Pairs
from genidm.robots import Humanoid
from genidm.runs.cell import cell
from genidm.runs.resolve import Options
from genidm.tasks import WalkForward

GB = 10**9
ROBOT = Point()


@pytest.fixture
def accelerator(monkeypatch: pytest.MonkeyPatch):
    """Gives the first device a memory of so many bytes."""
    return lambda size: monkeypatch.setattr(devices, "memory", lambda: size)


def test_a_cpu_has_no_memory_of_its_own():
    assert devices.memory() is None
    assert devices.at_once(7) == 7
    assert devices.home(10**18) == jax.devices()[0]


def test_more_robots_at_once_where_there_is_room(accelerator):
    accelerator(80 * GB)
    assert devices.at_once(512) == devices.BUSY
    assert devices.at_once(10 * devices.BUSY) == 10 * devices.BUSY
    accelerator(GB)
    assert 512 < devices.at_once(512) < devices.BUSY
    accelerator(GB // 1000)
    assert devices.at_once(512) == 512


def test_the_test_and_the_replay_take_what_there_is_room_for(accelerator):
    bank = flatten(scenarios(ROBOT, seeds=2, episodes=3000))
    mesh = devices.mesh(jax.devices()[:1])
    narrow = Evaluator(ROBOT, bank, Test(), mesh).start().running.target.shape[0]
    accelerator(80 * GB)
    wide = Evaluator(ROBOT, bank, Test(), mesh).start().running.target.shape[0]
    assert (narrow, wide) == (512, devices.BUSY)


def test_samples_lie_beside_a_copy_of_them_or_on_the_cpu(accelerator, monkeypatch):
    accelerator(10 * GB)
    kinds = {None: ["accelerator"], "cpu": ["cpu"]}
    monkeypatch.setattr(jax, "devices", lambda kind=None: kinds[kind])
    assert devices.home(4 * GB) == "accelerator"
    assert devices.home(5 * GB) == "cpu"


def test_an_off_policy_agent_goes_wide_with_as_many_steps_between_updates(accelerator):
    agent = SAC()
    wide = agent.wide()
    assert (wide.lanes, wide.unroll) == (agent.lanes * agent.unroll, 1)
    assert dataclasses.replace(wide, lanes=agent.lanes, unroll=agent.unroll) == agent
    assert Frozen(agent, 0.5).wide().agent == wide
    lr, options = methods.by_name("LR", "humanoid"), Options()
    ppo = methods.by_name("LR", "ant")
    assert cell(Humanoid(), lr, options).method.agent == lr.agent
    accelerator(80 * GB)
    assert cell(Humanoid(), lr, options).method.agent == lr.agent.wide()
    assert cell(Humanoid(), ppo, options).method.agent == ppo.agent


def test_a_buffer_that_does_not_fit_is_refused(accelerator):
    agent = SAC(lanes=16, unroll=2, capacity=100_000, warmup=0)
    programs = agent.programs(ROBOT, WalkForward(), devices.mesh(jax.devices()[:1]))
    accelerator(GB // 1000)
    with pytest.raises(BadInput, match="capacity"):
        jax.eval_shape(programs.start, jax.random.key(0))
    accelerator(GB)
    jax.eval_shape(programs.start, jax.random.key(0))


def test_a_fit_learns_where_its_samples_have_room(monkeypatch):
    rng = np.random.default_rng(0)
    samples = Pairs(
        rng.normal(size=(1, 64, ROBOT.observation.size)).astype(np.float32),
        np.tile(np.float32([1, 0, 0]), (1, 64, 1)),
        rng.uniform(-1, 1, size=(64, ROBOT.action.size)).astype(np.float32),
    )
    sizes = []
    second = jax.devices()[1]
    monkeypatch.setattr(devices, "home", lambda size: sizes.append(size) or second)
    model = fit(ROBOT, samples, jax.random.key(0), Fit(updates=2, batch=8, idm=(4,)), quiet=True)
    assert model.mean.devices() == {second}
    assert sizes == [sum(x.nbytes for x in (samples.s, samples.d, samples.a))]
