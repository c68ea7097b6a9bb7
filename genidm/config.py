"""What a run is made with, and where: configs as JSON, their digests, the environment."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import importlib.metadata
import json
import math
import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

import jax
import numpy as np

from genidm.errors import BadInput

PACKAGES = (
    *("genidm", "numpy", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint"),
    *("brax", "mujoco", "mujoco-mjx", "pybullet"),
)


def plain(config: Any) -> Any:
    """A config as JSON can hold it.

    Dataclasses become dicts that also name their `class`; tuples and arrays, lists; paths
    and numbers that are not finite, strings; enums, functions and classes, their qualified
    names (what a function has captured is not seen).

    Raises:
      BadInput: nothing tells a thing in it from others of its type.
    """
    if isinstance(config, enum.Enum):
        return f"{_qualified(type(config))}.{config.name}"
    if config is None or isinstance(config, bool | int | str):
        return config
    if isinstance(config, float):
        return float(config) if math.isfinite(config) else str(float(config))
    if isinstance(config, PurePath):
        return str(config)
    if isinstance(config, np.ndarray | np.generic | jax.Array):
        return plain(config.tolist())
    if isinstance(config, Mapping):
        return {k if isinstance(k, str) else str(plain(k)): plain(v) for k, v in config.items()}
    if isinstance(config, tuple | list):
        return [plain(x) for x in config]
    if hasattr(config, "__qualname__"):
        return _qualified(config)
    if dataclasses.is_dataclass(config):
        values = {f.name: plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
        return {"class": _qualified(type(config)), **values}
    raise BadInput(f"a {type(config).__name__} cannot stand in a config: {config!r:.80}")


def _qualified(x: Any) -> str:
    module = x.__module__
    if module == "__main__":  # `python -m experiments.ant_lr` is experiments.ant_lr
        module = getattr(getattr(sys.modules[module], "__spec__", None), "name", module)
    return f"{module}.{x.__qualname__}"


def digest(config: Any) -> str:
    """Ten hex digits of the sha256 of the config's canonical JSON: its name in paths."""
    text = json.dumps(plain(config), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def environment() -> dict[str, Any]:
    """Where a run is made: `versions` of packages, `hardware` in a line, git `commit`."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    devices = f"{jax.device_count()} jax devices ({jax.devices()[0].device_kind})"
    return {"versions": versions, "hardware": f"{_machine()}, {devices}", "commit": _commit()}


def _machine() -> str:
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", info.read_text()) if info.exists() else None
    model = found[1] if found else platform.processor() or platform.machine()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{model}, {os.cpu_count()} cores, {memory:.0f} GiB"


def _commit() -> str | None:
    package = Path(__file__).resolve().parent
    command = ["git", "-C", str(package), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    top, commit = out.split("\n")[:2]
    # Not the commit of a repository that happens to lie around an installed package.
    return commit if Path(top) == package.parent else None
