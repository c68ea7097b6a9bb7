"""Rows: named numbers, each measured alternately with the row that it is compared with."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import statistics
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from experiments.benchmark.bench import Bench
from experiments.benchmark.measuring import Probe, Skip, interleave
from experiments.benchmark.sb3 import Ended
from genidm.progress import Progress
from genidm.provenance import command, environment


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
      name: name of the measured part.
      unit: unit of the value.
      build: makes the probe; rows with the same `build` share the probe, which compiles once.
      ratio_to: name of the row that it is compared with.
      rounds: number of measurements, if the seconds suffice.
    """

    name: str
    unit: str
    build: Callable[[Bench], Probe]
    ratio_to: str | None = None
    rounds: int = 9


def measure(bench: Bench, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Measures rows, and prints on stderr the rows that cannot be measured here.

    Returns:
      the rows of the JSON: name, value, unit, ratio_to, ratio, hardware.
    """
    by_row = {row.name: row for row in rows}
    values: dict[str, list[float]] = defaultdict(list)
    ratios: dict[str, float] = {}
    compared = {row.ratio_to for row in rows}
    # A row that only serves for comparison is measured with the rows that need it.
    todo = [row for row in rows if row.ratio_to or row.name not in compared]
    with Progress("benchmark", len(todo), "rows") as bar:
        for row in todo:
            group = [by_row[row.ratio_to], row] if row.ratio_to else [row]
            with _skipping(row):
                probes = [bench.once(member.build) for member in group]
                samples = interleave(probes, bench.options.seconds, row.rounds)
                for member, column in zip(group, samples.T, strict=True):
                    values[member.name].extend(column)
                if row.ratio_to:
                    ratios[row.name] = float(np.median(samples[:, 1] / samples[:, 0]))
            bar.advance(1)
    measured = [row for row in rows if row.name in values]
    return [_result(bench, row, by_row, values[row.name], ratios) for row in measured]


@contextlib.contextmanager
def _skipping(row: Row) -> Iterator[None]:
    try:
        yield
    except (Skip, Ended) as reason:
        tqdm.write(f"skipped: {row.name}: {reason}", file=sys.stderr)


def _result(
    bench: Bench, row: Row, rows: dict[str, Row], values: list[float], ratios: dict[str, float]
) -> dict[str, Any]:
    def full(row: Row) -> str:
        return f"{row.name} ({bench.once(row.build).note})"

    # A row without a ratio may still have values, from its use as another row's reference.
    base = rows[row.ratio_to] if row.ratio_to and row.name in ratios else None
    return {
        "name": full(row),
        "value": _rounded(statistics.median(values)),
        "unit": row.unit,
        "ratio_to": full(base) if base else None,
        "ratio": _rounded(ratios[row.name]) if base else None,
        "hardware": environment()["hardware"],
        "commit": environment()["commit"],
        "command": command(),
    }


def _rounded(x: float) -> float | None:
    """Rounds to four digits, the precision of timings; None if not finite (not valid JSON)."""
    return float(f"{x:.4g}") if math.isfinite(x) else None


def table(results: Sequence[dict[str, Any]]) -> str:
    """The rows as an aligned text table."""
    head = ("row", "value", "unit", "ratio", "to")
    body = []
    for r in results:
        base = (r["ratio_to"] or "").partition(" (")[0]  # the note is in that row's own line
        body.append((r["name"], _number(r["value"]), r["unit"], _number(r["ratio"]), base))
    widths = [max(map(len, column)) for column in zip(head, *body, strict=True)]
    align = "<><><"
    lines = [
        "  ".join(f"{x:{a}{w}}" for x, a, w in zip(line, align, widths, strict=True)).rstrip()
        for line in (head, *body)
    ]
    lines.insert(1, "─" * max(map(len, lines)))
    return "\n".join(lines)


def _number(x: float | None) -> str:
    return "" if x is None else f"{x:,.0f}" if abs(x) >= 100 else f"{x:.3g}"
