"""What all tests share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

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
import small_cells
from small_cells import Finished

from genidm.robots import Ant
from genidm.runs import cell as cell_module


@pytest.fixture(scope="session")
def ant() -> Ant:
    return Ant()


@pytest.fixture
def strict_ranks() -> Iterator[None]:
    """Makes it an error that arrays of unlike rank meet, as `x [B, n]` and `yaw [B]` must not."""
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Finished:
    """The cells of GE, RS and LR on a point, in this order."""
    return small_cells.finish(
        tmp_path_factory.mktemp("runs"), small_cells.GE, small_cells.RS, small_cells.LR
    )


@pytest.fixture(scope="session")
def direct(tmp_path_factory) -> Finished:
    """The cell of a method that learns to go to goals itself."""
    return small_cells.finish(tmp_path_factory.mktemp("direct"), small_cells.VGCP)


@pytest.fixture
def one_bank(monkeypatch) -> None:
    """Cells share the scenarios that are drawn for them."""
    monkeypatch.setattr(
        cell_module,
        "scenarios",
        lambda robot, *numbers: small_cells.tested_scenarios(robot.name, *numbers),
    )


@pytest.fixture
def copy(finished: Finished, tmp_path: Path) -> Path:
    """The finished cells' files, to be changed."""
    return shutil.copytree(finished.out, tmp_path / "runs")
