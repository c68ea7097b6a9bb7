"""How physics is stepped: one file an engine, behind one contract (`genidm.engines.base`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco

from genidm import devices
from genidm.engines.base import Engine, Physics, Stepped
from genidm.engines.mjx import MJX
from genidm.engines.mujoco import MuJoCo
from genidm.errors import BadInput

# Engines of MuJoCo models.
ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (MJX, MuJoCo)}


def choose(name: str | None, offered: Sequence[str], robot: str) -> str:
    """The engine to step a robot with.

    Args:
      name: what the user asks for; None chooses one for an accelerator where jax has one, else
        one for a CPU (`Engine.on_accelerator`).
      offered: the engines that can step the robot.
      robot: its name.

    Raises:
      BadInput: the robot is not stepped by that engine.
    """
    if name is None:
        on = devices.accelerated()
        fit = [x for x in offered if x in ENGINES and ENGINES[x].on_accelerator == on]
        return (fit or list(offered))[0]
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
    kind: Any = ENGINES[name]  # a subclass, which takes arguments
    return kind(spec, frame_skip)


__all__ = ["ENGINES", "Engine", "Physics", "Stepped", "choose", "of_model"]
