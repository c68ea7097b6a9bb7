"""Where jax is told to compute with 64 bits (`JAX_ENABLE_X64=1`), everything works as elsewhere."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point, Straight
from tiny import AGENTS, TEST, tiny

from genidm.agents.collect import collect
from genidm.agents.ddpg import DDPG
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.sac import SAC
from genidm.controller import PRETRAINED, load
from genidm.evaluation.evaluate import evaluate, flatten, run
from genidm.evaluation.scenarios import scenarios
from genidm.evaluation.waypoints import WaypointSettings, follow_waypoints
from genidm.paper.fit import fit
from genidm.paper.generalize import Generalize, generalize
from genidm.paper.methods import LR
from genidm.robots import Ant, Humanoid, Robot
from genidm.runs.run import position_and_physics
from genidm.tasks import GoToGoal, WalkForward

SINGLE = np.dtype(np.float32)
LEARNERS: list[tuple[Any, Any]] = [
    (AGENTS[PPO], WalkForward(episode_steps=20)),
    (AGENTS[SAC], GoToGoal(episode_steps=20)),
    (AGENTS[DDPG], GoToGoal(episode_steps=20)),
]


def steered(robot: Robot, controller: Any) -> dict[str, Any]:
    """The test, its traces and waypoints."""
    tested_scenarios = scenarios(robot, 1, 5)
    outcome, traces = run(
        robot,
        controller,
        flatten(tested_scenarios),
        TEST,
        traced=2,
        record=position_and_physics,
        quiet=True,
    )
    keys = jax.random.split(jax.random.key(0), 3)
    way = [[0.5, 0.0], [0.5, 0.5]]
    made = follow_waypoints(
        robot,
        controller,
        way,
        keys,
        np.zeros(3),
        settings=WaypointSettings(40, chunk=10),
        quiet=True,
    )
    assert {x.dtype for x in jax.tree.leaves(outcome) if x.dtype.kind == "f"} == {SINGLE}
    return {
        "scenarios": tested_scenarios.digest(),
        "closest": np.asarray(outcome.closest).tolist(),
        "steps": np.asarray(outcome.steps).tolist(),
        "way": np.asarray(traces[1].position[-1]).tolist(),
        "arrival": made.arrival.tolist(),
        "end": made.position[:, -1].tolist(),
    }


def fitted(robot: Robot, directory: Path) -> dict[str, Any]:
    """From a record to a controller that is saved, read and steers."""
    for agent, task in LEARNERS if isinstance(robot, Point) else LEARNERS[:1]:
        _, learner = collect(robot, agent, 512, task=task, quiet=True, keep=False)
        agent.policy(robot, task, learner).save(directory / "policy", overwrite=True)
        steered(robot, load(directory / "policy", robot))
    record, _ = collect(
        robot, AGENTS[RandomActions], 512, task=WalkForward(episode_steps=20), quiet=True
    )
    samples, residual = generalize(
        robot, record, jax.random.key(0), Generalize(segment=6, num_envs=32), goal_horizon=5
    )
    assert {x.dtype for x in jax.tree.leaves((record.s, samples))} == {SINGLE}
    model = fit(robot, samples, jax.random.key(1), tiny(LR).fit, quiet=True)
    model.save(directory / "controller", overwrite=True)
    steered(robot, load(directory / "controller", robot))
    return {
        "recorded": np.asarray(record.a).mean((0, 1)).tolist(),
        "residual": float(residual["median"].max()),
    }


def everything(directory: Path) -> dict[str, Any]:
    """What must not depend on the bits. A point names no dtypes: its states have 64 of them."""
    point, ant = Point(), Ant(engine="mujoco")
    fitted(point, directory / "point")
    steered(point, Straight(jnp.float32(1.0), point))
    return {
        "ant": fitted(ant, directory / "ant"),
        "steered": steered(ant, load(PRETRAINED / "ant", ant)),
        "banks": [scenarios(robot, 2, 3).digest() for robot in (ant, Humanoid(engine="mujoco"))],
    }


def compare(there: dict[str, Any], here: dict[str, Any]) -> None:
    """Digests are equal; numbers are, but for rounding."""
    assert there.keys() == here.keys()
    for name, x in here.items():
        if isinstance(x, dict):
            compare(there[name], x)
        elif name in ("scenarios", "banks", "steps", "arrival"):
            assert there[name] == x, name
        else:
            np.testing.assert_allclose(there[name], x, atol=2e-4, err_msg=name)


def test_a_process_with_64_bits_gives_what_others_give(tmp_path: Path) -> None:
    here = everything(tmp_path / "here")
    made = subprocess.run(
        [sys.executable, __file__, str(tmp_path / "there")],
        env=os.environ | {"JAX_ENABLE_X64": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr[-4000:]
    compare(json.loads(made.stdout.splitlines()[-1]), here)
    # A controller that was fitted there steers here.
    model = load(tmp_path / "there" / "ant" / "controller", Ant(engine="mujoco"))
    assert evaluate(model.robot, model, scenarios(model.robot, 1, 2), TEST, quiet=True).steps.min()


def test_so_does_a_part_of_a_program_with_64_bits() -> None:
    ant = Ant(engine="mujoco")
    here = steered(ant, load(PRETRAINED / "ant", ant))
    with jax.enable_x64(True):
        compare(steered(ant, load(PRETRAINED / "ant", ant)), here)


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int32])
def test_a_controller_may_answer_with_other_numbers(dtype: Any) -> None:
    point = Point()
    straight = Straight(jnp.float32(1.0), point)
    with jax.enable_x64(True):
        found = evaluate(
            point, lambda s, way: straight(s, way).astype(dtype), scenarios(point, 1, 3), TEST,
            quiet=True,
        )  # fmt: skip
    assert found.closest.dtype == np.float32 and (found.steps == TEST.max_steps).all()


if __name__ == "__main__":
    print(json.dumps(everything(Path(sys.argv[1]))))
