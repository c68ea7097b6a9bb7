"""The results: a JSON file and tables made from it, rewritten for every new number."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from genidm import files

# Kind of a row → the fields that identify it: a new row replaces the row with equal fields.
KEYS = {
    "trials": ("robot", "engine"),
    "speeds": ("robot", "what", "engine", "lanes"),
    "measured": ("robot", "engine"),
    "stages": ("robot", "stage"),
    "cells": ("robot", "engine", "method", "scale"),
    "reports": ("robot", "engine", "scale"),
    "failures": ("part", "robot", "engine", "method"),
}
Row = dict[str, Any]


class Results:
    """`gpu.json`, rows of numbers by machine, and `gpu.md`, the same as tables.

    Only one process writes at a time: the command, or the child that it waits for.

    Args:
      directory: directory of both files.
    """

    def __init__(self, directory: Path | str):
        self.path = Path(directory) / "gpu.json"

    def begin(self, machine: str, call: Row) -> None:
        """Begins a call: later rows belong to this machine and call."""

        def edit(data: dict[str, Any]) -> None:
            data["now"] = machine
            section = data["machines"].setdefault(machine, {"calls": []})
            section["calls"].append({"date": time.strftime("%Y-%m-%d %H:%M"), **call})

        self._change(edit)

    @property
    def call(self) -> Row:
        """The data of the latest call."""
        return _section(self._read())["calls"][-1]

    def end(self, **facts: Any) -> None:
        """Adds data to the latest call."""
        self._change(lambda data: _section(data)["calls"][-1].update(facts))

    def put(self, kind: str, row: Row) -> None:
        """Writes a row; replaces the row with the same identifying fields (`KEYS`)."""

        def edit(data: dict[str, Any]) -> None:
            section = _section(data)
            others = [x for x in section.get(kind, []) if not _alike(kind, x, row)]
            section[kind] = [*others, row | {"call": len(section["calls"]) - 1}]

        self._change(edit)

    def drop(self, kind: str, row: Row) -> None:
        """Removes the row with the same identifying fields, if it exists."""

        def edit(data: dict[str, Any]) -> None:
            section = _section(data)
            section[kind] = [x for x in section.get(kind, []) if not _alike(kind, x, row)]

        if self.find(kind, row):
            self._change(edit)

    def rows(self, kind: str) -> list[Row]:
        """All rows of a kind on this machine."""
        return _section(self._read()).get(kind, [])

    def find(self, kind: str, row: Row) -> Row | None:
        """The row with the same identifying fields, of any call on this machine, or None."""
        return next((x for x in self.rows(kind) if _alike(kind, x, row)), None)

    def current(self, kind: str, row: Row) -> bool:
        """Whether the row exists and was measured with the same versions as this call."""
        found, calls = self.find(kind, row), _section(self._read())["calls"]
        return found is not None and _versions(calls[found["call"]]) == _versions(calls[-1])

    def _read(self) -> dict[str, Any]:
        return files.load_json(self.path) if self.path.exists() else {"now": None, "machines": {}}

    def _change(self, edit: Callable[[dict[str, Any]], None]) -> None:
        data = self._read()
        edit(data)
        files.save_json(self.path, data)
        files.save_text(self.path.with_suffix(".md"), markdown(data))


def _section(data: dict[str, Any]) -> dict[str, Any]:
    return data["machines"][data["now"]]


def _alike(kind: str, a: Row, b: Row) -> bool:
    return all(a.get(name) == b.get(name) for name in KEYS[kind])


def _versions(call: Row) -> Any:
    return call["environment"]["versions"]


# ── the table ───────────────────────────────────────────────────────────────────────────────


def markdown(data: dict[str, Any]) -> str:
    """The rows of all machines as Markdown tables."""
    parts = ["# What ran on which machine", "Written by `python -m experiments.gpu`."]
    for name, section in data["machines"].items():
        parts += [f"## {name}", *_calls(section), *_tables(section), *_failures(section)]
    return "\n\n".join(parts) + "\n"


def _calls(section: dict[str, Any]) -> Iterator[str]:
    last = section["calls"][-1]
    versions = ", ".join(f"{k} {v}" for k, v in last["environment"]["versions"].items() if v)
    yield f"{last['environment']['hardware']}. {versions}."
    yield "\n".join(f"- {_call(call)}" for call in section["calls"])


def _call(call: Row) -> str:
    commit = (call["environment"]["commit"] or "no repository")[:10]
    used = f", used {call['seconds'] / 60:.1f}" if "seconds" in call else ", cut off"
    ended = f": {call['ended']}" if "ended" in call else ""
    return f"{call['date']}, commit {commit}, {call['minutes']:g} minutes given{used}{ended}"


def _tables(section: dict[str, Any]) -> Iterator[str]:
    """Yields one table per kind of rows."""
    heads: dict[str, tuple[str, Callable[[Row], tuple[Any, ...]]]] = {
        "trials": ("trial | engine | s | of them compiling", _trial),
        "speeds": (
            "robot | what | engine | lanes | steps/s | from – to | compiling, s | memory, GB",
            _speed,
        ),
        "stages": ("robot | stage | done | s | steps", _stage),
        "cells": (
            "robot | method | engine | scale | closest, m | ≤0.25 m | falls | episodes | s",
            _cell,
        ),
    }
    for kind, (head, line) in heads.items():
        if rows := section.get(kind):
            yield _table(head.split(" | "), [line(row) for row in rows])


def _trial(row: Row) -> tuple[Any, ...]:
    return f"LR, {row['robot']}", row["engine"], f"{row['seconds']:.0f}", f"{row['compiling']:.0f}"


def _speed(row: Row) -> tuple[Any, ...]:
    names = row["robot"], row["what"], row["engine"], row["lanes"]
    if "error" in row:
        return *names, row["error"], "", "", ""
    low, high = row["spread"]
    memory = f"{row['peak_bytes'] / 1e9:.2f}" if row["peak_bytes"] else ""
    return (
        *names,
        f"{row['steps_per_second']:,.0f}",
        f"{low:,.0f} – {high:,.0f}",
        row["compiling"],
        memory,
    )


def _stage(row: Row) -> tuple[Any, ...]:
    done = "yes" if row["done"] else f"no: {row['part']}"
    step = f"{row['step']:,}" if row.get("step") else ""
    return row["robot"], row["stage"], done, f"{row['seconds']:.0f}", step


def _cell(row: Row) -> tuple[Any, ...]:
    closest = f"{row['closest']:.3f} ± {row['std']:.3f}"
    shares = (f"{100 * row[name]:.0f} %" for name in ("near", "falls"))
    names = row["robot"], row["method"], row["engine"], row["scale"]
    return *names, closest, *shares, row["episodes"], f"{row['seconds']:.0f}"


def _table(head: list[str], rows: list[tuple[Any, ...]]) -> str:
    lines = [head, ["--"] * len(head), *(map(str, row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _failures(section: dict[str, Any]) -> Iterator[str]:
    for row in section.get("failures", []):
        of = " ".join(str(row[k]) for k in KEYS["failures"] if row.get(k))
        yield f"Failed: {of}\n\n```\n{re.sub('```', '', row['why'])}\n```"
