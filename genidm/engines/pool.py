"""A pool of worker processes that maps rows of numbers to rows of numbers.

A worker keeps no state between rows, so a crash loses nothing: another worker gets its rows.
Workers are plain programs that communicate over pipes: they import neither the caller's script
nor jax, and they end when the pipe closes, however this process dies.
"""

from __future__ import annotations

import contextlib
import os
import queue
import select
import subprocess
import threading
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from genidm.devices import cores
from genidm.errors import BadInput

# Most rows in one request: a small number, because a lost worker costs all rows of its request.
MOST_ROWS = 16
# Seconds that a worker may take to load its model.
START_SECONDS = 120.0
# Attempts to start a worker: a start may fail because the machine is short of memory.
TRIES = 3


def portions(count: int, workers: int) -> list[int]:
    """Splits `count` rows into requests; returns the sizes of the requests, in order.

    The first are large, because a request costs a tenth of a millisecond; the last hold one row
    each, so that all workers finish at nearly the same time.
    """
    sizes: list[int] = []
    while left := count - sum(sizes):
        sizes.append(min(MOST_ROWS, -(-left // (2 * workers))))
    return sizes


class Lost(Exception):
    """A worker died, or did not answer in time."""


class Worker:
    """A process that answers rows of float32.

    It sends its first answer, `greeting [out]`, without a request. A request is an int32 n and
    n rows; its answer is n rows.

    Args:
      command: the program and its arguments.
      size: numbers in an answered row.

    Raises:
      Lost: it died or sent no greeting in time.
    """

    def __init__(self, command: Sequence[str], size: int):
        # One thread per worker, because there is one worker per core.
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, bufsize=0, env=environment
        )
        assert self.process.stdin and self.process.stdout
        self._sink, self._source = self.process.stdin.fileno(), self.process.stdout.fileno()
        self._size = size
        try:
            self.greeting = self._receive(1, START_SECONDS)[0]
        except BaseException:
            self.kill()
            raise

    def exchange(self, rows: np.ndarray, patience: float) -> np.ndarray:
        """Sends `rows [n, in]` and returns the answers `[n, out]`.

        Raises:
          Lost: the worker died, or did not answer within `patience` seconds.
        """
        data = np.int32(len(rows)).tobytes() + rows.astype(np.float32).tobytes()
        try:
            while data:
                data = data[os.write(self._sink, data) :]
        except OSError as error:
            raise Lost from error
        return self._receive(len(rows), patience)

    def _receive(self, count: int, patience: float) -> np.ndarray:
        size, data = 4 * count * self._size, b""
        deadline = time.monotonic() + patience
        ready = select.poll()
        ready.register(self._source, select.POLLIN)
        while len(data) < size:
            left = max(0.0, deadline - time.monotonic())
            part = os.read(self._source, size - len(data)) if ready.poll(1000 * left) else b""
            if not part:
                raise Lost
            data += part
        return np.frombuffer(data, np.float32).reshape(count, self._size)

    def kill(self) -> None:
        """Ends the process at once."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe
            pipe.close()


class Pool:
    """Distributes rows over workers; each worker starts when it is first needed.

    Safe to use from several threads at once.

    Args:
      command: the program that a worker runs, and its arguments.
      size: numbers in an answered row.
      workers: number of workers; default: one for each core that this process may use.
      patience: seconds that a worker may take for a request.

    Attributes:
      replaced: number of workers that died or hung, and were replaced.
    """

    def __init__(
        self, command: Sequence[str], size: int, workers: int | None = None, patience: float = 30.0
    ):
        self.command, self.size, self.patience = command, size, patience
        self.workers = workers or cores()
        self.replaced = 0
        self._counting = threading.Lock()
        self._threads = ThreadPoolExecutor(self.workers, "rows")
        # None stands for a worker that is not running: not started yet, or lost.
        self._idle: queue.LifoQueue[Worker | None] = queue.LifoQueue()
        for _ in range(self.workers):
            self._idle.put(None)

    @property
    def processes(self) -> list[int]:
        """Process ids of the workers that run and are idle."""
        return [worker.process.pid for worker in list(self._idle.queue) if worker]

    def greeting(self) -> np.ndarray:
        """The first answer of a worker, `[out]`; it is the same for all.

        Raises:
          BadInput: no worker starts.
        """
        worker = self._idle.get()
        try:
            worker = worker or self._start()
            return worker.greeting
        finally:
            self._idle.put(worker)

    def map(self, rows: np.ndarray) -> np.ndarray:
        """Returns the answers `[n, out]` to `rows [n, in]`, in the same order.

        The answer to a row that kills a worker is NaN; the other rows are not affected.

        Raises:
          BadInput: no worker starts.
        """
        parts = np.split(rows, np.cumsum(portions(len(rows), self.workers))[:-1])
        return np.concatenate([*self._threads.map(self._answer, parts)])

    def _answer(self, rows: np.ndarray) -> np.ndarray:
        try:
            return self._exchange(rows)
        except Lost:
            return np.concatenate([self._alone(row[None]) for row in rows])

    def _alone(self, row: np.ndarray) -> np.ndarray:
        try:
            return self._exchange(row)
        except Lost:
            return np.full((1, self.size), np.nan, np.float32)

    def _exchange(self, rows: np.ndarray) -> np.ndarray:
        worker = self._idle.get()
        try:
            worker = worker or self._start()
            return worker.exchange(rows, self.patience)
        except Lost:
            assert worker
            worker.kill()
            worker = None
            self._count(len(rows))
            raise
        finally:
            self._idle.put(worker)

    def _start(self) -> Worker:
        for _ in range(TRIES):
            with contextlib.suppress(Lost, OSError):
                return Worker(self.command, self.size)
        raise BadInput(f"a worker process failed to start, {TRIES} times: {' '.join(self.command)}")

    def _count(self, rows: int) -> None:
        with self._counting:
            self.replaced += 1
            message = (
                f"a worker with {rows} rows died or hung; another one replaces it "
                f"({self.replaced} replaced so far)"
            )
        warnings.warn(message, RuntimeWarning, stacklevel=2)

    def close(self) -> None:
        """Ends all idle workers; the pool then accepts no more rows."""
        self._threads.shutdown()
        with contextlib.suppress(queue.Empty):
            while True:
                if worker := self._idle.get_nowait():
                    worker.kill()
