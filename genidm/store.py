"""Run directories: one a stage, named by its config, found again and resumed."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from genidm.checkpoints import Checkpoints
from genidm.config import digest, environment
from genidm.files import Torn, disk, load_json, remove, save_json

# Windows has no such locks: there nobody waits for another process.
fcntl: Any = importlib.import_module("fcntl") if importlib.util.find_spec("fcntl") else None


@dataclasses.dataclass(frozen=True)
class Stage:
    """One part of a run, in a directory that its config names.

    Attributes:
      directory: `root/name-<digest of the config>`.
    """

    directory: Path

    @classmethod
    def open(cls, root: Path | str, name: str, config: Any) -> Stage:
        """Finds the stage, or makes it, with the config and the environment in `config.json`.

        One begun in another environment and not finished goes on, with a warning: its bits
        may differ from those of an undisturbed run.
        """
        stage, here = cls(Path(root) / f"{name}-{digest(config)}"), environment()
        try:
            begun = load_json(stage.path("config.json"))["environment"]
        except Torn:
            save_json(stage.path("config.json"), {"config": config, "environment": here})
            return stage
        if begun != here and not stage.done and stage.path("checkpoints").exists():
            other = ", ".join(f"{k} {begun.get(k)}" for k in here if begun.get(k) != here[k])
            change = f"{stage.directory} was begun elsewhere ({other})"
            print(f"warning: {change}; bits may differ from one machine's", file=sys.stderr)
        return stage

    @property
    def done(self) -> bool:
        """Whether the stage is finished."""
        try:
            return isinstance(self.summary(), dict)
        except Torn:
            return False

    def summary(self) -> Any:
        """What `finish` was given; raises Torn if the stage is not finished."""
        try:
            return load_json(self.path("done.json"))
        except Torn as torn:
            raise Torn(f"{self.directory} is not the directory of a finished run: {torn}") from None

    def once(self, work: Callable[[], dict[str, Any]]) -> None:
        """Does the stage, unless it is done; `work` returns its summary.

        Where several processes come to one stage, one does it and the others wait. One that
        dies gives the stage free, however it dies.
        """
        if self.done:
            return
        with _alone(self.directory):
            if not self.done:
                self.finish(work())
                self.clear_checkpoints()

    def finish(self, summary: dict[str, Any]) -> None:
        """Marks the stage as finished; the last thing done to it."""
        save_json(self.path("done.json"), summary)

    def path(self, name: str) -> Path:
        """Where the stage keeps the file or directory `name`."""
        return self.directory / name

    def checkpoints(self, part: str = "") -> Checkpoints:
        """Its checkpoints, while it is under way; `part` names those of one kind."""
        return Checkpoints(self.path("checkpoints") / part)

    def clear_checkpoints(self) -> None:
        """Removes them."""
        with disk(self.directory):
            remove(self.path("checkpoints"))


@contextlib.contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Holds the lock of a directory; goes without where the file system has none."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                print(f"waiting for another process, at work in {directory}", file=sys.stderr)
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
