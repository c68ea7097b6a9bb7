"""How physics is stepped: one file an engine, behind one contract (`genidm.engines.base`)."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar

import mujoco

from genidm import devices, registry
from genidm.engines.base import Engine, Physics, Stepped
from genidm.engines.mjx import MJX
from genidm.engines.mujoco import MuJoCo
from genidm.errors import BadInput

# Engines of MuJoCo models.
ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (MJX, MuJoCo)}


E = TypeVar("E", bound=type[Engine])


def register(kind: E) -> E:
    """Makes an engine known by its name: to every robot with a MuJoCo model, and to `--engine`.

    It is a class decorator, for engines outside of genidm; genidm's own stand in `ENGINES`.
    Without `--engine` an engine that stands further up is chosen.

    Args:
      kind: the class, which is made as `kind(spec, frame_skip)`. It may be registered again.

    Returns:
      the class.

    Raises:
      BadInput: a method of the contract is missing, or another engine has this name.
    """
    registry.add(ENGINES, kind, "engine")
    return kind


def choose(name: str | None, offered: Collection[str], robot: str) -> str:
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


__all__ = ["ENGINES", "Engine", "Physics", "Stepped", "choose", "of_model", "register"]
