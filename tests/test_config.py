"""What a run is made with has one name, and is written down."""

from __future__ import annotations

import dataclasses
import enum
import json
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from genidm import config
from genidm.errors import BadInput


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


@dataclasses.dataclass(frozen=True)
class Inner:
    rate: float = 1e-3
    colour: Colour = Colour.RED


@dataclasses.dataclass(frozen=True)
class Config:
    inner: Inner = Inner()
    sizes: tuple[int, ...] = (64, 64)
    path: Path = Path("a/b")
    nothing: None = None


@dataclasses.dataclass(frozen=True)
class Other:
    inner: Inner = Inner()
    sizes: tuple[int, ...] = (64, 64)
    path: Path = Path("a/b")
    nothing: None = None


def test_plain_is_readable_json() -> None:
    plain = config.to_json({"c": Config(), "f": jnp.tanh, "x": np.float32(0.5), "bad": np.inf})
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["c"]["class"] == "Config"
    assert plain["c"]["inner"]["colour"] == "Colour.RED"
    assert plain["c"]["path"] == "a/b"
    assert (plain["x"], plain["bad"]) == (0.5, "inf")


def test_digest_sees_every_difference_and_nothing_else() -> None:
    base = config.digest(Config())
    assert re.fullmatch("[0-9a-f]{10}", base)
    assert base == config.digest(Config(sizes=[64, np.int64(64)]))
    changed = [
        Config(inner=Inner(rate=2e-3)),
        Config(inner=Inner(colour=Colour.BLUE)),
        Config(sizes=(64, 65)),
        Config(path=Path("a/c")),
        Other(),
    ]
    assert len({base, *map(config.digest, changed)}) == 1 + len(changed)
    assert config.digest({"a": 1, "b": 2}) == config.digest({"b": 2, "a": 1})
    assert config.digest(jnp.tanh) != config.digest(jnp.sin)
    # Names of directories must not change from one version to the next.
    assert config.digest({"a": (1, 2.5, None, True)}) == "115eaa7689"


def test_digest_refuses_what_it_cannot_tell_apart() -> None:
    with pytest.raises(BadInput, match="cannot be part of a config"):
        config.digest({"robot": object()})
