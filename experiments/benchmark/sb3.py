"""PPO of Stable-Baselines3 on gymnasium's Ant-v5: what `experiments.benchmark` compares with.

    python -m experiments.benchmark.sb3 --environments 4 --vector DummyVecEnv --threads 1

It runs in a process of its own, as torch and jax would fight for the cores: there `main`
answers each line on stdin with one iteration, and `Baseline` is the other end of the pipe.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable

NEEDED = ("torch", "gymnasium", "stable_baselines3")
# Environments, how they are stepped, and threads of torch.
Setting = tuple[int, str, int]


def main() -> None:
    """Says how many steps an iteration has; makes one for each line of stdin, and says so."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--environments", type=int, required=True)
    parser.add_argument("--vector", choices=("DummyVecEnv", "SubprocVecEnv"), required=True)
    parser.add_argument("--threads", type=int, required=True)
    options = parser.parse_args()
    # An extra that may be absent: imported by name, so that the types are checked without it.
    sb3 = importlib.import_module("stable_baselines3")
    util = importlib.import_module("stable_baselines3.common.env_util")
    vectors = importlib.import_module("stable_baselines3.common.vec_env")
    importlib.import_module("torch").set_num_threads(options.threads)
    environments = util.make_vec_env(
        "Ant-v5", options.environments, seed=0, vec_env_cls=getattr(vectors, options.vector)
    )
    agent = sb3.PPO("MlpPolicy", environments, seed=0, device="cpu")
    steps = agent.n_steps * options.environments
    print(steps, flush=True)
    for _ in sys.stdin:
        agent.learn(steps, reset_num_timesteps=False)
        print(steps, flush=True)
    environments.close()


class Ended(RuntimeError):
    """The process is no more; its last words are on stderr."""


class Baseline(contextlib.AbstractContextManager):
    """An agent at its defaults, in a process of its own.

    Args:
      environments: number of them.
      vector: how they are stepped: "DummyVecEnv" in turn, "SubprocVecEnv" in processes.
      threads: of torch.

    Attributes:
      steps: of an iteration, over all environments.
      note: its settings, in words.
    """

    def __init__(self, environments: int, vector: str, threads: int):
        self.note = f"environments: {environments}, {vector}, threads of torch: {threads}"
        values = {"environments": environments, "vector": vector, "threads": threads}
        flags = [text for name, value in values.items() for text in (f"--{name}", str(value))]
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *flags],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.steps = self._answer()

    def iterate(self) -> None:
        """One iteration: `steps` steps, and learning from them. Raises Ended."""
        assert self._process.stdin
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        self._answer()

    def rate(self, limit: float) -> float:
        """Steps/s of one iteration; 0 if it takes more than `limit` seconds."""
        timer, began = threading.Timer(limit, self._process.kill), time.perf_counter()
        timer.start()
        try:
            self.iterate()
        except Ended:
            return 0.0
        finally:
            timer.cancel()
        return self.steps / (time.perf_counter() - began)

    def _answer(self) -> int:
        assert self._process.stdout
        line = self._process.stdout.readline()
        if not line:
            raise Ended("Stable-Baselines3 ended before its time")
        return int(line)

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._process.communicate()


def candidates(cores: int) -> list[Setting]:
    """What may be fastest: its policy is so small that torch is often best on one core."""
    ways = [(1, "DummyVecEnv")]
    ways += [(n, vector) for n in (4, 8) for vector in ("DummyVecEnv", "SubprocVecEnv")]
    return [(*way, threads) for threads in sorted({1, cores}) for way in ways]


def fastest(settings: Iterable[Setting], say: Callable[[str], object]) -> Setting:
    """The setting with the most steps/s over one iteration; raises Ended if none made one."""
    rates: dict[Setting, float] = {}
    for setting in settings:
        with Baseline(*setting) as one:
            # Threads that fight for busy cores can be fifty times slower: not waited for.
            best = max(rates.values(), default=0.0)
            rates[setting] = one.rate(max(10.0, 3 * one.steps / best) if best else 600.0)
            say(f"{one.note}: {rates[setting]:.0f} steps/s" if rates[setting] else
                f"{one.note}: too slow to wait for")  # fmt: skip
    if not any(rates.values()):
        raise Ended("Stable-Baselines3 made no iteration")
    return max(rates, key=rates.__getitem__)


if __name__ == "__main__":  # SubprocVecEnv's processes import this file too
    main()
