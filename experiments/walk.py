"""Walking speed of the agents that collected experience: `python -m experiments.walk runs/ant`."""

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
    """Prints the forward speed of the last policy of every agent that collected under `root`.

    Args:
      root: the directory of a robot's runs, such as runs/ant.
      episodes: number of episodes; each ends after 1000 steps or a fall.
      engine: "mjx" or "mujoco"; default: MJX on an accelerator, MuJoCo in C on a CPU.

    Raises:
      BadInput: `root` has no such agent, or `episodes` is out of range.
    """
    check_value("episodes", episodes, count(1, MOST_EPISODES))
    policies = sorted(Path(root).glob("experience-*/policy"))
    if not policies:
        raise BadInput(f"no agent has collected under {root}; give a directory such as runs/ant")
    for path in policies:
        policy = controller.load(path, engine=engine)
        speed = walking_speed(policy.robot, policy, episodes)
        name = path.parent.name
        print(f"{name}: {speed.mean():.2f} ± {speed.std():.2f} m/s over episodes")


if __name__ == "__main__":
    run_cli(main, "Walking speed of the agents that collected experience.")
