"""Stages of a run: one directory each, named by its config and code; finished or resumed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import glob
import importlib
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from genidm.checkpoints import Checkpoints
from genidm.config import digest, to_json
from genidm.errors import BadInput
from genidm.files import Corrupt, disk, load_json, remove, save_json
from genidm.provenance import changed, code_digest, command, environment

T = TypeVar("T")

# Windows has no `fcntl`: there, processes do not wait for each other.
fcntl: Any = importlib.import_module("fcntl") if importlib.util.find_spec("fcntl") else None

CONFIG, MADE, DONE = "config.json", "made.json", "done.json"


@dataclasses.dataclass(frozen=True)
class Stage:
    """One part of a run, in a directory whose name contains a hash of its config and code.

    The directory contains `config.json` (the config, and a digest of each module's code),
    `made.json` (the commands that worked on it, their machines and times) and, when the stage is
    finished, `done.json` (its summary).

    Attributes:
      directory: `root/name-<digest of config and code>`.
      opened_with: config and code, until they are written; None where a path was given.
    """

    directory: Path
    opened_with: Any = dataclasses.field(default=None, compare=False, repr=False)

    @classmethod
    def open(
        cls,
        root: Path | str,
        name: str,
        config: Any,
        code: Mapping[str, str] | None = None,
        reuse: bool = False,
    ) -> Stage:
        """Opens the stage of a config and code; nothing is written before work begins.

        If a finished stage has the same config but other code, this prints on stderr which
        modules differ, and returns the stage of this code (with `reuse`, the finished stage).

        Args:
          root: directory that contains the stages.
          name: first words of the directory's name.
          config: settings of the stage; different settings make different stages.
          code: module → digest of the code that the stage runs (`provenance.code_of`).
          reuse: use a finished stage that other code made, with a warning.
        """
        code = dict(code or {})
        key = {"config": config, "code": code_digest(code)} if code else config
        stage = cls(Path(root) / f"{name}-{digest(key)}", {"config": config, "code": code})
        if not stage.done:
            other = stage._of_other_code(name, config, code)
            if other and reuse:
                _say_once(f"warning: {_differs(other, code)}; it is used")
                return other
            if other and not stage.path(CONFIG).exists():
                _say_once(f"{_differs(other, code)}: made anew")
        return stage

    def _of_other_code(self, name: str, config: Any, code: Mapping[str, str]) -> Stage | None:
        """The newest finished stage with the same config and other code."""
        wanted, found = to_json(config), []
        for path in self.directory.parent.glob(f"{glob.escape(name)}-*/{DONE}"):
            other = Stage(path.parent)
            with contextlib.suppress(BadInput, KeyError, TypeError):
                there = load_json(other.path(CONFIG))
                if there["config"] == wanted and there["code"] != code:
                    found.append((path.stat().st_mtime, other))
        return max(found, key=lambda pair: pair[0])[1] if found else None

    @property
    def code(self) -> dict[str, str]:
        """Module → digest of the code that makes, or has made, the stage."""
        config = self.opened_with or load_json(self.path(CONFIG))
        code: dict[str, str] = config["code"]
        return code

    @property
    def made(self) -> list[dict[str, Any]]:
        """The commands that worked on the stage, oldest first.

        Each has command, commit, clean, versions, hardware, start (seconds since 1970) and
        seconds (duration without that of other stages; None if the command was killed).
        """
        path = self.path(MADE)
        sessions: list[dict[str, Any]] = load_json(path) if path.exists() else []
        return sessions

    @property
    def done(self) -> bool:
        """Whether the stage is finished."""
        try:
            return isinstance(self.summary(), dict)
        except Corrupt:
            return False

    def summary(self) -> Any:
        """The summary given to `finish`; raises Corrupt if the stage is not finished."""
        try:
            return load_json(self.path(DONE))
        except Corrupt as corrupt:
            raise Corrupt(
                f"{self.directory} is not the directory of a finished run: {corrupt}"
            ) from None

    def run_once(self, work: Callable[[], dict[str, Any]]) -> None:
        """Calls `work` and finishes the stage with the summary it returns, unless it is done.

        If several processes open one stage, one works and the others wait. The lock ends with
        its process, also if the process is killed.
        """
        if self.done:
            return
        with disk(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
        with alone(self.directory):
            if not self.done:
                self._begin()
                with _timed() as seconds:
                    summary = work()
                self._end(seconds[0])
                self.finish(summary)
                self.clear_checkpoints()

    def _begin(self) -> None:
        """Records this command in `made.json`; warns if another environment began the stage."""
        if self.opened_with and not _is_json(self.path(CONFIG)):
            save_json(self.path(CONFIG), self.opened_with)
        sessions, here = self.made, environment()
        if sessions and self.path("checkpoints").exists():
            before = sessions[-1]
            other = ", ".join(f"{k} {before.get(k)}" for k in here if before.get(k) != here[k])
            if other:
                begun = f"{self.directory} was begun in another environment ({other})"
                print(f"warning: {begun}; bits may differ", file=sys.stderr)
        now = {"command": command(), **here, "start": round(time.time(), 3), "seconds": None}
        save_json(self.path(MADE), [*sessions, now])

    def _end(self, seconds: float) -> None:
        *before, now = self.made
        save_json(self.path(MADE), [*before, now | {"seconds": round(seconds, 1)}])

    def finish(self, summary: dict[str, Any]) -> None:
        """Marks the stage as finished; must be the last write to it."""
        save_json(self.path(DONE), summary)

    def read(self, load: Callable[..., T], name: str, *args: Any) -> T:
        """Returns `load(self.path(name), *args)`.

        Raises:
          Corrupt: the file or directory is corrupt. The message says which directory to delete;
            the stage is not made again before that.
        """
        try:
            return load(self.path(name), *args)
        except Corrupt as corrupt:
            said = str(corrupt)
        delete = f"Delete {self.directory} to make it anew"
        raise Corrupt(said if delete in said else f"{said}. {delete}")

    def path(self, name: str) -> Path:
        """Path of the file or directory `name` of the stage."""
        return self.directory / name

    def checkpoints(self, part: str = "") -> Checkpoints:
        """The checkpoints of an unfinished stage; `part` names a kind of them."""
        return Checkpoints(self.path("checkpoints") / part)

    def clear_checkpoints(self) -> None:
        """Removes all checkpoints."""
        with disk(self.directory):
            remove(self.path("checkpoints"))


# Seconds of finished work inside each piece of work that is under way, the innermost last.
_INSIDE: list[float] = []


@contextlib.contextmanager
def _timed() -> Iterator[list[float]]:
    """Yields a list that holds, after the block, its seconds without those of stages inside it."""
    seconds, begun = list[float](), time.monotonic()
    _INSIDE.append(0.0)
    try:
        yield seconds
    finally:
        total = time.monotonic() - begun
        seconds.append(total - _INSIDE.pop())
        if _INSIDE:
            _INSIDE[-1] += total


@functools.cache
def _say_once(message: str) -> None:
    """Prints a message on stderr, once per process."""
    print(message, file=sys.stderr)


def _is_json(path: Path) -> bool:
    try:
        return bool(load_json(path))
    except Corrupt:
        return False


def _differs(other: Stage, code: Mapping[str, str]) -> str:
    modules = changed(other.code, code)
    named = ", ".join(modules[:5]) + (f" and {len(modules) - 5} more" if len(modules) > 5 else "")
    return f"{other.directory} was made by other code ({named})"


@contextlib.contextmanager
def alone(directory: Path) -> Iterator[None]:
    """Holds the lock of a directory, or no lock if the file system has none."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                print(f"waiting for another process that works in {directory}", file=sys.stderr)
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
