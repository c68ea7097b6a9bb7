"""Others' PPO, to compare ours with."""

from __future__ import annotations

import functools
import importlib.util
import sys

from tqdm.auto import tqdm

from experiments.benchmark import sb3
from experiments.benchmark.bench import Bench
from experiments.benchmark.measuring import Probe, Skip, timed
from genidm import devices


def baseline(bench: Bench) -> Probe:
    """Stable-Baselines3's PPO at its defaults on gymnasium's Ant-v5, at its fastest here."""
    missing = [name for name in sb3.NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise Skip(f"{', '.join(missing)} missing: pip install -e '.[benchmark]'")
    say = functools.partial(tqdm.write, file=sys.stderr)
    setting = sb3.fastest(sb3.candidates(devices.cores()), say)
    agent = bench.exits.enter_context(sb3.Baseline(*setting))
    return Probe(timed(agent.iterate, agent.steps), agent.note)
