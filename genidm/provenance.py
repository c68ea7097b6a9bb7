"""What made a result: the code it depends on, the commit, versions, machine and command.

`code_of` finds the code of a stage: the modules of genidm that its settings, robot, engine and
own function import, directly or through other modules. A module's digest is of its syntax tree
without docstrings and comments, so an edit of these changes nothing. Two kinds are not counted:

- `UNRELATED`: modules that show, check, name or store results, and do not compute them;
- the `__init__` of packages, which only lists names: a new robot must not change the Ant's digest.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax

from genidm.devices import host_memory

PACKAGES = (
    *("genidm", "numpy", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint"),
    *("brax", "mujoco", "mujoco-mjx", "pybullet"),
)
UNRELATED = frozenset(
    f"genidm.{name}"
    for name in (
        *("checkpoints", "checks", "config", "errors", "files", "progress", "provenance"),
        *("quiet", "store"),
    )
)
_PACKAGE = Path(__file__).resolve().parent
# An edit while a process runs changes the files, but not the code that the process runs.
_AT_START = {path: path.read_text(encoding="utf-8") for path in _PACKAGE.rglob("*.py")}


def code_of(*roots: Any, alone: Iterable[str] = ()) -> dict[str, str]:
    """The modules that a result depends on: name → ten hex digits of its code.

    Args:
      roots: names of modules, or objects. An object stands for the modules that define its
        class and the classes of all dataclasses in it.
      alone: names of modules that count without what they import.
    """
    found = {name: _digest(name) for name in alone}
    todo = {name for root in roots for name in _modules_of(root)}
    while todo:
        name = todo.pop()
        tree = None if name in UNRELATED or name in found else _tree(name)
        if tree is not None:
            found[name] = _digest(name)
            todo |= set(_imported(name))
    return dict(sorted(found.items()))


def code_digest(code: Mapping[str, str]) -> str:
    """One digest, ten hex digits, of all modules of `code_of`."""
    text = "\n".join(f"{name} {digest}" for name, digest in sorted(code.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def changed(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Modules that only one of two results has, or whose digests differ."""
    return sorted(n for n in before.keys() | after.keys() if before.get(n) != after.get(n))


def _modules_of(root: Any) -> Iterator[str]:
    if isinstance(root, str):
        yield root
    elif isinstance(root, Mapping):
        yield from (name for x in root.values() for name in _modules_of(x))
    elif isinstance(root, tuple | list):
        yield from (name for x in root for name in _modules_of(x))
    elif dataclasses.is_dataclass(root):
        yield from _defined_in(type(root))
        for field in dataclasses.fields(root):
            value = getattr(root, field.name)
            if not isinstance(value, str):  # a field's text is a setting, not a module
                yield from _modules_of(value)
    elif not isinstance(root, bool | int | float | None):
        yield from _defined_in(type(root))


def _defined_in(kind: type) -> Iterator[str]:
    """The modules of a class and of its base classes."""
    yield from (base.__module__ for base in kind.__mro__)


@functools.cache
def _tree(name: str) -> ast.Module | None:
    """The syntax tree of a module of genidm or of the user; None of other modules."""
    path = _path(name)
    if path is None:
        return None
    return ast.parse(_AT_START.get(path) or path.read_text(encoding="utf-8"))


def _path(name: str) -> Path | None:
    """The file of a module; None for packages, Python's and installed modules, and notebooks."""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    if module is None and (name == "genidm" or name.startswith("genidm.")):
        parts = name.split(".")[1:]
        file = str(_PACKAGE.joinpath(*parts).with_suffix(".py"))
    path = Path(file).resolve() if file else None
    if path is None or path.suffix != ".py" or path.name == "__init__.py" or not path.exists():
        return None
    if _PACKAGE in path.parents:
        return path
    installed = "site-packages" in path.parts or Path(os.__file__).parent in path.parents
    return None if installed else path


@functools.cache
def _digest(name: str) -> str:
    return hashlib.sha256(dump(_tree(name)).encode()).hexdigest()[:10]


def dump(node: Any) -> str:
    """A syntax tree as text, without docstrings; the same with every version of Python.

    `ast.dump` is not: newer versions add fields, and leave out empty ones.
    """
    if isinstance(node, list):
        return f"[{','.join(dump(x) for x in node if not _is_text(x))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = [(name, x) for name, x in ast.iter_fields(node) if x is not None and x != []]
    return f"{type(node).__name__}({','.join(f'{name}={dump(x)}' for name, x in fields)})"


def _is_text(node: ast.AST) -> bool:
    """Whether a statement is a docstring, also of an attribute."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


@functools.cache
def _imported(name: str) -> tuple[str, ...]:
    """The modules of genidm, and of the user, that a module imports."""
    tree, found = _tree(name), list[str]()
    assert tree
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(n for n in found if _path(n))


@functools.cache
def environment() -> dict[str, Any]:
    """The versions, machine and commit that make results here.

    Returns:
      `versions` of packages (None if not installed), `hardware` in one line, the settings of
      `jax` that change bits, git `commit` and whether its tree is `clean` (both None outside a
      clone).
    """
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    settings = jax.config.values
    devices = f"{jax.device_count()} jax devices ({jax.devices()[0].device_kind})"
    commit, clean = _commit()
    return {
        "versions": versions,
        "hardware": f"{_machine()}, {devices}",
        "jax": {
            "enable_x64": settings["jax_enable_x64"],
            "matmul_precision": settings["jax_default_matmul_precision"],
            "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
        },
        "commit": commit,
        "clean": clean,
    }


def command() -> str:
    """The command line of this process, quoted for a shell."""
    name = getattr(getattr(sys.modules["__main__"], "__spec__", None), "name", None)
    program = ["python", "-m", name.removesuffix(".__main__")] if name else sys.argv[:1]
    return shlex.join([*program, *sys.argv[1:]])


def _machine() -> str:
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", info.read_text()) if info.exists() else None
    model = found[1] if found else platform.processor() or platform.machine()
    return f"{model}, {os.cpu_count()} cores, {host_memory() / 2**30:.0f} GiB"


def _commit() -> tuple[str | None, bool | None]:
    """The commit of the clone that contains this package, and whether its tree is clean."""
    git = ["git", "-C", str(_PACKAGE)]
    try:
        top, commit = _lines([*git, "rev-parse", "--show-toplevel", "HEAD"])[:2]
        # An installed package may lie inside an unrelated repository.
        if Path(top) != _PACKAGE.parent:
            return None, None
        return commit, not _lines([*git, "status", "--porcelain"])
    except (OSError, ValueError, subprocess.CalledProcessError):
        return None, None


def _lines(command: Iterable[str]) -> list[str]:
    out = subprocess.run([*command], capture_output=True, text=True, check=True).stdout
    return out.splitlines()
