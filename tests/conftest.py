"""What all tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator

# Read when genidm is imported, so set before it: two devices, for tests that compare
# `devices.mesh(jax.devices()[:1])` with `devices.mesh()`.
os.environ["GENIDM_DEVICES"] = "2"
# Tests compile hundreds of small programs, and most of them again in every run.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
# Most of a test's time is compiling, which takes half as long so. `make test-all` compiles as
# users do.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax
import pytest

from genidm.robots import Ant


@pytest.fixture(scope="session")
def ant() -> Ant:
    return Ant()


@pytest.fixture
def strict_ranks() -> Iterator[None]:
    """Makes it an error that arrays of unlike rank meet, as `x [B, n]` and `yaw [B]` must not."""
    with jax.numpy_rank_promotion("raise"):
        yield
