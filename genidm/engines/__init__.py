"""Physics engines, one file each, behind one contract (`genidm.engines.base`)."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar

import mujoco

from genidm import devices, registry
from genidm.engines.base import Engine, Physics, Stepped
from genidm.engines.mjx import MJX
from genidm.engines.mujoco import MuJoCo
from genidm.errors import BadInput

# Engines that step MuJoCo models, by name. `choose` prefers earlier entries.
ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (MJX, MuJoCo)}


E = TypeVar("E", bound=type[Engine])


def register(kind: E) -> E:
    """Registers an engine by its name, for every robot with a MuJoCo model and for `--engine`.

    A class decorator for engines outside genidm; genidm's own engines are listed in `ENGINES`.

    Args:
      kind: the class, called as `kind(spec, frame_skip)`. It may be registered again.

    Returns:
      the class.

    Raises:
      BadInput: a method or constant of the contract is missing, or another engine has this name.
    """
    registry.add(ENGINES, kind, "engine")
    return kind


def choose(name: str | None, offered: Collection[str], robot: str) -> str:
    """Chooses the name of the engine that steps a robot.

    Args:
      name: the user's choice. None chooses by hardware: an engine for accelerators if jax has an
        accelerator, else one for CPUs (`Engine.on_accelerator`).
      offered: names of the engines that can step the robot.
      robot: the robot's name, for the message.

    Raises:
      BadInput: `name` is not in `offered`.
    """
    if name is None:
        on = devices.accelerated()
        fit = [x for x in offered if x in ENGINES and ENGINES[x].on_accelerator == on]
        return (fit or list(offered))[0]
    if name not in offered:
        raise BadInput(f"the {robot} is stepped by {' or '.join(offered)}, not by {name!r}")
    return name


def of_model(name: str, spec: mujoco.MjSpec, frame_skip: int) -> Engine:
    """Makes the engine of this name for a MuJoCo model.

    Args:
      name: one of `ENGINES`.
      spec: the model.
      frame_skip: physics steps per control step.
    """
    kind: Any = ENGINES[name]  # a subclass, which takes arguments
    return kind(spec, frame_skip)


__all__ = ["ENGINES", "Engine", "Physics", "Stepped", "choose", "of_model", "register"]
