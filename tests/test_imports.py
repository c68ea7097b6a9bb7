"""Imports follow the way the data flows: from each line of ORDER only to lines above it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

import genidm

PACKAGE = Path(genidm.__file__).parent

# Modules on one line know nothing of each other.
ORDER = """
errors evaluation.episodes quiet paper.protocol
checks devices registry trees renamed
symmetry
evaluation offline paper runs
config
files
checkpoints progress provenance
store
engines.base engines.pool
engines.*
engines
robots.base robots.minitaur_world
robots.mujoco
robots.*
robots.ant_v2
robots.minitaur_env
robots
rollout tasks
experience
agents.policy agents.buffer agents.mirroring
agents.base agents.her
agents.rollout_then_learn agents.unroll agents.remembering
agents.off_policy
agents.*
agents.frozen
agents
agents.collect
paper.replaying
paper.pairs
paper.generalize paper.idm offline.networks offline.data
offline.policy offline.learner
offline.gcbc offline.implicit offline.crl
offline.gcivl offline.hiql
controller
paper.fit
paper.held_out
evaluation.scenarios evaluation.planners
evaluation.evaluator
evaluation.evaluate
evaluation.invariance evaluation.waypoints
evaluation.stats evaluation.sanity
report.rows
report.table report.drawing
report.figures report.waypoint_figure report.held_out_figure
report
paper.methods offline.train
paper.author offline.methods
runs.scale
runs.resolve runs.run
runs.recording
runs.fitting runs.policies
runs.offline
report.runs
report.shown
report.write
video.clips video.scenery video.backends video.encoding
video.rendering video.pages
video
runs.cell
runs.command
video.__main__
genidm
"""

RANKS = {name: rank for rank, line in enumerate(ORDER.split("\n")) for name in line.split()}


def rank(module: str) -> int:
    """The line of ORDER that a module, named without `genidm.`, stands on.

    Raises:
      LookupError: it stands on none.
    """
    if module in RANKS:
        return RANKS[module]
    for pattern, line in RANKS.items():
        if fnmatchcase(module, pattern):
            return line
    raise LookupError(f"{module} has no place in the order of imports: give it one")


def modules() -> dict[str, Path]:
    """Every module of the package, named without `genidm.`; the package itself is `genidm`."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(p for p in parts if p != "__init__") or "genidm"] = path
    return found


def imported(source: str, known: set[str]) -> Iterator[str]:
    """The modules of the package that a source imports, wherever in it that stands."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from named(alias.name)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for module in named(node.module or ""):
                prefix = "" if module == "genidm" else f"{module}."
                names = (f"{prefix}{alias.name}" for alias in node.names)
                yield from (name if name in known else module for name in names)


def named(module: str) -> list[str]:
    package, _, rest = module.partition(".")
    return [rest or "genidm"] if package == "genidm" else []


def back_edges(sources: dict[str, str]) -> list[str]:
    known = set(sources)
    return [
        f"{module} imports {other}"
        for module, source in sources.items()
        for other in sorted(set(imported(source, known)))
        if rank(other) >= rank(module)
    ]


def test_no_import_goes_against_the_flow() -> None:
    sources = {name: path.read_text() for name, path in modules().items()}
    assert len(sources) > 25
    assert back_edges(sources) == []


def test_every_line_of_the_order_names_a_module() -> None:
    there = modules()
    assert [p for p in RANKS if not any(fnmatchcase(m, p) for m in there)] == []


def test_the_package_imports_neither_its_experiments_nor_its_tests() -> None:
    for path in modules().values():
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {n.partition(".")[0] for n in names} & {"experiments", "tests"}, path


@pytest.mark.parametrize(
    ("source", "edges"),
    [
        ("from genidm import errors", []),
        ("import genidm.experience", ["store imports experience"]),
        ("from genidm import experience", ["store imports experience"]),
        ("from genidm.robots import ant", ["store imports robots.ant"]),
        ("from genidm.robots import Robot", ["store imports robots"]),
        ("from genidm.robots.ant import Ant", ["store imports robots.ant"]),
        ("def f():\n    from genidm.experience import Experience", ["store imports experience"]),
        ("import numpy, os.path\nfrom jax import jit", []),
    ],
)
def test_a_back_edge_is_seen_however_it_is_written(source: str, edges: list[str]) -> None:
    empty = dict.fromkeys(("errors", "experience", "robots", "robots.ant"), "")
    assert back_edges({**empty, "store": source}) == edges


def test_a_module_without_a_place_is_an_error() -> None:
    with pytest.raises(LookupError, match="give it one"):
        back_edges({"homeless": "import genidm.store"})
