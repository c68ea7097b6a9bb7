"""Configs of runs as JSON, and their digests."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import jax
import numpy as np

from genidm.errors import BadInput


def to_json(config: Any) -> Any:
    """Convert a config to values that JSON supports.

    Dataclasses become dicts with an extra key `class`. Tuples and arrays become lists. Paths, NaN
    and infinity become strings. Enums, functions and classes become their names, without captured
    variables, and without the module, so that a class can move.

    Raises:
      BadInput: the config holds an object of another type.
    """
    if isinstance(config, enum.Enum):
        return f"{type(config).__qualname__}.{config.name}"
    if config is None or isinstance(config, bool | int | str):
        return config
    if isinstance(config, float):
        return float(config) if math.isfinite(config) else str(float(config))
    if isinstance(config, PurePath):
        return str(config)
    if isinstance(config, np.ndarray | np.generic | jax.Array):
        return to_json(config.tolist())
    if isinstance(config, Mapping):
        return {k if isinstance(k, str) else str(to_json(k)): to_json(v) for k, v in config.items()}
    if isinstance(config, tuple | list):
        return [to_json(x) for x in config]
    if hasattr(config, "__qualname__"):
        return str(config.__qualname__)
    if dataclasses.is_dataclass(config):
        values = {f.name: to_json(getattr(config, f.name)) for f in dataclasses.fields(config)}
        return {"class": type(config).__qualname__, **values}
    raise BadInput(f"a {type(config).__name__} cannot be part of a config: {config!r:.80}")


def digest(config: Any) -> str:
    """First ten hex digits of the SHA-256 of the config's canonical JSON, for directory names."""
    text = json.dumps(to_json(config), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten a nested dict: `{"a": {"b": 1}}` becomes `{"a.b": 1}`."""
    if not isinstance(tree, Mapping):
        return {prefix.removesuffix("."): tree}
    return {k: x for name, part in tree.items() for k, x in flat(part, f"{prefix}{name}.").items()}
