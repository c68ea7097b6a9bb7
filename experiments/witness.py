"""A witness for HER_SP: Stable-Baselines3's HER and SAC on gymnasium's Ant-v5.

    pip install torch stable-baselines3 "gymnasium[mujoco]"
    python -m experiments.witness

Nothing of it is ours but the task: the same starts, goals, reward, settings and budget as
HER_SP's, on another simulator and by another's learner. If ours is far from it, ours is
wrong. It runs in a process on one core, and takes an hour at the paper's scale.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from genidm import files
from genidm.agents.sac import SAC
from genidm.errors import BadInput
from genidm.experiment import guarded
from genidm.methods import HER_SP
from genidm.robots import Ant
from genidm.tasks import GoToGoal

NEEDED = ("torch", "gymnasium", "stable_baselines3")


def goal_ant(task: GoToGoal, distance: tuple[float, float], steps: int) -> Any:
    """gymnasium's Ant-v5 on HER_SP's task, as a goal environment for HER.

    Args:
      task: bearing and yaw of the draws, and the reach.
      distance: metres, least and most, of a goal.
      steps: the time limit.
    """
    gymnasium = importlib.import_module("gymnasium")
    spaces = gymnasium.spaces

    class GoalAnt(gymnasium.Wrapper):  # type: ignore[name-defined]
        """Observations are dicts: the Ant's own numbers, where it is, where it should go."""

        def __init__(self) -> None:
            super().__init__(gymnasium.make("Ant-v5", max_episode_steps=steps))
            place = spaces.Box(-np.inf, np.inf, (2,), np.float64)
            self.observation_space = spaces.Dict(
                observation=self.env.observation_space, achieved_goal=place, desired_goal=place
            )
            self.goal = np.zeros(2)

        def reset(self, **options: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
            _, info = self.env.reset(**options)
            ant, draw = self.env.unwrapped, self.env.unwrapped.np_random
            yaw = draw.uniform(-task.start_yaw, task.start_yaw)
            qpos, qvel = ant.data.qpos.copy(), ant.data.qvel.copy()
            qpos[3:7], qvel[:2] = turned(qpos[3:7], yaw), rotation(yaw) @ qvel[:2]
            ant.set_state(qpos, qvel)
            angle = heading(qpos[3:7]) + draw.uniform(-task.bearing, task.bearing)
            self.goal = qpos[:2] + draw.uniform(*distance) * np.array(
                [math.cos(angle), math.sin(angle)]
            )
            return self._seen(ant._get_obs()), info

        def step(self, action: np.ndarray) -> tuple[Any, ...]:
            seen, _, fallen, late, info = self.env.step(action)
            seen = self._seen(seen)
            reward = float(self.compute_reward(seen["achieved_goal"], self.goal, info))
            return seen, reward, fallen or reward == 0.0, late, info

        def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, _: Any) -> np.ndarray:
            far = np.linalg.norm(achieved - desired, axis=-1)
            return np.where(far <= task.reach, 0.0, -1.0)

        def _seen(self, observation: np.ndarray) -> dict[str, np.ndarray]:
            place = self.env.unwrapped.data.qpos[:2].copy()
            return {"observation": observation, "achieved_goal": place, "desired_goal": self.goal}

    return GoalAnt()


def rotation(yaw: float) -> np.ndarray:
    """By `yaw` about z, of the plane `[2, 2]`."""
    return np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])


def turned(quaternion: np.ndarray, yaw: float) -> np.ndarray:
    """(w, x, y, z) after a turn by `yaw` about the world's z."""
    w, x, y, z = quaternion
    c, s = math.cos(yaw / 2), math.sin(yaw / 2)
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])


def heading(quaternion: np.ndarray) -> float:
    """Yaw of the body's x axis, radians."""
    w, x, y, z = quaternion
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def learner(env: Any, seed: int) -> Any:
    """SAC with HER, at HER_SP's settings where it has such; the rest as its authors left it."""
    torch = importlib.import_module("torch")
    sb3 = importlib.import_module("stable_baselines3")
    layers = importlib.import_module("stable_baselines3.common.torch_layers")
    torch.set_num_threads(1)

    class Relative(layers.BaseFeaturesExtractor):  # type: ignore[name-defined]
        """(s, g − o), as every baseline of the paper is fed."""

        def __init__(self, space: Any):
            super().__init__(space, space["observation"].shape[0] + 2)

        def forward(self, seen: dict[str, Any]) -> Any:
            ahead = seen["desired_goal"] - seen["achieved_goal"]
            return torch.cat([seen["observation"], ahead], dim=-1)

    ours = HER_SP.agent
    assert isinstance(ours, SAC) and ours.her
    return sb3.SAC(
        "MultiInputPolicy",
        env,
        learning_rate=ours.learning_rate,
        buffer_size=ours.capacity,
        learning_starts=ours.warmup,
        batch_size=ours.batch,
        tau=ours.tau,
        gamma=ours.discount,
        train_freq=ours.lanes * ours.unroll // ours.updates,
        gradient_steps=1,
        replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={
            "n_sampled_goal": ours.her.goals, "goal_selection_strategy": ours.her.strategy,
        },
        policy_kwargs={
            "net_arch": {"pi": list(ours.hidden), "qf": list(ours.critic_hidden)},
            "features_extractor_class": Relative,
        },
        seed=seed,
        device="cpu",
    )  # fmt: skip


def closest(env: Any, act: Any, episodes: int) -> list[float]:
    """Closest distance to the goal, metres, of each of some test episodes."""
    found = []
    for episode in range(episodes):
        seen, _ = env.reset(seed=1_000_000 + episode)
        best, over = math.inf, False
        while not over:
            best = min(best, float(np.linalg.norm(seen["desired_goal"] - seen["achieved_goal"])))
            seen, _, fallen, late, _ = env.step(act(seen))
            over = fallen or late
        last = float(np.linalg.norm(seen["desired_goal"] - seen["achieved_goal"]))
        found.append(min(best, last))
    return found


def main(
    out: Path = Path("runs/witness.json"),
    interactions: int = Ant.paper_interactions,
    episodes: int = 200,
    parts: int = 8,
    seed: int = 0,
) -> None:
    """Trains it, and tests it as it goes and against random actions.

    Args:
      out: the file that gets the numbers.
      interactions: steps that it learns from.
      episodes: test episodes (A.1.3: of up to 1000 steps).
      parts: tests over its training.
      seed: of its training.

    Raises:
      BadInput: what it needs is not installed.
    """
    absent = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if absent:
        raise BadInput(f"the witness needs {', '.join(absent)}: pip install genidm[benchmark]")
    task = HER_SP.task
    assert isinstance(task, GoToGoal)
    test = goal_ant(task, Ant.target_distance, 1000)
    chance = closest(test, lambda _: test.action_space.sample(), episodes)
    agent = learner(goal_ant(task, Ant.target_distance, task.episode_steps), seed)
    result: dict[str, Any] = {"random": summary(chance), "interactions": [], "HER + SAC": []}
    began = time.process_time()
    for _ in range(parts):
        agent.learn(interactions // parts, reset_num_timesteps=False)
        found = closest(test, lambda x: agent.predict(x, deterministic=True)[0], episodes)
        result["interactions"].append(agent.num_timesteps)
        result["HER + SAC"].append(summary(found))
        result["cpu_seconds"] = round(time.process_time() - began)
        files.save_json(out, result)
        print(json.dumps(result), flush=True)


def summary(distances: list[float]) -> dict[str, float]:
    """Mean, deviation and success of closest distances."""
    x = np.asarray(distances)
    return {
        "mean": float(x.mean()), "std": float(x.std()), "within_1_m": float((x <= 1.0).mean()),
        "episodes": len(x),
    }  # fmt: skip


if __name__ == "__main__":
    guarded(main, "Stable-Baselines3's HER and SAC on gymnasium's Ant, on HER_SP's task.")
