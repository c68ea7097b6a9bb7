"""Robots behind one contract (`genidm.robots.base.Robot`)."""

from genidm.errors import BadInput
from genidm.robots.ant import Ant
from genidm.robots.base import Robot, State
from genidm.robots.humanoid import Humanoid
from genidm.robots.logged import Logged
from genidm.robots.minitaur import Minitaur

ROBOTS: dict[str, type[Robot]] = {robot.name: robot for robot in (Ant, Humanoid, Minitaur)}


def by_name(name: str) -> Robot:
    """The robot of that name, with its default settings.

    Raises:
      BadInput: there is none.
    """
    if name not in ROBOTS:
        raise BadInput(f"no robot is called {name!r}; there are: {', '.join(ROBOTS)}")
    return ROBOTS[name]()


__all__ = ["ROBOTS", "Ant", "Humanoid", "Logged", "Minitaur", "Robot", "State", "by_name"]
