"""Rows of other libraries: Stable-Baselines3's PPO and EnvPool's stepping."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import sys
from collections.abc import Sequence

import numpy as np
from tqdm.auto import tqdm

from experiments.benchmark import sb3
from experiments.benchmark.bench import Bench, counted
from experiments.benchmark.measuring import Probe, Skip, timed
from experiments.benchmark.stepping import STEPS
from genidm import devices


def baseline(bench: Bench) -> Probe:
    """Stable-Baselines3's PPO with default settings on gymnasium's Ant-v5, at its fastest here."""
    _need(sb3.NEEDED)
    say = functools.partial(tqdm.write, file=sys.stderr)
    setting = sb3.fastest(sb3.candidates(devices.cores()), say)
    agent = bench.exits.enter_context(sb3.Baseline(*setting))
    return Probe(timed(agent.iterate, agent.steps), agent.note)


def envpool(bench: Bench, *, wide: bool = False) -> Probe:
    """EnvPool's Ant-v5 with random actions drawn in advance; one thread per core.

    It steps gymnasium's model, not ours. Both make 5 physics steps per control step, but
    gymnasium's integrator is RK4, which computes the dynamics four times per physics step (our
    Euler: once), and its solver may make 100 iterations (ours: 4). EnvPool also computes rewards
    and resets environments whose episode has ended.

    Args:
      bench: sizes.
      wide: use as many environments as 𝒢 and evaluation have lanes.
    """
    _need(["envpool"])
    lanes, threads = bench.num_envs(wide), devices.cores()
    # An optional package: imported by name, so that the type checker does not need it.
    pool = importlib.import_module("envpool").make_gymnasium(
        "Ant-v5", num_envs=lanes, num_threads=threads, seed=0
    )
    bench.exits.enter_context(contextlib.closing(pool))
    shape = (STEPS, lanes, *pool.action_space.shape)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape)
    pool.reset()

    def call() -> None:
        for action in actions:
            pool.step(action)

    note = f"Ant-v5: RK4, resets, rewards; {lanes} lanes, {counted(threads, 'thread')}"
    return Probe(timed(call, lanes * STEPS), note)


def _need(packages: Sequence[str]) -> None:
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise Skip(f"{', '.join(missing)} missing: pip install -e '.[benchmark]'")
