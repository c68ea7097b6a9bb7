"""Ranges of settings, checked where the settings are declared."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from genidm.errors import BadInput

# (value) → why it cannot be, as the end of "NAME …"; None if it can.
Allowed = Callable[[Any], str | None]

# Far beyond what any machine does, and far below what numbers of 32 bits hold.
MOST = 10**8


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


def layers(x: Any) -> str | None:
    """Widths of the hidden layers of a network."""
    width = count(1, 1 << 16)
    if not isinstance(x, tuple | list) or len(x) > 100:
        return "must be a list of at most 100 widths"
    return next((f"holds a width that {why}" for why in map(width, x) if why), None)
