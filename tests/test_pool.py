"""Rows through worker processes that die, hang, or are killed."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from genidm.engines.pool import MOST_ROWS, TRIES, Pool, portions
from genidm.errors import BadInput

STAND_IN = [sys.executable, str(Path(__file__).with_name("stand_in.py"))]


@pytest.fixture
def make() -> Iterator[Callable[..., Pool]]:
    made: list[Pool] = []

    def pool(*flags: str, **settings) -> Pool:
        made.append(Pool([*STAND_IN, *flags], 1, **({"workers": 2} | settings)))
        return made[-1]

    yield pool
    for pool_ in made:
        pool_.close()


def rows(count: int) -> np.ndarray:
    return np.random.default_rng(count).uniform(0, 9, (count, 2)).astype(np.float32)


def idle(pool: Pool) -> list[int]:
    """Process ids of the idle ones."""
    return pool.processes


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_answers_come_in_order(make: Callable[..., Pool], count: int) -> None:
    x = rows(count)
    assert np.array_equal(make().map(x), x.sum(1, keepdims=True))


@pytest.mark.parametrize(("count", "workers"), [(0, 4), (1, 4), (128, 4), (512, 1), (7, 16)])
def test_rows_are_given_out_in_ever_smaller_portions(count: int, workers: int) -> None:
    sizes = portions(count, workers)
    assert sum(sizes) == count and sizes == sorted(sizes, reverse=True)
    assert all(size <= MOST_ROWS for size in sizes) and sizes[-1:] in ([], [1])


def test_workers_are_started_once(make: Callable[..., Pool]) -> None:
    pool = make()
    assert idle(pool) == []
    assert pool.greeting() == [7]
    for _ in range(10):
        pool.map(rows(20))
    first = set(idle(pool))
    pool.map(rows(20))
    assert set(idle(pool)) == first and len(first) <= 2


@pytest.mark.parametrize(("number", "patience"), [(13, 30.0), (14, 0.5)])
def test_a_row_that_costs_its_worker_is_the_only_one_lost(
    make: Callable[..., Pool], number: int, patience: float
) -> None:
    pool, x = make(patience=patience), rows(40)
    pool.map(x)
    x[17, 0] = number
    with pytest.warns(RuntimeWarning, match="another one replaces it"):
        answers = pool.map(x)[:, 0]
    assert np.flatnonzero(np.isnan(answers)).tolist() == [17]
    assert np.array_equal(np.delete(answers, 17), np.delete(x.sum(1), 17))
    assert pool.replaced == 2  # with the rows beside it, and alone
    assert np.array_equal(pool.map(x[:10])[:, 0], x[:10].sum(1))


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP])
def test_a_worker_that_is_shot_takes_nothing_with_it(
    make: Callable[..., Pool], blow: signal.Signals
) -> None:
    pool, x = make(patience=1.0), rows(40)
    pool.map(x)
    for pid in idle(pool):
        os.kill(pid, blow)
    with pytest.warns(RuntimeWarning, match="died or hung"):
        answers = pool.map(x)
    assert np.array_equal(answers, x.sum(1, keepdims=True))
    assert 1 <= pool.replaced <= 2


def test_a_worker_that_never_starts_is_an_error(make: Callable[..., Pool]) -> None:
    pool = make("stillborn")
    said = rf"failed to start, {TRIES} times: .*stand_in\.py stillborn"
    for ask in (pool.greeting, lambda: pool.map(rows(40)), pool.greeting):
        with pytest.raises(BadInput, match=said):  # nobody waits for it, either
            ask()


@pytest.mark.parametrize("deaths", [1, TRIES - 1])
def test_a_worker_that_is_killed_before_it_has_said_anything_is_started_again(
    make: Callable[..., Pool], tmp_path: Path, deaths: int
) -> None:
    pool, x = make(str(tmp_path / "starts"), str(deaths), workers=1), rows(40)
    assert np.array_equal(pool.map(x), x.sum(1, keepdims=True))
    assert pool.replaced == 0  # no row is to blame
    assert len((tmp_path / "starts").read_text()) == deaths + 1


def test_a_worker_that_dies_later_is_replaced_by_one_that_starts_late(
    make: Callable[..., Pool], tmp_path: Path
) -> None:
    starts = tmp_path / "starts"
    pool, x = make(str(starts), "0", workers=1), rows(5)
    pool.map(x)
    starts.write_text("")
    pool.command = [*pool.command[:-1], "2"]
    for pid in idle(pool):
        os.kill(pid, signal.SIGKILL)
    with pytest.warns(RuntimeWarning, match="another one replaces it"):
        assert np.array_equal(pool.map(x), x.sum(1, keepdims=True))
    assert len(starts.read_text()) == 3


def test_many_may_ask_at_once(make: Callable[..., Pool]) -> None:
    pool = make()
    asked = [rows(count) for count in range(1, 60)]
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(pool.map, asked))
    for x, y in zip(asked, answers, strict=True):
        assert np.array_equal(y, x.sum(1, keepdims=True))


def test_closing_ends_the_workers(make: Callable[..., Pool]) -> None:
    pool = make()
    pool.map(rows(40))
    (first, *_) = idle(pool)
    pool.close()
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
