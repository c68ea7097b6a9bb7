"""Tables of classes by name that users can extend: robots and engines."""

from __future__ import annotations

import inspect
from typing import Any

from genidm.errors import BadInput


def add(table: dict[str, Any], kind: type, what: str) -> None:
    """Adds a class to a table, under its `name`.

    A class may be added again, as happens when a notebook cell runs twice.

    Args:
      table: name → class.
      kind: the class; it must have every method and constant of its contract.
      what: the contract's name in messages, for example "robot".

    Raises:
      BadInput: the name is not an identifier, or another class has it; or a method or a constant
        of the contract is missing.
    """
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        raise BadInput(f"the name of {kind.__name__} must be an identifier, not {name!r}")
    if missing := lacking(kind):
        raise BadInput(f"{kind.__name__} is not a complete {what}: it lacks {', '.join(missing)}")
    known = table.get(name)
    if known and (known.__module__, known.__qualname__) != (kind.__module__, kind.__qualname__):
        place = f"{known.__module__}.{known.__qualname__}"
        raise BadInput(f"another {what} is called {name!r}: {place}")
    table[name] = kind


def lacking(kind: type) -> list[str]:
    """Names of a class's abstract methods and of its constants (`ClassVar`) without a value."""
    methods = set(getattr(kind, "__abstractmethods__", ()))
    declared = {
        name for base in kind.__mro__ for name, of in inspect.get_annotations(base).items()
        if "ClassVar" in str(of)
    }  # fmt: skip
    return sorted(methods | {name for name in declared if not hasattr(kind, name)})
