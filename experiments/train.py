"""One method on one robot, end to end: `python -m experiments.train --robot ant --method LR`.

`python -m experiments.ant_lr` does the same for one cell of Table 1. This command runs every robot
of `genidm.robots.ROBOTS` with every method, and takes the same flags.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from genidm.errors import BadInput
from genidm.offline.methods import EXTENDED, by_name
from genidm.paper import methods
from genidm.robots import ROBOTS
from genidm.runs import command

USAGE = "usage: python -m experiments.train --robot ROBOT --method METHOD [flags of a cell]"


def named(arguments: Sequence[str]) -> tuple[str | None, str | None, list[str]]:
    """Parses `--robot` and `--method`; returns both and the other arguments.

    Raises:
      BadInput: a value is missing.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--robot")
    parser.add_argument("--method")
    try:
        found, rest = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise BadInput(str(error)) from None
    return found.robot, found.method, rest


def choices(robot: str | None) -> str:
    """Text that lists all robots, and the methods of `robot`."""
    of = methods.TABLES.get(robot or "", methods.ANT)
    names = (*(method.name for method in of), *EXTENDED)
    return f"robots: {', '.join(ROBOTS)}; methods: {', '.join(names)}"


def main() -> None:
    """Runs the cell that `--robot` and `--method` name, with the other arguments."""
    with command.in_sentences():
        robot, method, rest = named(sys.argv[1:])
        if robot is None or method is None:
            if {"-h", "--help"} & set(rest):
                print(f"{USAGE}\n\n{choices(robot)}\n\nWith both, --help lists all flags.")
                return
            raise BadInput(f"give --robot and --method; {choices(robot)}")
        if robot not in ROBOTS:
            raise BadInput(f"no robot is called {robot!r}; {choices(None)}")
        chosen = by_name(method, robot)
    sys.argv[1:] = rest
    command.main(ROBOTS[robot], chosen)


if __name__ == "__main__":
    main()
