"""PPO of Stable-Baselines3 on gymnasium's Ant-v5, one iteration for every line on stdin.

    python -m experiments._sb3 --environments 4 --vector SubprocVecEnv --threads 4

Run by `experiments.benchmark`, in a process of its own: torch and jax would fight for the
cores. Says the number of steps of an iteration when it is ready, and after each one.
"""

from __future__ import annotations

import argparse
import importlib
import sys


def main() -> None:
    """Answers until stdin ends."""
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


if __name__ == "__main__":  # SubprocVecEnv's processes import this file too
    main()
