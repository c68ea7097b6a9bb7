"""The Minitaur in several processes: speed-up, and overhead over the slowest process.

Part of `experiments.minitaur_physics`. The overhead is wall time relative to the slowest process's
time on a core or in wait for one, so other load has little influence.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.physics import table
from genidm import devices
from genidm.robots import Minitaur

# Rounds, over which medians are taken, and robot steps per round.
ROUNDS, ROUND = 5, 2560


def busy(pids: list[int]) -> np.ndarray:
    """Seconds `[2, n]` that each process has run, and has waited for a core (schedstat)."""
    stats = [Path(f"/proc/{pid}/schedstat").read_text().split() for pid in pids]
    return np.array([[int(x) for x in s[:2]] for s in stats]).T / 1e9


@dataclasses.dataclass(frozen=True)
class Vectorised:
    """Robots that several processes step together.

    Attributes:
      name: name in the table.
      num_envs: number of robots.
      pids: ids of the processes.
      step: makes one step of all robots and waits for the result.
    """

    name: str
    num_envs: int
    pids: list[int]
    step: Callable[[], Any]

    def measured(self, repeats: int) -> dict[str, float]:
        """Robot steps per second of wall time, CPU ms per step, and overhead over the slowest."""
        wall = slowest = cpu = 0.0
        for _ in range(repeats):
            before, began = busy(self.pids), time.perf_counter()
            self.step()
            wall += time.perf_counter() - began
            spent = busy(self.pids) - before
            slowest += spent.sum(0).max()
            cpu += spent[0].sum()
        steps = self.num_envs * repeats
        return {
            "steps_per_second": steps / wall,
            "ms_cpu": 1e3 * cpu / steps,
            "over_slowest": wall / slowest - 1,
        }


def vectorised(actions: np.ndarray) -> list[dict[str, Any]]:
    """A row for each of 1, 2, 4, … processes, ours and gymnasium's.

    Values are medians over rounds; every round measures all rows, so other load affects all alike.

    Args:
      actions: `[T, 8]`, of a walking robot.
    """
    counts = [n for n in (1, 2, 4, 8, 16) if n <= devices.cores()]
    with contextlib.ExitStack() as opened:
        kinds = [ours(n, actions) for n in counts]
        kinds += [opened.enter_context(gymnasiums(n, actions)) for n in counts]
        rounds = [[kind.measured(ROUND // kind.num_envs) for kind in kinds] for _ in range(ROUNDS)]
    return [
        {"what": kind.name, "processes": len(kind.pids), "lanes": kind.num_envs}
        | {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
        for kind, rows in zip(kinds, zip(*rounds, strict=True), strict=True)
    ]


def ours(processes: int, actions: np.ndarray, lanes: int = 128) -> Vectorised:
    """Our Minitaur: lanes distributed over processes."""
    robot = Minitaur(processes=processes)
    step = jax.jit(robot.step)
    state = robot.reset(jax.random.split(jax.random.key(0), lanes), jnp.zeros(lanes))
    action = jnp.tile(jnp.asarray(actions[0], jnp.float32), (lanes, 1))

    def once() -> None:
        step(state, action).position.block_until_ready()

    once()
    return Vectorised("Minitaur", lanes, robot.engine.pool.processes, once)


@contextlib.contextmanager
def gymnasiums(processes: int, actions: np.ndarray) -> Iterator[Vectorised]:
    """gymnasium's AsyncVectorEnv, with one environment per process."""
    from gymnasium.vector import AsyncVectorEnv

    from genidm.robots.minitaur_env import MinitaurEnv

    env = AsyncVectorEnv([MinitaurEnv] * processes, context="forkserver")
    env.reset()
    commands = itertools.cycle(np.tile(actions[:, None], (1, processes, 1)).astype(np.float32))
    pids = [process.pid for process in env.processes]
    try:
        yield Vectorised("AsyncVectorEnv", processes, pids, lambda: env.step(next(commands)))
    finally:
        env.close()


def processes_table(rows: list[dict[str, Any]]) -> str:
    """Markdown table of speed, its ratio to one process, and overhead."""
    one = {r["what"]: r["steps_per_second"] for r in rows if r["processes"] == 1}
    lines = [
        [
            r["what"], str(r["processes"]), str(r["lanes"]), f"{r['steps_per_second']:.0f}",
            f"{r['steps_per_second'] / one[r['what']]:.2f}", f"{r['ms_cpu']:.2f}",
            f"{100 * r['over_slowest']:.0f} %",
        ]
        for r in rows
    ]  # fmt: skip
    head = ["what", "processes", "lanes", "steps/s", "ratio", "ms CPU a step", "over the slowest"]
    return table(head, lines)
