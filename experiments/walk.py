"""How fast the agents walk that collected: `python -m experiments.walk runs/ant`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from genidm import files
from genidm.agents.ppo import PPO, Learner, Policy
from genidm.devices import mesh
from genidm.errors import BadInput
from genidm.evaluate import walking_speed
from genidm.experiment import guarded
from genidm.robots import Robot, by_name
from genidm.store import Stage
from genidm.tasks import WalkForward


def main(root: Annotated[Path, tyro.conf.Positional], episodes: int = 100) -> None:
    """Forward speed of the last policy of every PPO that collected under `root`.

    Args:
      root: the directory of a robot's stages.
      episodes: episodes of 1000 steps, or up to a fall.
    """
    robot = by_name(root.name)
    for path in sorted(root.glob("experience-PPO-*")):
        speed = walking_speed(robot, _policy(robot, Stage(path)), episodes)
        print(f"{path.name}: {speed.mean():.2f} m/s, {speed.std():.2f} between episodes")


def _policy(robot: Robot, stage: Stage) -> Policy:
    """The last policy of a collecting stage."""
    kept = files.load_json(stage.path("config.json"))["config"]["agent"]
    given: dict[str, Any] = {
        f.name: tuple(x) if isinstance(x := kept[f.name], list) else x
        for f in dataclasses.fields(PPO)
    }
    agent = PPO(**given)
    learner = jax.eval_shape(agent.learning(robot, WalkForward(), mesh()).start, jax.random.key(0))
    found = stage.checkpoints().latest({"learner": learner, "chunks": 0})
    if found is None:
        raise BadInput(f"{stage.directory} holds no checkpoint")
    restored: Learner = found[1]["learner"]
    return agent.policy(robot, restored)


if __name__ == "__main__":
    guarded(main, "How fast the agents walk that collected.")
