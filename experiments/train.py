"""One method on one robot, end to end: `python -m experiments.train --robot ant --method LR`.

The named cells (`python -m experiments.ant_lr`) do the same; this runs every robot of
`genidm.robots.ROBOTS` with every method of its table, also those that have no file of their own.
All other flags are those of a named cell.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from genidm.errors import BadInput
from genidm.paper import methods
from genidm.robots import ROBOTS
from genidm.runs import command

USAGE = "usage: python -m experiments.train --robot ROBOT --method METHOD [flags of a cell]"


def named(arguments: Sequence[str]) -> tuple[str | None, str | None, list[str]]:
    """What `--robot` and `--method` name, and the flags that are left.

    Raises:
      BadInput: one of them is without a name.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--robot")
    parser.add_argument("--method")
    try:
        found, rest = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise BadInput(str(error)) from None
    return found.robot, found.method, rest


def there_are(robot: str | None) -> str:
    """The robots, and the methods of one of them."""
    of = methods.TABLES.get(robot or "", methods.ANT)
    return f"robots: {', '.join(ROBOTS)}; methods: {', '.join(method.name for method in of)}"


def main() -> None:
    """Takes `--robot` and `--method` off the command line; the cell reads the rest."""
    with command.in_sentences():
        robot, method, rest = named(sys.argv[1:])
        if robot is None or method is None:
            if {"-h", "--help"} & set(rest):
                print(f"{USAGE}\n\n{there_are(robot)}\n\nBoth named, --help lists the flags.")
                return
            raise BadInput(f"give --robot and --method; {there_are(robot)}")
        if robot not in ROBOTS:
            raise BadInput(f"no robot is called {robot!r}; {there_are(None)}")
        chosen = methods.by_name(method, robot)
    sys.argv[1:] = rest
    command.main(ROBOTS[robot], chosen)


if __name__ == "__main__":
    main()
