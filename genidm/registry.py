"""Tables of classes by name, which users can add to: robots and engines."""

from __future__ import annotations

from typing import Any

from genidm.errors import BadInput


def add(table: dict[str, Any], kind: type, what: str) -> None:
    """Adds a class to a table, under its `name`.

    A class may be added again, as a notebook does that runs a cell twice.

    Args:
      table: name → class.
      kind: the class; it must implement its contract.
      what: of what kind it is, for the sentence: "robot".

    Raises:
      BadInput: a method of the contract is missing, the name is no identifier, or another class
        has it.
    """
    missing, name = sorted(getattr(kind, "__abstractmethods__", ())), getattr(kind, "name", None)
    if missing:
        raise BadInput(f"{kind.__name__} is no {what} yet: it lacks {', '.join(missing)}")
    if not isinstance(name, str) or not name.isidentifier():
        raise BadInput(f"the name of {kind.__name__} stands in paths and flags: not {name!r}")
    there = table.get(name)
    if there and (there.__module__, there.__qualname__) != (kind.__module__, kind.__qualname__):
        place = f"{there.__module__}.{there.__qualname__}"
        raise BadInput(f"another {what} is called {name!r}: {place}")
    table[name] = kind
