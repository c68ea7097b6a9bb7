"""How fast the agents walk that collected: `python -m experiments.walk runs/ant`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from genidm import controller
from genidm.checks import check_value, count
from genidm.errors import BadInput
from genidm.evaluation.evaluate import walking_speed
from genidm.evaluation.scenarios import MOST_EPISODES
from genidm.runs.command import run_cli


def main(
    root: Annotated[Path | str, tyro.conf.Positional],
    episodes: int = 100,
    engine: str | None = None,
) -> None:
    """Forward speed of the last policy of every agent that collected under `root`.

    Args:
      root: the directory of a robot's stages.
      episodes: episodes of 1000 steps, or up to a fall.
      engine: "mjx" or "mujoco"; MJX on an accelerator, MuJoCo in C on a CPU, unless given.

    Raises:
      BadInput: there is none, or no episode.
    """
    check_value("episodes", episodes, count(1, MOST_EPISODES))
    policies = sorted(Path(root).glob("experience-*/policy"))
    if not policies:
        raise BadInput(f"no agent has collected under {root}: it is to be as runs/ant is")
    for path in policies:
        policy = controller.load(path, engine=engine)
        speed = walking_speed(policy.robot, policy, episodes)
        name = path.parent.name
        print(f"{name}: {speed.mean():.2f} m/s, {speed.std():.2f} between episodes")


if __name__ == "__main__":
    run_cli(main, "How fast the agents walk that collected.")
