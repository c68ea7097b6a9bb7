"""PPO of Stable-Baselines3 on gymnasium's Ant-v5, a reference of `experiments.benchmark`.

    python -m experiments.benchmark.sb3 --environments 4 --vector DummyVecEnv --threads 1

It runs in a separate process, because torch and jax would compete for the cores. There, `main`
makes one iteration for each line on stdin; `Baseline` is the other end of the pipe.
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
# Number of environments, class that steps them, and threads of torch.
Setting = tuple[int, str, int]


def main() -> None:
    """Prints the steps of an iteration; then makes an iteration for each line on stdin."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--environments", type=int, required=True)
    parser.add_argument("--vector", choices=("DummyVecEnv", "SubprocVecEnv"), required=True)
    parser.add_argument("--threads", type=int, required=True)
    options = parser.parse_args()
    # An optional package: imported by name, so that the type checker does not need it.
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
    """The process has ended; its last output is on stderr."""


class Baseline(contextlib.AbstractContextManager):
    """A PPO agent with default settings, in a separate process.

    Args:
      environments: number of environments.
      vector: "DummyVecEnv" steps them one after the other, "SubprocVecEnv" in processes.
      threads: threads of torch.

    Attributes:
      steps: steps per iteration, over all environments.
      note: the settings, in words.
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
        """Makes one iteration: `steps` steps, and learning from them. Raises Ended."""
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
            raise Ended("the process of Stable-Baselines3 has ended early")
        return int(line)

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._process.communicate()


def candidates(cores: int) -> list[Setting]:
    """Settings that may be fastest; the policy is so small that one torch thread is often best."""
    stepping = [(1, "DummyVecEnv")]
    stepping += [(n, vector) for n in (4, 8) for vector in ("DummyVecEnv", "SubprocVecEnv")]
    return [(*how, threads) for threads in sorted({1, cores}) for how in stepping]


def fastest(settings: Iterable[Setting], say: Callable[[str], object]) -> Setting:
    """The setting with the most steps/s in one iteration; raises Ended if all of them failed."""
    rates: dict[Setting, float] = {}
    for setting in settings:
        with Baseline(*setting) as one:
            # On busy cores, many threads can be fifty times slower: hence the time limit.
            best = max(rates.values(), default=0.0)
            rates[setting] = one.rate(max(10.0, 3 * one.steps / best) if best else 600.0)
            say(f"{one.note}: {rates[setting]:.0f} steps/s" if rates[setting] else
                f"{one.note}: too slow to wait for")  # fmt: skip
    if not any(rates.values()):
        raise Ended("no setting of Stable-Baselines3 completed an iteration")
    return max(rates, key=rates.__getitem__)


if __name__ == "__main__":  # SubprocVecEnv's processes import this file too
    main()
