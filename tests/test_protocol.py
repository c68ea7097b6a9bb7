"""The paper's numbers, as its appendix prints them, are what the methods run with."""

from __future__ import annotations

import numpy as np
import pytest

from genidm.agents.frozen import Frozen
from genidm.agents.random import RandomActions
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.scenarios import scenarios
from genidm.paper import protocol
from genidm.paper.fit import Fit
from genidm.paper.methods import (
    TABLES,
    AnyMethod,
    GoalConditioned,
    InverseDynamics,
    by_name,
    paper_settings,
)
from genidm.robots import ROBOTS, Ant
from genidm.runs.scale import scale_of
from genidm.tasks import WalkForward

# Table 2, line by line: interactions; method, architecture, training algorithm.
TABLE2 = """
humanoid 15M
RS         IDM: 256x256                                   -
RL         Policy: 256x256 IDM: 256x256                   SAC
VGCP       Policy: 256x256                                SAC
HER_SP     Policy: 64x64                                  SAC
HER_DE     Policy: 64x64                                  SAC
GE         Policy: 256x256 IDM: 256x256                   SAC
LR         Policy: 256x256 LFM: 256x256 IDM: 256x256      SAC
minitaur 4M
RS         IDM: 256x256                                   -
RL         Policy: 256x256 IDM: 256x256                   PPO
VGCP       Policy: 256x256                                PPO
HER_SP     Policy: 64x64                                  SAC
HER_DE     Policy: 64x64                                  SAC
GE         Policy: 256x256 IDM: 256x256                   PPO
LR         Policy: 256x256 LFM: 256x256 IDM: 50x50        PPO
ant 2M
RS         IDM: 256x256                                   -
RL         Policy: 64x64 IDM: 256x256                     PPO
VGCP       Policy: 64x64                                  PPO
HER_SP     Policy: 64x64                                  SAC
HER_DE     Policy: 64x64                                  DDPG
GE         Policy: 64x64 IDM: 256x256                     PPO
LR         Policy: 64x64 LFM: 256x256 IDM: 50x50          PPO
"""


def lines() -> list[tuple[str, str, dict[str, tuple[int, ...]], str]]:
    """Robot, method, layers by network, algorithm: Table 2."""
    rows, robot = [], ""
    for line in TABLE2.split("\n"):
        words = line.split()
        if len(words) == 2:
            robot = words[0]
        elif words:
            nets = dict(zip(words[1:-1:2], words[2:-1:2], strict=True))
            layers = {n.strip(":"): tuple(map(int, w.split("x"))) for n, w in nets.items()}
            rows.append((robot, words[0], layers, words[-1]))
    return rows


def letter(name: str, robot: str) -> AnyMethod:
    """A method with the paper's settings."""
    method = by_name(name, robot)
    return paper_settings(method, robot) if isinstance(method, InverseDynamics) else method


@pytest.mark.parametrize(("robot", "name", "layers", "algorithm"), lines())
def test_methods_are_those_of_table_2(robot: str, name: str, layers: dict, algorithm: str) -> None:
    method = letter(name, robot)
    agent = method.agent.agent if isinstance(method.agent, Frozen) else method.agent
    if algorithm == "-":
        assert isinstance(agent, RandomActions)
    else:
        assert type(agent).__name__ == algorithm
        assert (
            not isinstance(agent, RandomActions)
            and agent.policy_hidden_layer_sizes == layers["Policy"]
        )
    assert isinstance(method, InverseDynamics) == ("IDM" in layers)
    if isinstance(method, InverseDynamics):
        assert method.fit.idm == layers["IDM"]
        assert (method.fit.latent_size is not None) == ("LFM" in layers)
        assert "LFM" not in layers or method.fit.lfm == layers["LFM"]


@pytest.mark.parametrize(
    ("robot", "millions", "learned_from", "k"),
    [("ant", 2, 1, 10), ("minitaur", 4, 2, 10), ("humanoid", 15, 5, 50)],
)
def test_a_1_2(robot: str, millions: int, learned_from: float, k: int) -> None:
    assert ROBOTS[robot].paper_interactions == millions * 10**6
    rl, ge, lr = (letter(name, robot) for name in ("RL", "GE", "LR"))
    assert (
        isinstance(rl, InverseDynamics)
        and isinstance(ge, InverseDynamics)
        and isinstance(lr, InverseDynamics)
    )
    frozen = isinstance(lr.agent, Frozen)
    assert frozen == (robot == "humanoid")
    before = lr.agent.fraction * millions if isinstance(lr.agent, Frozen) else 0.0
    assert before == pytest.approx(5.0 if frozen else 0.0)
    assert (rl.fraction, rl.generalize) == (1.0, None)
    for method in (ge, lr):
        assert method.generalize
        assert method.fraction * (millions - before) == pytest.approx(learned_from)
    assert lr.fit.latent_size == k


def test_every_fit_is_adam_at_1e_3_on_minibatches_of_512_and_lambda_is_a_quarter() -> None:
    fits = [m.fit for column in TABLES.values() for m in column if isinstance(m, InverseDynamics)]
    assert {(fit.batch_size, fit.learning_rate) for fit in (*fits, Fit())} == {(512, 1e-3)}
    for robot, column in TABLES.items():
        papers = [paper_settings(m, robot) for m in column if isinstance(m, InverseDynamics)]
        assert {
            (m.fit.latent_loss_weight, m.fit.mean_latent, m.fit.cosine_decay) for m in papers
        } == {(0.25, True, False)}
        assert {m.goal_horizon for m in papers} == {1}
        assert {(m.task, m.skip, m.labels) for m in papers} == {(WalkForward(), 0.0, "performed")}
        assert not any(m.nearest_side or m.mirror or m.clip_bearing for m in papers)


def test_a_1_3() -> None:
    assert EvaluationSettings().max_steps == 1000
    paper = scale_of("paper", 1)
    assert (paper.seeds, paper.episodes) == (10, 1000)
    ranges = {name: robot.target_distance for name, robot in ROBOTS.items()}
    assert ranges == {
        "ant": (2, 5), "humanoid": (2, 5), "humanoid_world": (2, 5), "minitaur": (1.5, 2.5),
    }  # fmt: skip
    robot = Ant(engine="mujoco")
    tested_scenarios = scenarios(robot, 2, 200)
    start = robot.reset(tested_scenarios.keys.reshape(-1), tested_scenarios.yaw.reshape(-1))
    way = np.asarray(tested_scenarios.target.reshape(-1, 3) - start.position)[:, :2]
    distance = np.linalg.norm(way, axis=-1)
    assert 2 - 1e-4 < distance.min() < 2.2 and 4.8 < distance.max() < 5 + 1e-4
    bearing = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - np.asarray(start.heading))))
    assert 40 < np.degrees(np.abs(bearing)).max() < 45.01
    assert (
        np.degrees(np.asarray(tested_scenarios.yaw)).min()
        < -170
        < 170
        < np.degrees(tested_scenarios.yaw).max()
    )


def test_a_column_has_the_papers_rows_and_two_more() -> None:
    paper = ["RS", "RL", "VGCP", "HER_SP", "HER_DE", "GE", "LR"]
    for column in TABLES.values():
        assert [m.name for m in column] == [*paper, "HF", "AGENT"]
        assert [m.name for m in column if isinstance(m, GoalConditioned)] == [
            "VGCP",
            "HER_SP",
            "HER_DE",
        ]
    for table in (protocol.TABLE1, protocol.TABLE2):
        assert {tuple(rows) for rows in table.values()} == {tuple(paper)}
