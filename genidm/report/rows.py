"""The results of all methods as one JSON document, one row per method."""

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
from genidm.provenance import code_digest, code_of, command, environment


@dataclasses.dataclass(frozen=True)
class Row:
    """A method's test results, and the interactions and settings that led to them.

    Attributes:
      method: name; Table 1's name for a method of the paper (RS, RL, GE, LR, ...).
      episodes: test results, arrays `[seeds, episodes]`.
      interactions: environment steps that were collected.
      replayed: environment steps that 𝒢 replayed (Def. 4).
      settings: settings of agent and fit; any value that JSON can hold.
      training_seeds: training seed → test results of the run with that seed; the first is
        `episodes`. The seed determines experience, 𝒢 and fit. Empty if unknown.
      invariance: mean change of the action when robot and goal are rotated together
        (`genidm.evaluation.invariance`); None if not measured.
      made: stage → what made it (`origin`).
      held_out: samples, error, shuffled and nearest of the fit (`genidm.paper.held_out.HeldOut`);
        None without a fit.
      bearings: radians; the range of bearings of d in the fit (`Controller.bearings`); None
        without a fit.
    """

    method: str
    episodes: Episodes
    interactions: int
    replayed: int
    settings: dict[str, Any]
    training_seeds: Mapping[int, Episodes] = dataclasses.field(default_factory=dict)
    invariance: float | None = None
    made: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    held_out: Mapping[str, Any] | None = None
    bearings: Sequence[float] | None = None


def results(
    rows: Sequence[Row],
    *,
    robot: str,
    scale: str,
    scenarios: str,
    engine: Any = None,
) -> dict[str, Any]:
    """Builds the JSON document of the rows, in the given order; distances in metres.

    Args:
      rows: one per method. Neighbouring rows are compared on the same scenarios, and the
        paper's method with every other row.
      robot: name of the robot, as in Table 1.
      scale: name of the scale: "quick", "paper" or a fraction.
      scenarios: sha256 of the scenarios.
      engine: engine that stepped the robot; None if the robot has no engine.

    Returns:
      robot, engine, scale, scenarios, and
      methods: name → `stats.summary`, interactions, replayed, settings, `made` (stage → origin)
      and, if known, training_seed, invariance, held_out, bearings and training_seeds (several
      training seeds: seeds, episodes per seed, `stats.spread`);
      paired: "LR-GE" → `stats.paired` of LR against GE and, if both have several training
      seeds in common, `stats.paired_spread` over these;
      other_code: module → digest → methods, for modules whose code differs between rows.
      A missing number is null.

    Raises:
      ValueError: two rows have the same method, or two rows have different scenarios.
    """
    names = [row.method for row in rows]
    if len(set(names)) != len(names):
        raise ValueError(f"two rows have the same method: {names}")
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
    runs = row.training_seeds
    if runs:
        record["training_seed"] = next(iter(runs))
    if len(runs) > 1:
        sizes = [list(run.closest.shape) for run in runs.values()]
        spread = jsonable(stats.spread(list(runs.values())), digits=6)
        record["training_seeds"] = {"seeds": list(runs), "episodes": sizes, **spread}
    if row.invariance is not None:
        record["invariance"] = float(f"{row.invariance:.3g}")
    for name in ("held_out", "bearings"):
        if (known := getattr(row, name)) is not None:
            record[name] = jsonable(known, digits=6)
    if row.made:
        record["made"] = {name: digested(o) for name, o in row.made.items()}
    return record


def origin(code: Mapping[str, str], sessions: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarises what made a stage: code, commit, versions, machine, commands.

    Args:
      code: code of the stage (`Stage.code`).
      sessions: the commands that worked on the stage (`Stage.made`), at least one.

    Returns:
      code; commit, clean, versions, hardware and command of the last session; commands: the
      number of sessions; seconds: their total time, without killed sessions.
    """
    last = sessions[-1]
    names = ("commit", "clean", "versions", "hardware", "command")
    return {
        "code": dict(code),
        **{name: last.get(name) for name in names},
        "commands": len(sessions),
        "seconds": sum(session.get("seconds") or 0.0 for session in sessions),
    }


def digested(made: Mapping[str, Any]) -> dict[str, Any]:
    """An `origin` as JSON keeps it: with the digest of its code in place of the modules."""
    brief: dict[str, Any] = jsonable({**made, "code": code_digest(made["code"])})
    return brief


def _other_code(rows: Sequence[Row]) -> dict[str, dict[str, list[str]]]:
    """Modules whose code differs between the rows: module → digest → methods."""
    found: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        for module, digest in itertools.chain(*(o["code"].items() for o in row.made.values())):
            methods = found.setdefault(module, {}).setdefault(digest, [])
            if row.method not in methods:
                methods.append(row.method)
    return {module: digests for module, digests in found.items() if len(digests) > 1}


def origin_now(*code: Any) -> dict[str, Any]:
    """The `origin` of a result of this process.

    Args:
      code: modules or objects that the result depends on (`provenance.code_of`).
    """
    return origin(code_of(*code), [{**environment(), "command": command()}])


def made_now(*code: Any) -> dict[str, Any]:
    """`origin_now`, `digested`."""
    return digested(origin_now(*code))


def _compared(rows: Sequence[Row]) -> Iterator[tuple[Row, Row]]:
    """Yields each row with the row above it, then the paper's method with all other rows."""
    yield from ((b, a) for a, b in itertools.pairwise(rows))
    for i, row in enumerate(rows):
        if row.method == METHOD:
            yield from ((row, other) for j, other in enumerate(rows) if abs(i - j) > 1)


def _pair(a: Row, b: Row) -> dict[str, Any]:
    record = stats.paired(a.episodes, b.episodes)
    both = [seed for seed in a.training_seeds if seed in b.training_seeds]
    if len(both) > 1:
        runs = ([row.training_seeds[seed] for seed in both] for row in (a, b))
        record["training_seeds"] = {"seeds": both, **stats.paired_spread(*runs)}
    plain: dict[str, Any] = jsonable(record, digits=6)
    return plain


def jsonable(value: Any, digits: int | None = None) -> Any:
    """Converts a value for JSON: NumPy numbers to Python's, NaN and infinity to null.

    Args:
      value: dicts, lists, numbers and text; any other value becomes its `str`.
      digits: decimals of floats; default: all.
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
