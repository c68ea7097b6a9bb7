"""An independent check of HER_SP: Stable-Baselines3's HER and SAC on gymnasium's Ant-v5.

    pip install torch stable-baselines3 "gymnasium[mujoco]"
    python -m experiments.witness

Initial states, goals, reward, settings and interactions are those of HER_SP; the simulator and the
learner are not ours. A large difference in the results means that our HER_SP is wrong. It runs on
one core, for more than an hour at the paper's scale.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from genidm import files
from genidm.agents.sac import SAC
from genidm.paper.methods import HER_SP
from genidm.report.rows import made_now
from genidm.robots import Ant
from genidm.runs.command import run_cli
from genidm.tasks import GoToGoal

try:
    import gymnasium
    import stable_baselines3 as sb3
    import torch
    from gymnasium.spaces import Box, Dict
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
except ImportError as error:
    sys.exit(f'error: this experiment needs {error.name}: pip install -e ".[benchmark]"')

Seen = dict[str, np.ndarray]

AGENT = HER_SP.agent
assert isinstance(AGENT, SAC)
DISCOUNTING = AGENT.discounting


class GoalAnt(gymnasium.Wrapper):
    """gymnasium's Ant-v5 with HER_SP's task, as a goal environment for HER.

    Observations are dicts: the Ant's observation, its position and its goal, each `[2]`, metres.

    Args:
      task: ranges of the initial yaw and of the goal's bearing, and the goal radius.
      steps: time limit of an episode.
    """

    def __init__(self, task: GoToGoal, steps: int):
        super().__init__(gymnasium.make("Ant-v5", max_episode_steps=steps))
        position = Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space = Dict(
            observation=self.env.observation_space, achieved_goal=position, desired_goal=position
        )
        self.task = task
        self.goal = np.zeros(2)

    def reset(self, **options: Any) -> tuple[Seen, dict[str, Any]]:
        _, info = self.env.reset(**options)
        ant = self.env.unwrapped
        draw = ant.np_random.uniform
        yaw = draw(-self.task.start_yaw, self.task.start_yaw)
        qpos, qvel = ant.data.qpos.copy(), ant.data.qvel.copy()
        qpos[3:7], qvel[:2] = turned(qpos[3:7], yaw), rotation(yaw) @ qvel[:2]
        ant.set_state(qpos, qvel)
        angle = heading(qpos[3:7]) + draw(-self.task.bearing, self.task.bearing)
        away = draw(*Ant.target_distance)
        self.goal = qpos[:2] + away * np.array([math.cos(angle), math.sin(angle)])
        return self._seen(ant._get_obs()), info

    def step(self, action: np.ndarray) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        observation, _, fallen, late, info = self.env.step(action)
        seen, info = self._seen(observation), info | {"fallen": fallen}
        reward = float(self.compute_reward(seen["achieved_goal"], self.goal, info))
        return seen, reward, fallen or reward == 0.0, late, info

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        """Reward `[...]`: 0 within the goal radius, −1 otherwise (A.1.1); HER recomputes it.

        A fall ends the episode, and its reward is that of −1 in all later steps. Otherwise the
        best policy would be to fall at once.
        """
        fallen = np.array([info["fallen"] for info in np.atleast_1d(infos)])
        far = np.linalg.norm(achieved - desired, axis=-1)
        charge = np.where(fallen, -1 / (1 - DISCOUNTING), -1.0)
        return np.where(far <= self.task.goal_radius, 0.0, charge.reshape(far.shape))

    def _seen(self, observation: np.ndarray) -> Seen:
        position = self.env.unwrapped.data.qpos[:2].copy()
        return {"observation": observation, "achieved_goal": position, "desired_goal": self.goal}


def rotation(yaw: float) -> np.ndarray:
    """Rotation matrix `[2, 2]` of the horizontal plane by `yaw`."""
    return np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])


def turned(quaternion: np.ndarray, yaw: float) -> np.ndarray:
    """Rotates a quaternion (w, x, y, z) by `yaw` about the world's z axis."""
    w, x, y, z = quaternion
    c, s = math.cos(yaw / 2), math.sin(yaw / 2)
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])


def heading(quaternion: np.ndarray) -> float:
    """Yaw of the body's x axis, radians."""
    w, x, y, z = quaternion
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


class Relative(BaseFeaturesExtractor):
    """Features (s, g − o), the input of every baseline in the paper."""

    def __init__(self, space: Any):
        super().__init__(space, space["observation"].shape[0] + 2)

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        ahead = seen["desired_goal"] - seen["achieved_goal"]
        return torch.cat([seen["observation"], ahead], dim=-1)


def learner(env: GoalAnt, seed: int) -> Any:
    """SAC with HER: HER_SP's settings, else the defaults of Stable-Baselines3."""
    ours = HER_SP.agent
    assert isinstance(ours, SAC) and ours.her
    return sb3.SAC(
        "MultiInputPolicy",
        env,
        learning_rate=ours.learning_rate,
        buffer_size=ours.max_replay_size,
        learning_starts=ours.min_replay_size,
        batch_size=ours.batch_size,
        tau=ours.tau,
        gamma=ours.discounting,
        train_freq=ours.num_envs * ours.unroll_length // ours.grad_updates_per_step,
        gradient_steps=1,
        replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={
            "n_sampled_goal": ours.her.n_sampled_goal,
            "goal_selection_strategy": ours.her.goal_selection_strategy,
            "copy_info_dict": True,
        },
        policy_kwargs={
            "net_arch": {
                "pi": list(ours.policy_hidden_layer_sizes),
                "qf": list(ours.critic_hidden_layer_sizes),
            },
            "features_extractor_class": Relative,
        },
        seed=seed,
        device="cpu",
    )


def closest(env: GoalAnt, act: Callable[[Seen], np.ndarray], episodes: int) -> np.ndarray:
    """Closest distance to the goal in test episodes, metres `[episodes]`."""
    found = []
    for episode in range(episodes):
        seen, _ = env.reset(seed=1_000_000 + episode)  # the same episodes for all policies
        distances, over = [], False
        while not over:
            seen, _, fallen, late, _ = env.step(act(seen))
            distances.append(np.linalg.norm(seen["desired_goal"] - seen["achieved_goal"]))
            over = fallen or late
        found.append(min(distances))
    return np.asarray(found)


def summary(distances: np.ndarray) -> dict[str, float]:
    """Mean and standard deviation of closest distances, and the share within one metre."""
    return {
        "mean": float(distances.mean()),
        "std": float(distances.std()),
        "within_1_m": float((distances <= 1.0).mean()),
        "episodes": len(distances),
    }


def main(
    out: Path | str = Path("experiments/results/witness.json"),
    interactions: int = Ant.paper_interactions,
    episodes: int = 200,
    parts: int = 8,
    seed: int = 0,
) -> None:
    """Trains HER with SAC, tests it several times, and tests random actions for comparison.

    Args:
      out: JSON file for the results.
      interactions: environment steps of the training.
      episodes: episodes per test (A.1.3: at most 1000 steps each).
      parts: number of tests during the training.
      seed: of the training.
    """
    task = HER_SP.task
    assert isinstance(task, GoToGoal)
    torch.set_num_threads(1)
    test = GoalAnt(task, 1000)
    agent = learner(GoalAnt(task, task.episode_steps), seed)
    test.action_space.seed(seed)
    chance = closest(test, lambda _: test.action_space.sample(), episodes)
    result: dict[str, Any] = {"random": summary(chance), "HER + SAC": {}}
    result["made"] = made_now(__name__)
    began = time.process_time()
    for _ in range(parts):
        agent.learn(interactions // parts, reset_num_timesteps=False)
        found = closest(test, lambda seen: agent.predict(seen, deterministic=True)[0], episodes)
        result["HER + SAC"][agent.num_timesteps] = summary(found)
        result["core_seconds"] = round(time.process_time() - began)
        files.save_json(out, result)
        print(f"{agent.num_timesteps} interactions: {json.dumps(summary(found))}", flush=True)


if __name__ == "__main__":
    run_cli(main, "Stable-Baselines3's HER and SAC on gymnasium's Ant, on HER_SP's task.")
