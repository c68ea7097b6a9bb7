"""The witness has HER_SP's task: gymnasium's Ant and Stable-Baselines3 judge it."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from genidm.paper.methods import HER_SP
from genidm.tasks import GoToGoal

for module in ("gymnasium.envs.mujoco", "torch", "stable_baselines3"):
    pytest.importorskip(module, reason="the extra `benchmark` is not installed")

from experiments import witness  # noqa: E402  it ends the process where one is absent

TASK = HER_SP.task
assert isinstance(TASK, GoToGoal)


@pytest.fixture(scope="module")
def ant() -> Any:
    return witness.GoalAnt(TASK, steps=20)


def test_turns_agree_with_scipy() -> None:
    start = Rotation.from_euler("zyx", [0.7, 0.2, -0.1])
    for yaw in (-2.0, 0.5, 3.0):
        turned = Rotation.from_euler("z", yaw) * start
        ours = witness.turned(start.as_quat(scalar_first=True), yaw)
        np.testing.assert_allclose(ours, turned.as_quat(scalar_first=True), atol=1e-12)
        np.testing.assert_allclose(
            witness.rotation(yaw) @ [1.0, 2.0],
            Rotation.from_euler("z", yaw).apply([1.0, 2.0, 0.0])[:2],
        )
        facing = turned.apply([1.0, 0.0, 0.0])
        assert witness.heading(ours) == pytest.approx(math.atan2(facing[1], facing[0]))


def test_starts_and_goals_are_those_of_the_papers_test(ant: Any) -> None:
    starts, bearings, distances = [], [], []
    for seed in range(200):
        seen, _ = ant.reset(seed=seed)
        ahead = seen["desired_goal"] - seen["achieved_goal"]
        facing = witness.heading(ant.unwrapped.data.qpos[3:7])
        starts.append(facing)
        bearing = math.atan2(ahead[1], ahead[0]) - facing
        bearings.append(math.remainder(bearing, 2 * math.pi))
        distances.append(np.linalg.norm(ahead))
    assert np.max(np.abs(bearings)) <= math.pi / 4 + 1e-9 and np.std(bearings) > 0.4
    assert 2 <= min(distances) < 2.1 and 4.9 < max(distances) <= 5
    assert min(starts) < -3 and max(starts) > 3 and len(set(distances)) == 200


def test_reward_is_that_of_the_goal(ant: Any) -> None:
    ant.reset(seed=0)
    *_, reward, ended, late, _ = ant.step(np.zeros(8))
    assert (reward, ended, late) == (-1.0, False, False)
    ant.goal = ant.unwrapped.data.qpos[:2] + 0.05
    *_, reward, ended, late, _ = ant.step(np.zeros(8))
    assert (reward, ended, late) == (0.0, True, False)
    goals = np.array([[0.0, 0.0], [0.09, 0.0], [0.0, 0.11], [0.0, 0.11], [0.09, 0.0]])
    infos = [{"fallen": fallen} for fallen in (False, False, False, True, True)]
    many = ant.compute_reward(np.zeros((5, 2)), goals, infos)
    # −1 now and for ever, at a discount of 0.98.
    np.testing.assert_allclose(many, [0, 0, -1, -50, 0])


def test_a_fall_is_charged_for_ever(ant: Any) -> None:
    ant.reset(seed=0)
    state = ant.unwrapped.data.qpos.copy()
    state[2] = 5.0  # above the healthy height
    ant.unwrapped.set_state(state, ant.unwrapped.data.qvel)
    *_, reward, ended, late, info = ant.step(np.zeros(8))
    assert ended and not late and info["fallen"]
    assert reward == pytest.approx(-50)


class Scripted:
    """Walks along x, a metre a step, towards a goal at 3.5 m."""

    def __init__(self, steps: int, falls: bool):
        self.steps, self.falls, self.seeds = steps, falls, []

    def reset(self, seed: int) -> tuple[dict, dict]:
        self.seeds.append(seed)
        self.made = 0
        return self._seen(), {}

    def step(self, action: float) -> tuple[dict, float, bool, bool, dict]:
        self.made += 1
        over = self.made == self.steps
        return self._seen(), 0.0, over and self.falls, over and not self.falls, {}

    def _seen(self) -> dict[str, np.ndarray]:
        here = np.array([float(self.made), 0.0])
        return {"achieved_goal": here, "desired_goal": np.array([3.5, 0.0])}


@pytest.mark.parametrize(("steps", "nearest"), [(2, 1.5), (3, 0.5), (6, 0.5)])
@pytest.mark.parametrize("falls", [False, True])
def test_what_counts_is_how_near_an_episode_came(steps: int, nearest: float, falls: bool) -> None:
    env = Scripted(steps, falls)
    np.testing.assert_array_equal(witness.closest(env, lambda _: 0.0, 2), [nearest, nearest])
    assert len(set(env.seeds)) == 2


def test_a_summary_is_of_all_episodes() -> None:
    made = witness.summary(np.array([0.5, 1.0, 1.5, 3.0]))
    assert made == pytest.approx(dict(mean=1.5, std=0.875**0.5, within_1_m=0.5, episodes=4))


def test_it_learns_and_is_tested(tmp_path: Path, monkeypatch) -> None:
    """Random actions are those of the seed; what learns is another controller after each part."""
    env_checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env_checker.check_env(witness.GoalAnt(TASK, 20))
    early = dataclasses.replace(
        HER_SP, agent=dataclasses.replace(HER_SP.agent, min_replay_size=100)
    )
    monkeypatch.setattr(witness, "HER_SP", early)
    witness.main(tmp_path / "w.json", interactions=1000, episodes=2, parts=2)
    result = json.loads((tmp_path / "w.json").read_text())
    again = witness.GoalAnt(TASK, 1000)
    again.action_space.seed(0)
    drawn = witness.closest(again, lambda _: again.action_space.sample(), 2)
    assert result["random"] == pytest.approx(witness.summary(drawn))
    assert list(result["HER + SAC"]) == ["504", "1008"]  # whole rounds of 8
    first, second = result["HER + SAC"].values()
    assert first["mean"] != second["mean"]
