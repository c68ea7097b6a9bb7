"""Rows of starting: compilation up to the end of PPO's first iteration."""

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
    """Compilation up to the end of PPO's first iteration, in a fresh process.

    Args:
      bench: the robot.
      second: use the compilation cache of a first start.
      what: key of a number that `start` prints.
    """
    number = bench.once(starts)[second][what]
    return Probe(lambda _: number, "PPO's first iteration")


def starts(bench: Bench) -> tuple[dict[str, float], dict[str, float]]:
    """The numbers of a first start with an empty cache, and of a second start."""
    environment = os.environ | {"XDG_CACHE_HOME": str(bench.scratch / "cache")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    engine = bench.robot.engine_name
    code = f"from {__name__} import start; start({bench.robot.name!r}, {engine!r})"
    command = [sys.executable, "-c", code]

    def once() -> dict[str, float]:
        out = subprocess.run(command, env=environment, stdout=subprocess.PIPE)
        if out.returncode:
            raise Skip("the separate process failed")
        return json.loads(out.stdout.splitlines()[-1])

    return once(), once()


def start(robot: str, engine: str | None) -> None:
    """Makes PPO's first iteration, and prints the numbers of `compiling` as JSON."""
    with compiling() as counted:
        agent: Any = RL.agent
        collect(by_name(robot, engine), agent, 1, quiet=True)
    print(json.dumps(counted))


@contextlib.contextmanager
def compiling() -> Iterator[dict[str, float]]:
    """Counts what jax compiles within the block.

    Yields:
      "seconds" in XLA or reading its cache; "programs": number of compiled programs that took
      long enough to be cached; "wall": seconds in total, set at the end.
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
