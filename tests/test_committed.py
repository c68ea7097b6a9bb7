"""The tables of the README and the docs are the numbers that are committed beside them."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from experiments import physics
from genidm import report
from genidm.paper import protocol

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
TABLES = sorted(path.name.removesuffix("_table.md") for path in RESULTS.glob("*_table.md"))
DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

# Of each page, its tables whose rows are methods or pairs, in order: the results that their
# columns are copied from; () where nothing is.
COPIES: dict[str, list[tuple[str, ...]]] = {
    "README.md": [(), ("ant",), ("ant",), ("humanoid",), ("minitaur",)],
    "choices.md": [()],
    "engines.md": [("ant", "ant_mujoco")],
    "table1.md": [("ant",), ("ant",)],
    "table1_humanoid.md": [("humanoid",), ("humanoid", "humanoid_world")],
    "table1_minitaur.md": [("minitaur",), ("minitaur_half",)],
}


class Table(NamedTuple):
    """A table of a page: names of its columns, and its rows by their first cell."""

    head: list[str]
    rows: dict[str, list[str]]


def tables(text: str) -> list[Table]:
    """All tables of a page whose rows are methods or pairs of them."""
    found, lines = [], text.splitlines()
    for n, line in enumerate(lines[:-1]):
        if line.startswith(("| method |", "| pair |")) and lines[n + 1].startswith("|:--"):
            end = next((k for k in range(n, len(lines)) if not lines[k].startswith("|")), None)
            body = [[cell.strip() for cell in row.split("|")[2:-1]] for row in lines[n + 2 : end]]
            names = [row.split("|")[1].strip() for row in lines[n + 2 : end]]
            head = [cell.strip() for cell in line.split("|")[2:-1]]
            found.append(Table(head, dict(zip(names, body, strict=True))))
    return found


def results(name: str) -> dict[str, Any]:
    return json.loads((RESULTS / f"{name}.json").read_text())


def committed(name: str, row: str) -> dict[tuple[str, int], str]:
    """The cells of a method or pair, by the name of their column and how often it came before."""
    for table in tables(report.markdown(results(name))):
        if row in table.rows:
            return dict(zip(numbered(table.head), table.rows[row], strict=True))
    raise AssertionError(f"{row} is in no table of {name}")


def numbered(head: list[str]) -> list[tuple[str, int]]:
    before: Counter[str] = Counter()
    return [(name, (before.update([name]), before[name])[1]) for name in head]


def origins(table: Table, sources: tuple[str, ...]) -> list[tuple[str, tuple[str, int]]]:
    """For each column of a page's table, the results that it is of, and its name there.

    A column "…, m" is the mean of a robot or an engine: with each, another results file begins.
    """
    named: list[list[str]] = []
    for name in table.head:
        means = name.endswith(", m") and name not in ("difference, m", "the paper, m")
        if means or not named:
            named.append([])
        renamed = {"the paper, m": "paper"}.get(name, name)
        named[-1].append("mean ± std" if means else renamed)
    assert len(named) == len(sources)
    return [
        (source, column)
        for source, names in zip(sources, named, strict=True)
        for column in numbered(names)
    ]


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_made_of_the_results_beside_it(name: str) -> None:
    made = results(name)
    assert (RESULTS / f"{name}_table.md").read_text().rstrip() == report.markdown(made).rstrip()
    text = RESULTS / f"{name}_table.txt"
    if text.exists():
        assert text.read_text().startswith(report.text(made))


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.name)
def test_a_page_copies_what_is_committed(page: Path) -> None:
    found, expected = tables(page.read_text()), COPIES.get(page.name, [])
    assert len(found) == len(expected), "say in COPIES what a new table is copied from"
    for table, sources in zip(found, expected, strict=True):
        if not sources:
            continue
        assert table.rows
        for row, cells in table.rows.items():
            here = {name: committed(name, row) for name in sources}
            there = [here[name].get(column) for name, column in origins(table, sources)]
            assert cells == there, f"{row} of {sources}"


@pytest.mark.parametrize("page", ["README.md", "table1.md"])
def test_no_method_of_the_ant_is_left_out(page: str) -> None:
    (path,) = (path for path in DOCS if path.name == page)
    table = next(t for t in tables(path.read_text()) if "RS" in t.rows and len(t.head) > 3)
    assert list(table.rows) == list(results("ant")["methods"])


def test_the_witness_has_learned_what_the_page_says() -> None:
    made = results("witness")
    parts = {"random actions": made["random"]}
    parts |= {f"{int(n):,}": row for n, row in made["HER + SAC"].items()}
    page = (ROOT / "docs" / "table1.md").read_text()
    for name, row in parts.items():
        cells = f"{row['mean']:.2f} ± {row['std']:.2f} | {100 * row['within_1_m']:.0f} %"
        assert f"| {name} | {cells} |\n" in page


# A row of the README's tables of speed → the row of the benchmark that it is copied from.
# Not in a file: raw stepping by two threads, the same from programs, and 𝒢, on MuJoCo in C.
SPEEDS = {
    "ant_mujoco_benchmark": {
        "collecting at random": "collecting, random actions",
        "collecting with PPO, which learns meanwhile": "collecting, PPO",
        "evaluation, busy lanes": "evaluation",
        "PPO": "PPO",
    },
    "ant_benchmark": {
        "raw MJX, two devices": "raw MJX, two devices",
        "raw MJX, four devices": "raw MJX, all devices",
        "collecting with PPO, which learns meanwhile": "collecting, PPO",
        "the same, its record kept": "PPO, record kept",
        "collecting at random": "collecting, random actions",
        "𝒢": "𝒢",
        "evaluation, busy lanes": "evaluation",
        "HER_SP, stepping and learning": "collecting, HER_SP",
        "HER_DE, stepping and learning": "collecting, HER_DE",
        "fit of LR": "fit of LR",
        "PPO": "PPO",
    },
}


def test_speeds_are_those_of_the_benchmarks() -> None:
    _, *parts = (ROOT / "README.md").read_text().split("| what | a second |")
    for part, (name, copied) in zip(parts, SPEEDS.items(), strict=True):
        measured = {row["name"].partition(" (")[0]: row for row in results(name)}
        lines = (line for line in part.splitlines() if line.startswith("| "))
        shown = {cells[0]: cells[1:] for cells in (line[2:].split(" | ") for line in lines)}
        for here, there in copied.items():
            speed, ratio, _ = shown[here]
            value = measured[there]["value"]
            assert float(speed.split()[0].replace(",", "")) == round(value, -2 * (value > 1000))
            assert ratio == f"{measured[there]['ratio']:.{len(ratio.partition('.')[2])}f}"


@pytest.mark.parametrize("robot", ["ant", "humanoid"])
def test_the_physics_is_as_stable_as_the_page_says(robot: str) -> None:
    made, page = results(f"{robot}_physics"), (ROOT / "docs" / "physics.md").read_text()
    assert physics.stability_table(made["stability"]) in page
    assert physics.drift_table(made["drift"]) in page


def test_the_minitaurs_physics_is_what_the_page_says() -> None:
    pytest.importorskip(
        "pybullet", reason="PyBullet is not installed: there is no wheel of it here"
    )
    from experiments import minitaur_physics, minitaur_processes

    made, page = results("minitaur_physics"), (ROOT / "docs" / "physics.md").read_text()
    assert minitaur_processes.processes_table(made["processes"]) in page
    assert minitaur_physics.calls_table(made["calls"]) in page
    assert minitaur_physics.fidelity_table(made["fidelity"]) in page
    assert minitaur_physics.drift_table(made["drift"]) in page


# Table 1 as the paper prints it, turned on its side.
PRINTED = """
         humanoid      minitaur     ant
RS       3.159 .579    1.598 .282   3.166 .569
RL       2.777 .841    1.403 .438   2.155 1.054
VGCP     2.160 .955    1.358 .326   2.608 .607
HER_SP   2.902 1.138   1.440 .237   2.602 .953
HER_DE   2.891 1.135   1.380 .251   2.475 .693
GE       1.936 .977    1.212 .485   1.721 .978
LR       1.779 .986    0.904 .482   1.105 .866
"""


def test_table_1_is_the_papers() -> None:
    robots, *rows = (line.split() for line in PRINTED.strip().splitlines())
    assert {
        robot: {name: (float(cells[2 * n]), float(cells[2 * n + 1])) for name, *cells in rows}
        for n, robot in enumerate(robots)
    } == protocol.TABLE1
