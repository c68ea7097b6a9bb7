"""The table: a method a row, beside the paper's Table 1; as JSON, plain text and Markdown."""

from __future__ import annotations

import dataclasses
import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from genidm import stats
from genidm.episodes import Episodes
from genidm.report.paper import TABLE1

HEADER = (
    *("method", "mean ± std", "95 % interval", "IQM", "≤0.25 m", "≤0.5 m", "≤1 m"),
    *("falls", "collections", "interactions", "paper"),
)


@dataclasses.dataclass(frozen=True)
class Row:
    """What a method did in the test, and what it took to get there.

    Attributes:
      method: its name; Table 1's for a method of the paper (RS, RL, GE, LR, ...).
      episodes: the test, arrays `[seeds, episodes]`.
      interactions: control steps of the robot while collecting, counted once.
      replayed: control steps replayed by 𝒢 (Def. 4).
      settings: how it was collected and fitted; anything that JSON can hold.
      collecting_seeds: the test of the same method on each of several collected experiences,
        the first being `episodes`; empty where there is one.
    """

    method: str
    episodes: Episodes
    interactions: int
    replayed: int
    settings: dict[str, Any]
    collecting_seeds: tuple[Episodes, ...] = ()


def results(
    rows: Sequence[Row],
    *,
    robot: str,
    scale: str,
    scenarios: str,
    environment: Mapping[str, Any],
) -> dict[str, Any]:
    """The rows as one JSON document, methods in the order given; distances in metres.

    Args:
      rows: one a method; neighbours are also compared on the same scenarios.
      robot: its name, as in Table 1.
      scale: "quick", "paper" or a number of interactions.
      scenarios: sha256 of the scenario bank.
      environment: "versions" (package → version) and "hardware" (a sentence).

    Returns:
      robot, scale, scenarios, versions, hardware; methods: name → `stats.summary` with
      interactions, replayed, settings and, for several collecting seeds, their
      `stats.spread`; paired: "LR-GE" → `stats.paired` of LR against GE, the row before it.
      A number that does not exist is null.

    Raises:
      ValueError: a method stands in two rows, or two rows saw different scenarios.
    """
    names = [row.method for row in rows]
    if len(set(names)) != len(names):
        raise ValueError(f"a method stands in two rows: {names}")
    return {
        "robot": robot,
        "scale": scale,
        "scenarios": scenarios,
        "versions": _plain(environment["versions"]),
        "hardware": environment["hardware"],
        "methods": {row.method: _method(row) for row in rows},
        "paired": {f"{b.method}-{a.method}": _pair(b, a) for a, b in itertools.pairwise(rows)},
    }


def text(results: Mapping[str, Any]) -> str:
    """The table for a terminal, aligned, beside the paper's numbers."""
    cells = _cells(results)
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [_aligned(row, widths) for row in cells]
    rule = "─" * max(map(len, lines))
    notes = itertools.chain(*(textwrap.wrap(note, 110) for note in _notes(results)))
    return "\n".join([_caption(results), "", lines[0], rule, *lines[1:], rule, *notes])


def markdown(results: Mapping[str, Any]) -> str:
    """The table for a README, beside the paper's numbers."""
    header, *rows = ("| " + " | ".join(row) + " |" for row in _cells(results))
    rule = "|:--" + "|--:" * (len(HEADER) - 1) + "|"
    notes = [f"- {note}" for note in _notes(results)]
    return "\n".join([_caption(results), "", header, rule, *rows, "", *notes])


def _method(row: Row) -> dict[str, Any]:
    record = {
        "interactions": int(row.interactions),
        "replayed": int(row.replayed),
        **_plain(stats.summary(row.episodes), digits=6),
        "settings": _plain(row.settings),
    }
    if len(row.collecting_seeds) > 1:
        record["collecting_seeds"] = _plain(stats.spread(row.collecting_seeds), digits=6)
    return record


def _pair(a: Row, b: Row) -> dict[str, Any]:
    record = stats.paired(a.episodes, b.episodes)
    if len(a.collecting_seeds) == len(b.collecting_seeds) > 1:
        record["collecting_seeds"] = stats.paired_spread(a.collecting_seeds, b.collecting_seeds)
    plain: dict[str, Any] = _plain(record, digits=6)
    return plain


def _plain(value: Any, digits: int | None = None) -> Any:
    """What JSON can hold: NumPy's numbers as Python's, NaN and infinity as null."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v, digits) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v, digits) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), digits)
    if isinstance(value, float):
        return _number(value, digits)
    return value if value is None or isinstance(value, str | int) else str(value)


def _number(value: float, digits: int | None) -> float | None:
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)


def _cells(results: Mapping[str, Any]) -> list[tuple[str, ...]]:
    paper = TABLE1.get(results["robot"], {})
    methods = results["methods"].items()
    return [HEADER, *(_row(name, m, paper.get(name)) for name, m in methods)]


def _row(name: str, m: Mapping[str, Any], paper: tuple[float, float] | None) -> tuple[str, ...]:
    low, high = m["ci95"]
    over = m.get("collecting_seeds")
    steps = [_count(n) for n in (m["interactions"], m["replayed"]) if n]
    return (
        name,
        f"{_metres(m['mean'])} ± {_metres(m['std'])}",
        f"{_metres(low)}–{_metres(high)}",
        _metres(m["iqm"]),
        *(_percent(m["success"][str(t)]) for t in stats.THRESHOLDS),
        _percent(m["fell"]),
        _spread(over) if over else "",
        " + ".join(steps) or "0",
        f"{_metres(paper[0])} ± {_metres(paper[1])}" if paper else "",
    )


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    name, *numbers = row
    cells = [f"{n:>{w}}" for n, w in zip(numbers, widths[1:], strict=True)]
    return "  ".join([f"{name:<{widths[0]}}", *cells]).rstrip()


def _caption(results: Mapping[str, Any]) -> str:
    sizes = {f"{m['seeds']} × {m['episodes']}" for m in results["methods"].values()}
    over = f" over {sizes.pop()} episodes" if len(sizes) == 1 else ""
    scale = f"{results['robot']}, scale {results['scale']}"
    return f"{scale}: closest distance to the target in metres{over}; paper: its Table 1."


def _notes(results: Mapping[str, Any]) -> list[str]:
    methods = results["methods"]
    counts = {len(m["collecting_seeds"]["means"]) for m in methods.values() if _several(m)}
    notes = ["Interactions + replayed steps; the interval is a bootstrap over test seeds."]
    if counts:
        number = "–".join(str(n) for n in sorted(counts))
        notes.append(f"Collections: mean ± std of the means over {number} collecting seeds.")
    lost = [f"{name} {100 * m['diverged']:.2f} %" for name, m in methods.items() if m["diverged"]]
    if lost:
        notes.append(f"Diverged, and so in no mean: {', '.join(lost)}.")
    return notes + [_comparison(name, pair) for name, pair in results["paired"].items()]


def _several(method: Mapping[str, Any]) -> bool:
    return "collecting_seeds" in method


def _comparison(name: str, pair: Mapping[str, Any]) -> str:
    low, high = pair["ci95"]
    line = f"{name}, same scenarios: {_signed(pair['difference'])} m"
    line += f" [{_signed(low)}, {_signed(high)}], nearer in {_percent(pair['improvement'])}"
    over = pair.get("collecting_seeds")
    return line + (f"; {_spread(over, '+')} over {len(over['means'])} collections" if over else "")


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.3f}"


def _spread(over: Mapping[str, Any], sign: str = "") -> str:
    mean, std = over["mean"], over["std"]
    return "–" if mean is None or std is None else f"{mean:{sign}.2f} ± {std:.2f}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"


def _count(n: int) -> str:
    """A count to three digits: 2 M, 1.05 M, 50 k, 640."""
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if n >= 0.9995 * unit:
            return f"{n / unit:.3g} {name}"
    return str(n)
