"""Starting: what is compiled until PPO's first iteration is made."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import jax.monitoring

from experiments.benchmark.bench import Bench
from experiments.benchmark.measuring import Probe, Skip
from genidm.agents.collect import collect
from genidm.paper.methods import RL
from genidm.robots import by_name


def starting(bench: Bench, *, second: bool, what: str) -> Probe:
    """What is compiled until PPO's first iteration is made, in a fresh process.

    Args:
      bench: the robot.
      second: with the compilation cache that a first start has left.
      what: a number that `start` prints.
    """
    number = bench.once(starts)[second][what]
    return Probe(lambda _: number, "PPO's first iteration")


def starts(bench: Bench) -> tuple[dict[str, float], dict[str, float]]:
    """What is compiled when a command is started first, and when it is started again."""
    environment = os.environ | {"XDG_CACHE_HOME": str(bench.scratch / "cache")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    engine = bench.robot.engine_name
    code = f"from {__name__} import start; start({bench.robot.name!r}, {engine!r})"
    command = [sys.executable, "-c", code]

    def once() -> dict[str, float]:
        out = subprocess.run(command, env=environment, stdout=subprocess.PIPE)
        if out.returncode:
            raise Skip("a process of its own failed")
        return json.loads(out.stdout.splitlines()[-1])

    return once(), once()


def start(robot: str, engine: str | None) -> None:
    """In a fresh process: makes PPO's first iteration, and prints what was compiled."""
    with compiling() as counted:
        agent: Any = RL.agent
        collect(by_name(robot, engine), agent, 1, quiet=True)
    print(json.dumps(counted))


@contextlib.contextmanager
def compiling() -> Iterator[dict[str, float]]:
    """Counts what jax compiles meanwhile.

    Yields:
      "seconds" spent in XLA or in reading its cache, "programs" that were compiled and
      took long enough to be kept in the cache, "wall" seconds in all.
    """
    counted = {"seconds": 0.0, "programs": 0.0, "wall": 0.0}

    def took(event: str, duration_secs: float, **_: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            counted["seconds"] += duration_secs

    def happened(event: str, **_: Any) -> None:
        counted["programs"] += event == "/jax/compilation_cache/cache_misses"

    jax.monitoring.register_event_duration_secs_listener(took)
    jax.monitoring.register_event_listener(happened)
    began = time.perf_counter()
    yield counted
    counted["wall"] = time.perf_counter() - began
