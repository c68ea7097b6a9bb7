"""Ranges of settings, checked where the settings are declared."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

from genidm.errors import BadInput

# (value) → why it cannot be, as the end of "NAME …"; None if it can.
Allowed = Callable[[Any], str | None]

# Far beyond what any machine does, and far below what numbers of 32 bits hold.
MOST = 10**8
# Of a layer of a network.
WIDEST = 1 << 16


def check(settings: Any, called: Mapping[str, str] | None = None, **allowed: Allowed) -> None:
    """Refuses settings outside their ranges.

    Args:
      settings: an object with the attributes that are named.
      called: attribute → what a message calls it, where that is not its name.
      allowed: attribute → what it may be.

    Raises:
      BadInput: the first that may not be what it is.
    """
    for name, what in allowed.items():
        check_value((called or {}).get(name, name), getattr(settings, name), what)


def check_value(name: str, value: Any, allowed: Allowed) -> None:
    """Refuses one value outside its range; `name` is what a message calls it."""
    why = allowed(value)
    if why:
        raise BadInput(f"{name} {why}, not {value!r:.60}")


def count(least: int = 1, most: int = MOST) -> Allowed:
    """A whole number."""

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
    """A finite number.

    Args:
      low: the least.
      high: the greatest.
      above: it must be above `low`.
      below: it must be below `high`.
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
    """A seed of 32 bits: jax would take 2³² for 0."""
    return count(0, 2**32 - 1)


def printable(x: Any) -> str | None:
    """Text that may be printed: not blank, without line breaks or escape codes."""
    good = isinstance(x, str) and x.strip() and x.isprintable()
    return None if good else "must be text that can be printed"


def label(x: Any) -> str | None:
    """Text that may be printed, and begin the name of a directory."""
    return printable(x) or ("must name no path" if "/" in x or x.startswith(".") else None)


def shown(x: Any) -> str:
    """A thing out of somebody's file as it may be printed: without line breaks or escape codes."""
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
    """None, or what is allowed."""
    return lambda x: None if x is None else allowed(x)


def one_of(things: Collection[Any]) -> Allowed:
    """One of some things, and of its type: 1 is not True."""

    def refuse(x: Any) -> str | None:
        if any(type(x) is type(thing) and x == thing for thing in things):
            return None
        return f"must be {' or '.join(map(repr, things))}"

    return refuse


def layers(x: Any) -> str | None:
    """Widths of the hidden layers of a network."""
    width = count(1, WIDEST)
    if not isinstance(x, tuple | list) or len(x) > 100:
        return "must be a list of at most 100 widths"
    return next((f"holds a width that {why}" for why in map(width, x) if why), None)
