"""The results table beside the paper's Table 1, as plain text and as Markdown."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from genidm.evaluation import stats
from genidm.paper.protocol import TABLE1

HEADER = (
    *("method", "mean ± std", "95 % interval", "IQM", "≤0.25 m", "≤0.5 m", "≤1 m"),
    *("falls", "over seeds", "interactions", "paper"),
)
COMPARED = (
    *("pair", "difference, m", "95 % interval", "nearer in"),
    *("over seeds", "95 % interval", "nearer in"),
)
BRIEF = 4  # columns of the comparisons if there is only one training seed


def text(results: Mapping[str, Any]) -> str:
    """The table as aligned text for a terminal, then its notes and the paired comparisons."""
    body = _aligned(_cells(results))
    rule = "─" * max(map(len, body))
    notes = itertools.chain(*(textwrap.wrap(note, 110) for note in _notes(results)))
    lines = [_caption(results), "", body[0], rule, *body[1:], rule, *notes]
    compared = _comparisons(results)
    legend = textwrap.wrap(_legend(compared), 110)
    return "\n".join([*lines, "", *legend, "", *_aligned(compared)] if compared else lines)


def markdown(results: Mapping[str, Any]) -> str:
    """The table as Markdown, then its notes and the paired comparisons."""
    notes = [f"- {note}" for note in _notes(results)]
    lines = [_caption(results), "", *_piped(_cells(results)), "", *notes]
    compared = _comparisons(results)
    legend = _legend(compared)
    return "\n".join([*lines, "", legend, "", *_piped(compared)] if compared else lines)


def _cells(results: Mapping[str, Any]) -> list[tuple[str, ...]]:
    paper = TABLE1.get(results["robot"], {})
    methods = results["methods"].items()
    return [HEADER, *(_row(name, m, paper.get(name)) for name, m in methods)]


def _row(name: str, m: Mapping[str, Any], paper: tuple[float, float] | None) -> tuple[str, ...]:
    low, high = m["ci95"]
    over = m.get("training_seeds")
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


def _aligned(cells: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines with aligned columns: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for name, *rest in cells:
        numbers = (f"{n:>{w}}" for n, w in zip(rest, widths[1:], strict=True))
        lines.append("  ".join([f"{name:<{widths[0]}}", *numbers]).rstrip())
    return lines


def _piped(cells: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines of a Markdown table."""
    header, *rows = ("| " + " | ".join(row) + " |" for row in cells)
    return [header, "|:--" + "|--:" * (len(cells[0]) - 1) + "|", *rows]


def _caption(results: Mapping[str, Any]) -> str:
    sizes = {f"{m['seeds']} × {m['episodes']}" for m in results["methods"].values()}
    over = f" over {sizes.pop()} episodes" if len(sizes) == 1 else ""
    scale = f"{results['robot']}, scale {results['scale']}"
    return f"{scale}: closest distance to the target in metres{over}; “paper”: its Table 1."


def _notes(results: Mapping[str, Any]) -> list[str]:
    methods = results["methods"]
    notes = [
        "“Interactions”: environment steps that were collected + steps that 𝒢 replayed.",
        f"Every column except “over seeds” uses {_one_seed(methods)}: mean and standard deviation "
        "over all test episodes; the interval is a bootstrap over the test seeds.",
    ]
    if results.get("engine"):
        notes.append(f"Physics engine: {results['engine']}.")
    several = {name: m["training_seeds"] for name, m in methods.items() if _several(m)}
    if several:
        notes.append(_over_seeds(several))
    invariance = [
        f"{name} {m['invariance']:.2g}" for name, m in methods.items() if "invariance" in m
    ]
    if invariance:
        notes.append(
            "Mean change of the action when robot and goal are rotated together by up to 180° "
            f"(Def. 3): {', '.join(invariance)}."
        )
    notes += _fits(methods)
    notes += _origins(methods)
    for module, digests in results.get("other_code", {}).items():
        versions = ", ".join(f"{code} in {' '.join(rows)}" for code, rows in digests.items())
        notes.append(f"The code differs between rows: {module} is {versions}.")
    lost = [f"{name} {100 * m['diverged']:.2f} %" for name, m in methods.items() if m["diverged"]]
    if lost:
        notes.append(f"Diverged episodes, left out of all means: {', '.join(lost)}.")
    return notes


def _fits(methods: Mapping[str, Any]) -> Iterator[str]:
    """Notes on the fits: the error of their actions, and the bearings that they have seen."""
    errors = [
        f"{name} {m['held_out']['error']:.2f} ({m['held_out']['shuffled']:.2f})"
        for name, m in methods.items()
        if "held_out" in m
    ]
    if errors:
        yield (
            "Held-out action error of the fits, as a fraction of the actions' variance (in "
            f"brackets: with d shuffled): {', '.join(errors)}."
        )
    ranges = [
        f"{name} {_degrees(m['bearings'][0])} to {_degrees(m['bearings'][1])}"
        for name, m in methods.items()
        if "bearings" in m
    ]
    if ranges:
        yield f"Bearings of 98 % of the d of each fit, from the heading: {', '.join(ranges)}."


def _degrees(radians: float) -> str:
    return f"{round(math.degrees(radians))}°".replace("-", "−")


def _origins(methods: Mapping[str, Any]) -> Iterator[str]:
    """Notes on the commit, versions and machine that made the rows."""
    made = {name: m["made"] for name, m in methods.items() if m.get("made")}
    for what, name in (("Commit", "commit"), ("Versions", "versions"), ("Hardware", "hardware")):
        of_rows = {row: _values(stages, name) for row, stages in made.items()}
        yield from _by_value(what, of_rows)


def _values(stages: Mapping[str, Any], name: str) -> str:
    """The values that the stages of a row have under a name, each once."""
    found = []
    for origin in stages.values():
        value = origin[name]
        if name == "commit":
            value = (value or "no repository")[:10] + ("" if origin["clean"] else " (changed)")
        if isinstance(value, Mapping):
            value = ", ".join(f"{package} {v}" for package, v in value.items() if v)
        found.append(value)
    return "; ".join(dict.fromkeys(found))


def _by_value(what: str, of_rows: Mapping[str, str]) -> Iterator[str]:
    """One sentence if all rows agree, else one that names the rows of each value."""
    values = dict.fromkeys(of_rows.values())
    if len(values) == 1:
        yield f"{what}: {next(iter(values))}."
    elif values:
        rows = {v: [row for row, x in of_rows.items() if x == v] for v in values}
        yield f"{what}: " + ". ".join(f"{', '.join(r)}: {v}" for v, r in rows.items()) + "."


def _one_seed(methods: Mapping[str, Any]) -> str:
    """The training seed of the rows, in words."""
    seeds = {name: m["training_seed"] for name, m in methods.items() if "training_seed" in m}
    if len(set(seeds.values())) == 1:
        return f"training seed {next(iter(seeds.values()))}"
    named = ", ".join(f"{name} {seed}" for name, seed in seeds.items())
    return f"one training seed ({named})" if named else "one training seed"


def _over_seeds(several: Mapping[str, Any]) -> str:
    """Explains the column “over seeds”, and gives its intervals."""
    numbers = sorted({len(over["means"]) for over in several.values()})
    sizes = {f"{s} × {e}" for over in several.values() for s, e in over["episodes"][1:]}
    after = f"; seeds after the first: {sizes.pop()} test episodes" if len(sizes) == 1 else ""
    text = f"“Over seeds” uses {'–'.join(map(str, numbers))} training seeds (each a complete run"
    text += f"{after}): mean and standard deviation of the means of their tests."
    bounds = {name: over["ci95"] for name, over in several.items() if over["ci95"][0] is not None}
    named = ", ".join(f"{n} {_metres(low)}–{_metres(high)}" for n, (low, high) in bounds.items())
    of_three = " (with three seeds: minimum–maximum)" if 3 in numbers else ""
    return f"{text} 95 % bootstrap intervals{of_three}: {named}." if named else text


def _several(method: Mapping[str, Any]) -> bool:
    return "training_seeds" in method


def _comparisons(results: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The table of paired differences; with columns over training seeds if any pair has them."""
    rows = [_comparison(name, pair) for name, pair in results["paired"].items()]
    over = any(_several(pair) for pair in results["paired"].values())
    return [row if over else row[:BRIEF] for row in (COMPARED, *rows)] if rows else []


def _legend(compared: Sequence[tuple[str, ...]]) -> str:
    """Explains the columns of the comparisons."""
    text = "Paired differences on the same scenarios; negative: the first method comes nearer."
    if not any(len(row) > BRIEF for row in compared):
        return f"{text} Intervals over test seeds."
    text += " First columns: one training seed, intervals over its test seeds"
    return f"{text}; last three: all training seeds."


def _comparison(name: str, pair: Mapping[str, Any]) -> tuple[str, ...]:
    this = (name, _signed(pair["difference"]), _bounds(pair["ci95"]), _percent(pair["improvement"]))
    if not _several(pair):
        return (*this, *[""] * (len(COMPARED) - BRIEF))
    over = pair["training_seeds"]
    count = sum(mean is not None for mean in over["means"])
    nearer = f"{round(2 * count * over['improvement']) / 2:g} of {count}" if count else "–"
    return (*this, _spread(over, "+"), _bounds(over["ci95"]), nearer)


def _bounds(ci95: Sequence[float | None]) -> str:
    low, high = ci95
    return "–" if low is None or high is None else f"[{low:+.3f}, {high:+.3f}]"


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
    """A count with three significant digits: 2 M, 1.05 M, 50 k, 640."""
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if n >= 0.9995 * unit:
            return f"{n / unit:.3g} {name}"
    return str(n)
