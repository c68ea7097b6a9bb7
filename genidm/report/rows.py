"""The results of all methods, a method a row, as one JSON document."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from genidm.evaluation import stats
from genidm.evaluation.episodes import Episodes
from genidm.paper.protocol import METHOD
from genidm.provenance import code_digest


@dataclasses.dataclass(frozen=True)
class Row:
    """What a method did in the test, and what it took to get there.

    Attributes:
      method: its name; Table 1's for a method of the paper (RS, RL, GE, LR, ...).
      episodes: the test, arrays `[seeds, episodes]`.
      interactions: control steps of the robot while collecting, counted once.
      replayed: control steps replayed by 𝒢 (Def. 4).
      settings: how it was collected and fitted; anything that JSON can hold.
      collecting_seeds: training seed → the test of the method that learned with it; the
        first is `episodes`. A seed is of all that is learned: the experience, 𝒢, the fit.
        Empty where it is not known.
      invariance: mean change of the action when robot and goal are turned alike
        (`genidm.evaluation.invariance`); None where it was not measured.
    """

    method: str
    episodes: Episodes
    interactions: int
    replayed: int
    settings: dict[str, Any]
    collecting_seeds: Mapping[int, Episodes] = dataclasses.field(default_factory=dict)
    invariance: float | None = None
    made: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)


def results(
    rows: Sequence[Row],
    *,
    robot: str,
    scale: str,
    scenarios: str,
    engine: Any = None,
) -> dict[str, Any]:
    """The rows as one JSON document, methods in the order given; distances in metres.

    Args:
      rows: one a method; neighbours are also compared on the same scenarios, and the
        paper's method with every other row.
      robot: its name, as in Table 1.
      scale: "quick", "paper" or a number of interactions.
      scenarios: sha256 of the scenarios.
      engine: what stepped the robot; None if it steps itself.

    Returns:
      robot, engine, scale, scenarios; methods: name → `stats.summary` with interactions,
      replayed, settings, what `made` each stage, and where they are known the training_seed of
      all of these, the invariance and, of several training seeds, collecting_seeds: the seeds,
      the episodes of each and `stats.spread`; paired: "LR-GE" → `stats.paired` of LR against
      GE with, of several training seeds that both have, their `stats.paired_spread`; other_code:
      module → digest of its code → methods, of modules that the rows have in several versions.
      A number that does not exist is null.

    Raises:
      ValueError: a method stands in two rows, or two rows saw different scenarios.
    """
    names = [row.method for row in rows]
    if len(set(names)) != len(names):
        raise ValueError(f"a method stands in two rows: {names}")
    return {
        "robot": robot,
        "engine": engine and str(engine),
        "scale": scale,
        "scenarios": scenarios,
        "methods": {row.method: _method(row) for row in rows},
        "other_code": _other_code(rows),
        "paired": {f"{a.method}-{b.method}": _pair(a, b) for a, b in _compared(rows)},
    }


def _method(row: Row) -> dict[str, Any]:
    record = {
        "interactions": int(row.interactions),
        "replayed": int(row.replayed),
        **jsonable(stats.summary(row.episodes), digits=6),
        "settings": jsonable(row.settings),
    }
    runs = row.collecting_seeds
    if runs:
        record["training_seed"] = next(iter(runs))
    if len(runs) > 1:
        sizes = [list(run.closest.shape) for run in runs.values()]
        spread = jsonable(stats.spread(list(runs.values())), digits=6)
        record["collecting_seeds"] = {"seeds": list(runs), "episodes": sizes, **spread}
    if row.invariance is not None:
        record["invariance"] = float(f"{row.invariance:.3g}")
    if row.made:
        made = {name: {**o, "code": code_digest(o["code"])} for name, o in row.made.items()}
        record["made"] = jsonable(made)
    return record


def origin(code: Mapping[str, str], sessions: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What made a stage; a table's JSON keeps it with the digest of its code.

    Args:
      code: of the stage (`Stage.code`).
      sessions: which commands worked on it (`Stage.made`), at least one.

    Returns:
      code; commit, clean, versions, hardware and command of the command that
      finished it; commands: how many worked on it; seconds: of all that were not killed.
    """
    last = sessions[-1]
    names = ("commit", "clean", "versions", "hardware", "command")
    return {
        "code": dict(code),
        **{name: last.get(name) for name in names},
        "commands": len(sessions),
        "seconds": sum(session.get("seconds") or 0.0 for session in sessions),
    }


def _other_code(rows: Sequence[Row]) -> dict[str, dict[str, list[str]]]:
    """Modules that the rows' stages have in several versions: digest → methods."""
    found: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        for module, digest in itertools.chain(*(o["code"].items() for o in row.made.values())):
            methods = found.setdefault(module, {}).setdefault(digest, [])
            if row.method not in methods:
                methods.append(row.method)
    return {module: digests for module, digests in found.items() if len(digests) > 1}


def _compared(rows: Sequence[Row]) -> Iterator[tuple[Row, Row]]:
    """Each row and the one above it; then the paper's method and the rows not next to it."""
    yield from ((b, a) for a, b in itertools.pairwise(rows))
    for i, row in enumerate(rows):
        if row.method == METHOD:
            yield from ((row, other) for j, other in enumerate(rows) if abs(i - j) > 1)


def _pair(a: Row, b: Row) -> dict[str, Any]:
    record = stats.paired(a.episodes, b.episodes)
    both = [seed for seed in a.collecting_seeds if seed in b.collecting_seeds]
    if len(both) > 1:
        runs = ([row.collecting_seeds[seed] for seed in both] for row in (a, b))
        record["collecting_seeds"] = {"seeds": both, **stats.paired_spread(*runs)}
    plain: dict[str, Any] = jsonable(record, digits=6)
    return plain


def jsonable(value: Any, digits: int | None = None) -> Any:
    """What JSON can hold: NumPy's numbers as Python's, NaN and infinity as null.

    Args:
      value: dicts, lists, numbers and text; anything else becomes its `str`.
      digits: of floats behind the point; all, unless given.
    """
    if isinstance(value, Mapping):
        return {str(k): jsonable(v, digits) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(v, digits) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist(), digits)
    if isinstance(value, float):
        return _number(value, digits)
    return value if value is None or isinstance(value, str | int) else str(value)


def _number(value: float, digits: int | None) -> float | None:
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)
