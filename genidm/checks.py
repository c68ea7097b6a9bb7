"""Checks of settings: each class declares the ranges of its own settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

from genidm.errors import BadInput

# (value) → why the value is not allowed, to follow "NAME …"; None if it is allowed.
Allowed = Callable[[Any], str | None]

# Default maximum of a count: more than any run needs, and far from an overflow of int32.
MOST = 10**8
# Maximum width of a network layer.
WIDEST = 1 << 16


def check(settings: Any, called: Mapping[str, str] | None = None, **allowed: Allowed) -> None:
    """Check that settings are in their ranges.

    Args:
      settings: an object with the attributes named in `allowed`.
      called: attribute → its name in messages, if that is another name.
      allowed: attribute → its range.

    Raises:
      BadInput: an attribute is out of its range; the message names the first.
    """
    for name, what in allowed.items():
        check_value((called or {}).get(name, name), getattr(settings, name), what)


def check_value(name: str, value: Any, allowed: Allowed) -> None:
    """Raise BadInput if a value is out of its range; `name` is its name in the message."""
    why = allowed(value)
    if why:
        raise BadInput(f"{name} {why}, not {value!r:.60}")


def count(least: int = 1, most: int = MOST) -> Allowed:
    """A whole number from `least` to `most`."""

    def refuse(x: Any) -> str | None:
        if isinstance(x, bool) or not hasattr(x, "__index__"):
            return "must be a whole number"
        if x < least:
            return f"must be at least {least}"
        return f"must be at most {most}" if x > most else None

    return refuse


def number(
    low: float = -math.inf, high: float = math.inf, *, above: bool = False, below: bool = False
) -> Allowed:
    """A finite number between `low` and `high`.

    Args:
      low: minimum.
      high: maximum.
      above: exclude `low`.
      below: exclude `high`.
    """
    ends = ("(" if above or low == -math.inf else "[", ")" if below or high == math.inf else "]")
    interval = f"{ends[0]}{low:g}, {high:g}{ends[1]}".replace("inf", "∞").replace("-", "−")

    def refuse(x: Any) -> str | None:
        value = math.nan if isinstance(x, bool | str) else _as_float(x)
        if not math.isfinite(value):
            return "must be a finite number"
        under = value <= low if above else value < low
        over = value >= high if below else value > high
        return f"must lie in {interval}" if under or over else None

    return refuse


def seed() -> Allowed:
    """A 32-bit seed, because jax treats 2³² as 0."""
    return count(0, 2**32 - 1)


def printable(x: Any) -> str | None:
    """Printable text: not blank, without line breaks or escape codes."""
    good = isinstance(x, str) and x.strip() and x.isprintable()
    return None if good else "must be printable text"


def label(x: Any) -> str | None:
    """Printable text that can also be the start of a directory name."""
    why = 'must not contain "/" or start with "."'
    return printable(x) or (why if "/" in x or x.startswith(".") else None)


def shown(x: Any) -> str:
    """A value from a file as text that is safe to print: no line breaks or escape codes."""
    text = str(x)
    return text if text.isprintable() and len(text) <= 200 else f"{text!r:.200}"


def _as_float(x: Any) -> float:
    try:
        return float(x)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def positive(high: float = math.inf) -> Allowed:
    """A number above 0."""
    return number(0.0, high, above=True)


def optional(allowed: Allowed) -> Allowed:
    """None, or a value that `allowed` accepts."""
    return lambda x: None if x is None else allowed(x)


def one_of(things: Collection[Any]) -> Allowed:
    """One of the given values, with the same type: 1 is not True."""

    def refuse(x: Any) -> str | None:
        if any(type(x) is type(thing) and x == thing for thing in things):
            return None
        return f"must be {' or '.join(map(repr, things))}"

    return refuse


def layers(x: Any) -> str | None:
    """A list of widths of hidden layers, each from 1 to WIDEST."""
    width = count(1, WIDEST)
    if not isinstance(x, tuple | list) or len(x) > 100:
        return "must be a list of at most 100 widths"
    return next((f"holds a width that {why}" for why in map(width, x) if why), None)
