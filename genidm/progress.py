"""Progress of a stage: a bar with rate and remaining time, metrics as JSONL and TensorBoard.

`metrics.jsonl` is the source. When a stage is resumed, its lines after the checkpoint are dropped
and TensorBoard's files are rewritten from it, so that no part of a curve appears twice.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from tqdm.auto import tqdm

from genidm.errors import BadInput
from genidm.files import disk, save_text

METRICS = "metrics.jsonl"
# Seconds between flushes: tensorboardX waits for the disk at each flush.
FLUSH_SECONDS = 5.0


def compile_ahead(name: str, jitted: Any, *args: Any) -> Callable[..., Any]:
    """Compiles a jitted function before its first call, and prints the time on stderr.

    A program in the compilation cache is only traced and read.

    Args:
      name: name of the function in the printed line.
      jitted: result of `jax.jit`.
      args: arguments, or `jax.ShapeDtypeStruct`s with shardings in their place.

    Returns:
      the compiled program; it takes arguments of these shapes, dtypes and shardings, without
      the static ones.
    """
    start = time.perf_counter()
    if sys.stderr.isatty():
        print(f"{name}: compiling …", end="\r", file=sys.stderr, flush=True)
    program: Callable[..., Any] = jitted.lower(*args).compile()
    seconds = time.perf_counter() - start
    tqdm.write(
        f"{name}: program ready in {seconds:.{0 if seconds >= 10 else 1}f} s", file=sys.stderr
    )
    return program


class Progress:
    """A bar on stderr, and the metrics of a stage on disk; a context manager.

        with Progress("ppo", 2_000_000, "steps", stage.directory, initial=step) as progress:
            progress.advance(4096, reward=reward)

    Attributes:
      name: label in front of the bar.
      done: units done, including those before a resume.
    """

    def __init__(
        self,
        name: str,
        total: int,
        unit: str,
        directory: Path | str | None = None,
        initial: int = 0,
        quiet: bool = False,
    ):
        """Starts the bar.

        Args:
          name: label in front of the bar.
          total: total number of units.
          unit: name of the unit, for the rate.
          directory: directory for `metrics.jsonl` and TensorBoard's files, of this stage alone;
            metrics there after step `initial` are dropped. None: write no files.
          initial: units done before a resume.
          quiet: show no bar.

        Raises:
          BadInput: the directory cannot be written, or its metrics cannot be read.
        """
        self.name, self.done = name, initial
        self._curves = _Curves(Path(directory), initial) if directory is not None else None
        live = sys.stderr.isatty() or "ipykernel" in sys.modules
        self._bar = tqdm(
            desc=name,
            total=total,
            initial=initial,
            unit=f" {unit}",
            unit_scale=True,
            dynamic_ncols=True,
            mininterval=0.2 if live else 10.0,  # seconds; a log file needs few lines
            miniters=0,  # show new metrics even if few units are done
            disable=quiet,
            file=sys.stderr,
        )

    def advance(self, n: int, /, **metrics: Any) -> None:
        """Counts `n` more units, and records metrics (numbers, or arrays of one element).

        Metrics that are not finite are `null` in the JSONL and absent from TensorBoard.

        Raises:
          BadInput: the disk is full.
        """
        self.done += n
        if metrics:
            numbers = {name: _number(x) for name, x in metrics.items()}
            shown = {k: "nan" if x is None else f"{x:.4g}" for k, x in numbers.items()}
            self._bar.set_postfix(shown, refresh=False)
            if self._curves:
                self._curves.add({"step": self.done, "time": round(time.time(), 3), **numbers})
        self._bar.update(n)

    def close(self) -> None:
        """Ends the bar and closes the files."""
        self._bar.close()
        if self._curves:
            self._curves.close()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _Curves:
    """The metrics of one directory, as JSONL and as TensorBoard's events."""

    def __init__(self, directory: Path, initial: int):
        self._path = directory / METRICS
        there = read_metrics(self._path) if initial > 0 and self._path.exists() else []
        kept = [line for line in there if line["step"] <= initial]
        save_text(self._path, "".join(json.dumps(line) + "\n" for line in kept))
        with disk(directory):
            self._lines: IO[str] = self._path.open("a", encoding="utf-8", buffering=1)
            self._events = _events(directory)
            self._flushed = time.monotonic()
            for line in kept:
                self._show(line)

    def add(self, line: dict[str, Any]) -> None:
        with disk(self._path):
            self._lines.write(json.dumps(line, allow_nan=False) + "\n")
            self._show(line)
            if time.monotonic() - self._flushed > FLUSH_SECONDS:
                self._events.flush()
                self._flushed = time.monotonic()

    def _show(self, line: dict[str, Any]) -> None:
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        for name, value in line.items():
            if name not in ("step", "time") and value is not None:
                at = {"wall_time": line["time"], "step": line["step"]}
                self._events.write_event(Event(**at, summary=scalar(name, value)))

    def close(self) -> None:
        with disk(self._path), contextlib.closing(self._lines):
            self._events.close()


def _events(directory: Path) -> Any:
    """Deletes the event files of a directory and opens a new one.

    Not tensorboardX's SummaryWriter: its thread dies silently on a full disk, and then blocks
    the caller for ever.
    """
    from tensorboardX.event_file_writer import EventsWriter

    for old in directory.glob("events.out.tfevents.*"):
        old.unlink()
    return EventsWriter(str(directory / "events"))


def _number(x: Any) -> float | int | None:
    value: float | int = np.asarray(x).item()
    return value if math.isfinite(value) else None


def read_metrics(path: Path | str) -> list[dict[str, Any]]:
    """Reads a `metrics.jsonl`: each line has `step`, `time` (seconds since 1970) and metrics.

    A last line that was cut short is left out.

    Raises:
      BadInput: the file is missing, or is corrupt before its last line.
    """
    with disk(path):
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    metrics = []
    for number, line in enumerate(lines, start=1):
        try:
            metrics.append(json.loads(line))
        except ValueError:
            if number < len(lines):
                raise BadInput(f"{path} is corrupt in line {number}") from None
    return metrics
