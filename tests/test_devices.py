"""What is chosen from an accelerator's memory. There is none here: its size is given."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from point import Point

from genidm import devices
from genidm.agents.frozen import Frozen
from genidm.agents.sac import SAC
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings, flatten
from genidm.evaluation.evaluator import Evaluator
from genidm.evaluation.scenarios import scenarios
from genidm.paper import methods
from genidm.paper.fit import Fit, fit
from genidm.paper.pairs import Pairs
from genidm.robots import Humanoid
from genidm.runs.cell import make_run
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
    assert devices.max_parallel_envs(7) == 7
    assert devices.pick_device(10**18) == jax.devices()[0]


def test_more_robots_at_once_where_there_is_room(accelerator):
    accelerator(80 * GB)
    assert devices.max_parallel_envs(512) == devices.BUSY
    assert devices.max_parallel_envs(10 * devices.BUSY) == 10 * devices.BUSY
    accelerator(GB)
    assert 512 < devices.max_parallel_envs(512) < devices.BUSY
    accelerator(GB // 1000)
    assert devices.max_parallel_envs(512) == 512


def test_the_test_and_the_replay_take_what_there_is_room_for(accelerator):
    tested_scenarios = flatten(scenarios(ROBOT, seeds=2, episodes=3000))
    mesh = devices.mesh(jax.devices()[:1])
    narrow = (
        Evaluator(ROBOT, tested_scenarios, EvaluationSettings(), mesh)
        .start()
        .running.target.shape[0]
    )
    accelerator(80 * GB)
    wide = (
        Evaluator(ROBOT, tested_scenarios, EvaluationSettings(), mesh)
        .start()
        .running.target.shape[0]
    )
    assert (narrow, wide) == (512, devices.BUSY)


def test_samples_lie_beside_a_copy_of_them_or_on_the_cpu(accelerator, monkeypatch):
    accelerator(10 * GB)
    kinds = {None: ["accelerator"], "cpu": ["cpu"]}
    monkeypatch.setattr(jax, "devices", lambda kind=None: kinds[kind])
    assert devices.pick_device(4 * GB) == "accelerator"
    assert devices.pick_device(5 * GB) == "cpu"


def test_an_off_policy_agent_goes_wide_with_as_many_steps_between_updates(accelerator):
    agent = SAC()
    wide = agent.for_accelerator()
    assert (wide.num_envs, wide.unroll_length) == (agent.num_envs * agent.unroll_length, 1)
    assert (
        dataclasses.replace(wide, num_envs=agent.num_envs, unroll_length=agent.unroll_length)
        == agent
    )
    assert Frozen(agent, 0.5).for_accelerator().agent == wide
    lr, options = methods.by_name("LR", "humanoid"), Options()
    ppo = methods.by_name("LR", "ant")
    assert make_run(Humanoid(), lr, options).method.agent == lr.agent
    accelerator(80 * GB)
    assert make_run(Humanoid(), lr, options).method.agent == lr.agent.for_accelerator()
    assert make_run(Humanoid(), ppo, options).method.agent == ppo.agent


def test_a_buffer_that_does_not_fit_is_refused(accelerator):
    agent = SAC(num_envs=16, unroll_length=2, max_replay_size=100_000, min_replay_size=0)
    programs = agent.programs(ROBOT, WalkForward(), devices.mesh(jax.devices()[:1]))
    accelerator(GB // 1000)
    with pytest.raises(BadInput, match="max_replay_size"):
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
    monkeypatch.setattr(devices, "pick_device", lambda size: sizes.append(size) or second)
    model = fit(
        ROBOT, samples, jax.random.key(0), Fit(updates=2, batch_size=8, idm=(4,)), quiet=True
    )
    assert model.mean.devices() == {second}
    assert sizes == [sum(x.nbytes for x in (samples.s, samples.d, samples.a))]


# ── any number of devices ───────────────────────────────────────────────────────────────

WORK = """
import sys, json
sys.path.insert(0, {tests!r})
import jax, jax.numpy as jnp, numpy as np
from point import Point, Straight
from tiny import AGENTS, TEST
from genidm.agents.random import RandomActions
from genidm.agents.collect import collect
from genidm.evaluation.evaluate import evaluate
from genidm.paper.generalize import Generalize, generalize
from genidm.evaluation.scenarios import scenarios
from genidm.evaluation.waypoints import WaypointSettings, follow_waypoints
robot = Point()
straight = Straight(jnp.float32(1.0), robot)
record, _ = collect(robot, RandomActions(num_envs=14, unroll_length=8), 300, quiet=True)
pairs, residual = generalize(
    robot, record, jax.random.key(0), Generalize(segment=6, num_envs=10), goal_horizon=5)
found = evaluate(robot, straight, scenarios(robot, 1, 7), TEST, quiet=True)
made = follow_waypoints(robot, straight, [[1.0, 0.0]], jax.random.split(jax.random.key(0), 7),
    np.zeros(7), settings=WaypointSettings(40, chunk=10), quiet=True)
print(json.dumps(dict(
    devices=jax.device_count(), s=np.abs(record.s).sum(), steps=record.interactions,
    d=np.abs(pairs.d).sum(), residual=residual["median"].max(),
    closest=found.closest.sum(), arrival=made.arrival.ravel().tolist()), default=float))
"""


@functools.cache
def at_work(count: int) -> dict:
    """What comes of 14 lanes, 10 segments at once, 7 episodes and 7 journeys on so many devices."""
    here = Path(__file__).parent
    made = subprocess.run(
        [sys.executable, "-c", WORK.format(tests=str(here))], capture_output=True, text=True,
        env=os.environ | {"GENIDM_DEVICES": str(count), "PYTHONPATH": str(here.parent)},
    )  # fmt: skip
    assert made.returncode == 0, made.stderr[-3000:]
    return json.loads(made.stdout)


@pytest.mark.parametrize("count", [3, 5, 6, 12])
def test_devices_that_divide_nothing_change_nothing(count: int) -> None:
    one, many = at_work(1), at_work(count)
    assert one["devices"] == 1 and many["devices"] == count
    assert one["steps"] == 336 and -1 not in one["arrival"]
    assert many["arrival"] == one["arrival"]
    for name in ("s", "steps", "d", "residual", "closest"):
        x = many[name]
        np.testing.assert_allclose(x, one[name], rtol=1e-4, atol=1e-5, err_msg=name)
