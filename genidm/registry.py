"""Tables of classes by name, which users can add to: robots and engines."""

from __future__ import annotations

import inspect
from typing import Any

from genidm.errors import BadInput


def add(table: dict[str, Any], kind: type, what: str) -> None:
    """Adds a class to a table, under its `name`.

    A class may be added again, as a notebook does that runs a cell twice.

    Args:
      table: name → class.
      kind: the class; it must have all that its contract asks for.
      what: of what kind it is, for the sentence: "robot".

    Raises:
      BadInput: the name is no identifier, or another class has it; or a method or a constant of
        the contract is missing.
    """
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        raise BadInput(f"the name of {kind.__name__} stands in paths and flags: not {name!r}")
    if missing := lacking(kind):
        raise BadInput(f"{kind.__name__} is no {what} yet: it lacks {', '.join(missing)}")
    there = table.get(name)
    if there and (there.__module__, there.__qualname__) != (kind.__module__, kind.__qualname__):
        place = f"{there.__module__}.{there.__qualname__}"
        raise BadInput(f"another {what} is called {name!r}: {place}")
    table[name] = kind


def lacking(kind: type) -> list[str]:
    """Abstract methods of a class, and its constants (`ClassVar`) that have no value."""
    methods = set(getattr(kind, "__abstractmethods__", ()))
    declared = {
        name for base in kind.__mro__ for name, of in inspect.get_annotations(base).items()
        if "ClassVar" in str(of)
    }  # fmt: skip
    return sorted(methods | {name for name in declared if not hasattr(kind, name)})
