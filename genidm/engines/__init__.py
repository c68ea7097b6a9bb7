"""How physics is stepped: one file an engine, behind one contract (`genidm.engines.base`)."""

from __future__ import annotations

import importlib
from collections.abc import Sequence

import jax
import mujoco

from genidm.engines.base import Engine, Physics, Stepped
from genidm.errors import BadInput

# Engines of MuJoCo models, by name; imported when they are chosen, as MJX takes seconds.
ENGINES = {"mjx": "MJX", "mujoco": "MuJoCo"}


def choose(name: str | None, offered: Sequence[str], robot: str) -> str:
    """The engine to step a robot with.

    Args:
      name: what the user asks for; None chooses MJX where jax has an accelerator, else MuJoCo
        in C, which steps several times as fast on a CPU.
      offered: the engines that can step the robot.
      robot: its name.

    Raises:
      BadInput: the robot is not stepped by that engine.
    """
    if name is None:
        usual = "mujoco" if jax.default_backend() == "cpu" else "mjx"
        return usual if usual in offered else offered[0]
    if name not in offered:
        raise BadInput(f"the {robot} is stepped by {' or '.join(offered)}, not by {name!r}")
    return name


def of_model(name: str, spec: mujoco.MjSpec, frame_skip: int) -> Engine:
    """The engine of that name for a MuJoCo model.

    Args:
      name: one of `ENGINES`.
      spec: the model.
      frame_skip: physics steps a control step.
    """
    return getattr(importlib.import_module(f"genidm.engines.{name}"), ENGINES[name])(
        spec, frame_skip
    )


__all__ = ["ENGINES", "Engine", "Physics", "Stepped", "choose", "of_model"]
