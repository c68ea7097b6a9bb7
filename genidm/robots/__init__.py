"""Robots behind one contract (`genidm.robots.base.Robot`)."""

import dataclasses
from typing import Any, TypeVar

from genidm import registry
from genidm.errors import BadInput
from genidm.robots.ant import Ant
from genidm.robots.ant_v2 import AntV2
from genidm.robots.base import Robot, State
from genidm.robots.humanoid import Humanoid, HumanoidWorld
from genidm.robots.logged import Logged
from genidm.robots.minitaur import Minitaur

ROBOTS: dict[str, type[Robot]] = {
    robot.name: robot for robot in (Ant, AntV2, Humanoid, HumanoidWorld, Minitaur)
}


R = TypeVar("R", bound=type[Robot])


def register(kind: R) -> R:
    """Registers a robot by its name, for `--robot` and for loading its controllers.

    A class decorator for robots outside genidm; genidm's own robots are listed in `ROBOTS`.

    Args:
      kind: the class. It may be registered again, as happens when a notebook cell runs twice.

    Returns:
      the class.

    Raises:
      BadInput: a method or constant of the contract is missing, or another robot has this name.
    """
    registry.add(ROBOTS, kind, "robot")
    return kind


def by_name(name: str, engine: str | None = None) -> Robot:
    """Makes the robot of this name, with its default settings.

    Args:
      name: one of `ROBOTS`.
      engine: name of the engine that steps the robot; default: the robot's choice.

    Raises:
      BadInput: no robot has this name, or the engine cannot step it.
    """
    if name not in ROBOTS:
        raise BadInput(f"no robot is called {name!r:.80}; there are: {', '.join(ROBOTS)}")
    kind: Any = ROBOTS[name]
    if engine is not None and not kind.engines:
        raise BadInput(f"the {name} steps itself and takes no engine, got {engine!r}")
    return kind() if engine is None else kind(engine=engine)


def remade(settings: dict[str, Any]) -> Robot:
    """Makes a robot from the `settings` in a run's config.

    Raises:
      BadInput: no robot has this name, or it does not accept the settings.
    """
    usual = by_name(settings["name"])
    given = {name: value for name, value in settings.items() if name != "name"}
    try:
        arguments = {name: _like(usual.settings[name], value) for name, value in given.items()}
        return type(usual)(**arguments)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"this genidm cannot make the {usual.name} with {given}") from error


def _like(model: Any, value: Any) -> Any:
    """Inverts `config.to_json` for one setting: `value` as an object of the type of `model`."""
    if isinstance(model, float):
        return float(value)  # "inf" is a string in JSON
    if not dataclasses.is_dataclass(model):
        return tuple(value) if isinstance(value, list) else value
    fields = {name: _like(getattr(model, name), x) for name, x in value.items() if name != "class"}
    kind: Any = type(model)
    return kind(**fields)


__all__ = [
    "ROBOTS",
    "Ant",
    "AntV2",
    "Humanoid",
    "HumanoidWorld",
    "Logged",
    "Minitaur",
    "Robot",
    "State",
    "by_name",
    "register",
    "remade",
]
