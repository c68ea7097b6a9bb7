"""Rows of collecting: agents that learn and record, and writing the record to disk."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import numpy as np

from experiments.benchmark.bench import Bench, counted
from experiments.benchmark.measuring import Probe, carried, timed
from genidm import devices
from genidm.agents import unroll as steps
from genidm.agents.base import Agent, Iterate, Learning
from genidm.agents.collect import CHUNK, collect
from genidm.agents.frozen import Acting, Frozen
from genidm.agents.off_policy import OffPolicy
from genidm.agents.rollout_then_learn import AgentState, RolloutThenLearn
from genidm.experience import Experience, concatenate
from genidm.paper.methods import LR, RS, Method
from genidm.tasks import Transition


def segment(bench: Bench) -> int:
    """Length of 𝒢's segments on the robot's engine, steps."""
    settings = LR.generalize and LR.generalize.on(bench.robot)
    assert settings and settings.segment
    return settings.segment


def record(bench: Bench) -> Experience:
    """A record of random actions, long enough for four blocks of 𝒢."""
    interactions = 4 * bench.options.wide * segment(bench)
    return collect(bench.robot, _agent(bench, RS), interactions, mesh=bench.mesh, quiet=True)[0]


def collecting(bench: Bench, *, method: Method) -> Probe:
    """`collect`: iterations of the agent, with its metrics read and its record kept."""
    agent = _agent(bench, method)
    learning, learner = _started(bench, method, agent)
    return _iterating(agent, learning.prepare(learner), learner, lambda part: concatenate([part]))


def acting(bench: Bench, *, method: Method) -> Probe:
    """`collect` with a frozen agent: it acts, and every step is recorded."""
    assert isinstance(method.agent, Frozen)
    agent, _, learner = _programs(bench, dataclasses.replace(method, agent=method.agent.agent))
    frozen = Acting(agent, agent.policy(bench.robot, method.task, learner))
    learning, lanes = _started(bench, method, frozen)
    return _iterating(frozen, learning.prepare(lanes), lanes, lambda part: concatenate([part]))


def unrecorded(bench: Bench, *, method: Method) -> Probe:
    """`collecting` with PPO, recording only the fields that PPO learns from."""
    agent = _agent(bench, method)
    learning, learner = _started(bench, method, agent)
    whole = steps.record

    def least(step: Transition, intended: jax.Array) -> Experience:
        unused = ("s", "o", "o_next", "first", "last", "valid", "physics", "intended", "forward")
        return whole(step, intended).replace(**dict.fromkeys(unused))

    with mock.patch.object(steps, "record", least):
        iterate = learning.prepare(learner)
    return _iterating(agent, iterate, learner, lambda part: None)


def walking(bench: Bench, *, method: Method) -> Probe:
    """Only the stepping of a learner: its policy acts and every step is recorded; no updates."""
    agent, programs, learner = _programs(bench, method)
    policy = programs.acting(learner.training_state)
    return _steps(agent, lambda lanes: programs.stepping(*policy, lanes)[0], learner.env_state)


def updating(bench: Bench, *, method: Method) -> Probe:
    """Only the updates of an off-policy learner: each call adds and learns from the same steps."""
    agent, programs, learner = _programs(bench, method)
    batch = programs.stepping(*programs.acting(learner.training_state), learner.env_state)[2]
    batch = devices.gather(batch, bench.mesh)

    def update(training: Any) -> Any:
        return programs.updating(training, batch)[0]

    return _steps(agent, update, learner.training_state)


def writing(bench: Bench) -> Probe:
    """Writing one chunk of the record to disk, as `collect` does."""
    part = bench.once(record)
    chunk = concatenate([part] * -(-CHUNK // part.interactions))
    call = functools.partial(chunk.save, bench.scratch / "chunk", overwrite=True)
    return Probe(timed(call, chunk.interactions), f"{chunk.interactions} steps at a time")


def _agent(bench: Bench, method: Method) -> Any:
    """The method's agent with the benchmark's lanes; it learns from the first iteration."""
    agent: Any = method.agent
    agent = dataclasses.replace(agent, num_envs=bench.options.num_envs)
    return dataclasses.replace(agent, min_replay_size=0) if isinstance(agent, OffPolicy) else agent


def _programs(bench: Bench, method: Method) -> tuple[Any, RolloutThenLearn, AgentState]:
    """The method's agent, its two programs, and its initial state."""
    agent = _agent(bench, method)
    programs = agent.programs(bench.robot, method.task, bench.mesh)
    return agent, programs, _placed(programs)


def _started(bench: Bench, method: Method, agent: Agent) -> tuple[Learning, Any]:
    """The agent on the method's task, and its initial state."""
    learning = agent.learning(bench.robot, method.task, bench.mesh)
    return learning, _placed(learning)


def _placed(learning: Learning | RolloutThenLearn) -> Any:
    """The initial state of a learner, on its devices."""
    return learning.place(jax.jit(learning.start)(jax.random.key(0)))


def _iterating(
    agent: Agent, iterate: Iterate, learner: Any, keep: Callable[[Experience], object]
) -> Probe:
    """Iterations from the state `learner`; `keep` receives the record of each."""

    def step(learner: Any) -> Any:
        learner, part, metrics = iterate(learner)
        keep(part)
        jax.tree.map(np.mean, metrics)
        return learner

    return _steps(agent, step, learner)


def _steps(agent: Agent, iteration: Callable[[Any], Any], start: Any) -> Probe:
    """Measures steps/s over all lanes; a call of `iteration` makes one iteration's steps."""
    call = carried(iteration, start)
    return Probe(timed(call, agent.num_envs * agent.unroll_length), counted(agent.num_envs, "lane"))
