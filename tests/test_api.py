"""The public API: every name of `genidm.__all__` is there, typed and documented.

python tests/test_api.py > docs/api.md      # writes the page anew
"""

from __future__ import annotations

import ast
import importlib
import inspect
import itertools
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import genidm

ROOT = Path(__file__).parents[1]
NAMES = [name for name in genidm.__all__ if not inspect.ismodule(getattr(genidm, name))]


def python(code: str) -> str:
    """What a fresh interpreter prints."""
    made = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    return made.stdout


# ── names ───────────────────────────────────────────────────────────────────────────────────


def test_every_name_is_once_there_and_listed_by_dir() -> None:
    assert len(set(genidm.__all__)) == len(genidm.__all__) > 30
    assert set(genidm.__all__) <= set(dir(genidm))
    for name, module in genidm._HOME.items():
        assert getattr(genidm, name) is getattr(importlib.import_module(f"genidm.{module}"), name)


def test_no_name_is_that_of_a_module_or_of_two_things() -> None:
    """Importing the module would else put it where the function was."""
    package = Path(genidm.__file__).parent
    modules = {p.stem for p in package.glob("*.py")} | {
        p.parent.name for p in package.glob("*/*.py")
    }
    assert not modules & set(NAMES)
    assert set(genidm._MODULES) <= modules


def test_names_stay_what_they_are_whatever_is_imported_first() -> None:
    ways = [f"import genidm.{m}" for m in sorted({*genidm._HOMES, *genidm._MODULES})]
    ask = "print([(n, type(getattr(genidm, n)).__name__) for n in sorted(genidm.__all__)])"
    first = python(f"import genidm; {ask}")
    assert first == python("; ".join(["import genidm", *ways, ask]))
    assert first == python(f"from genidm import *; import genidm; {ask}")


def test_nothing_is_imported_before_it_is_used() -> None:
    heavy = "[m for m in ('jax', 'mujoco', 'brax', 'matplotlib', 'numpy') if m in sys.modules]"
    ask = f"import sys, genidm; dir(genidm); genidm.__all__; print({heavy})"
    assert python(ask) == "[]\n"
    some = "import sys, genidm; genidm.BadInput; print('jax' in sys.modules, genidm.BadInput('x'))"
    assert python(some) == "False x\n"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"^module 'genidm' has no attribute 'Antt'$"):
        genidm.Antt  # noqa: B018
    assert not hasattr(genidm, "__wrapped__")


def test_type_checkers_see_the_same_names() -> None:
    """What stands under TYPE_CHECKING, and where it comes from."""
    tree = ast.parse(Path(genidm.__file__).read_text(encoding="utf-8"))
    (typed,) = (node for node in tree.body if isinstance(node, ast.If) and not node.orelse
                and isinstance(node.test, ast.Name))  # fmt: skip
    seen = {}
    for node in typed.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.name == alias.asname  # or it would not count as exported
            seen[alias.name] = node.module
    homes = {name: f"genidm.{module}" for name, module in genidm._HOME.items()}
    assert seen == homes | dict.fromkeys(genidm._MODULES, "genidm")


# ── documentation ───────────────────────────────────────────────────────────────────────────


def listed(doc: str, section: str) -> set[str]:
    """Names that a section of a docstring describes."""
    found = re.search(rf"^{section}:\n((?:  .*\n|\n)*)", f"{doc}\n", re.MULTILINE)
    return set(re.findall(r"^  (\w+):", found[1], re.MULTILINE)) if found else set()


def described(kind: type) -> set[str]:
    """What the docstrings of a class and its bases describe."""
    docs = [inspect.getdoc(c) or "" for c in kind.__mro__ if c.__module__.startswith("genidm")]
    return set().union(*(listed(d, s) for d in docs for s in ("Args", "Attributes")))


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_documented_argument_by_argument(name: str) -> None:
    thing = getattr(genidm, name)
    doc = inspect.getdoc(thing)
    assert doc and doc.split("\n")[0].endswith((".", ":"))
    if not callable(thing) or issubclass(getattr(thing, "__class__", object), Exception):
        return
    if inspect.isclass(thing) and issubclass(thing, Exception):
        return
    arguments = {
        p.name for p in inspect.signature(thing).parameters.values()
        if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
    }  # fmt: skip
    known = described(thing) if inspect.isclass(thing) else listed(doc, "Args")
    assert arguments <= known, f"{name}: {sorted(arguments - known)} are not described"


def first_sentence(thing: Any) -> str:
    """The first line of the docstring; of a record, that of its class."""
    doc = inspect.getdoc(thing)
    assert doc
    return doc.split("\n")[0]


def entry(name: str) -> str:
    """A row of the page."""
    thing = getattr(genidm, name)
    if inspect.ismodule(thing):
        return f"| `genidm.{name}` | {first_sentence(thing)} |"
    call = name if inspect.isclass(thing) or not callable(thing) else f"{name}(…)"
    what = first_sentence(thing)
    if not inspect.isclass(thing) and not callable(thing):
        what = f"The record of the method {name} (`{type(thing).__name__}`)."
    return f"| `genidm.{call}` | {what} |"


def page() -> str:
    """docs/api.md."""
    rows = itertools.chain(genidm._HOME, genidm._MODULES)
    head = (ROOT / "docs" / "api.md").read_text(encoding="utf-8").split("\n| name |")[0]
    return "\n".join([head, "| name | what it is |", "|:--|:--|", *map(entry, rows)])


def test_the_page_lists_them_all() -> None:
    assert (ROOT / "docs" / "api.md").read_text(encoding="utf-8") == page() + "\n"


def blocks(path: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / path).read_text(encoding="utf-8"), re.DOTALL)


def test_the_pages_programs_use_names_that_are_there() -> None:
    used = {n for b in blocks("docs/api.md") for n in re.findall(r"\bgenidm\.([A-Za-z_]+)", b)}
    assert len(used) > 8 and used <= set(genidm.__all__)


if __name__ == "__main__":
    (ROOT / "docs" / "api.md").write_text(page() + "\n", encoding="utf-8")
