"""Checkpoints of a long stage, written by orbax; the last two are kept, in case one is corrupt."""

from __future__ import annotations

import logging
import math
import os
import re
import sys
import time
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from genidm import files, trees
from genidm.errors import BadInput


def requested_seconds() -> float:
    """Seconds between checkpoints of a long stage: `GENIDM_CHECKPOINT_SECONDS`, or 60.

    Raises:
      BadInput: the value is not a number of seconds. Commands check this before they begin.
    """
    text = os.environ.get("GENIDM_CHECKPOINT_SECONDS", "").strip() or "60"
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not seconds >= 0:
        raise BadInput(f"GENIDM_CHECKPOINT_SECONDS must be a number of seconds, not {text!r:.40}")
    return seconds


try:
    CHECKPOINT_SECONDS = requested_seconds()
except BadInput:
    CHECKPOINT_SECONDS = 60.0


class Checkpoints:
    """Checkpoints of a long stage, `directory/step_000000123`, written by orbax.

    Not orbax's CheckpointManager: it has no checksums, and it syncs only the arrays, neither its
    other files nor its renames.

    Data that only grows is stored in parts, `directory/part_NAME`, which are written once. A
    checkpoint names the parts that it needs.

    Attributes:
      directory: directory of the checkpoints.
      keep: number of checkpoints to keep: two, so that one is left if the other is corrupt.
    """

    def __init__(self, directory: Path | str, keep: int = 2):
        self.directory, self.keep = Path(directory), keep
        self._saved = time.monotonic()

    def due(self) -> bool:
        """Whether the last save (or the start) is at least CHECKPOINT_SECONDS ago."""
        return time.monotonic() - self._saved >= CHECKPOINT_SECONDS

    def _path(self, step: int) -> Path:
        return self.directory / f"step_{step:09d}"

    def _part(self, name: str) -> Path:
        return self.directory / f"part_{name}"

    def steps(self) -> list[int]:
        """The steps on disk, oldest first, including corrupt ones."""
        found = (re.fullmatch(r"step_(\d+)", p.name) for p in self.directory.glob("step_*"))
        return sorted(int(m[1]) for m in found if m)

    @files.uninterrupted()
    def save(self, step: int, tree: Any, parts: Sequence[str] = ()) -> None:
        """Saves a tree of arrays (on any devices), typed random keys and Python numbers.

        Removes old steps, parts that no step names, and steps later than `step`: these are
        corrupt, or later than the step that the stage was resumed from.

        Args:
          step: number of the step.
          tree: the tree to save.
          parts: names of the parts that the step needs; `save_part` has written them.
        """
        leaves = trees.named(tree)
        keys = {name: str(jax.random.key_impl(x)) for name, x in leaves.items() if files.is_key(x)}
        raw = {k: jax.random.key_data(x) if k in keys else x for k, x in leaves.items()}
        arrays = {name: files.as_array(name, x) for name, x in raw.items()}
        record = {
            "kinds": trees.kinds(tree), "keys": keys,
            "parts": {name: _checksum(self._part(name)) for name in parts},
        }  # fmt: skip
        with files.building(self._path(step)) as scratch:
            files.save_json(scratch / "leaves.json", record)
            # orbax rejects arrays without elements; `kinds` has their shape and dtype.
            _write(scratch / "tree", {name: x for name, x in arrays.items() if x.size})
        self._saved = time.monotonic()
        self._tidy([s for s in self.steps() if s <= step][-self.keep :])

    def _tidy(self, kept: Sequence[int]) -> None:
        """Removes all other steps, and all parts that the kept steps do not name."""
        with files.disk(self.directory):
            for step in set(self.steps()) - set(kept):
                files.remove(self._path(step))
            named = {self._part(name) for step in kept for name in self.parts(step)}
            for part in set(self.directory.glob("part_*")) - named:
                files.remove(part)

    def save_part(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Writes a part; must be called before `save` of the first step that names it."""
        files.save_arrays(self._part(name), arrays, {}, overwrite=True)

    def load_part(self, name: str) -> dict[str, np.ndarray]:
        """The arrays of a part, memory-mapped; `latest` has verified it."""
        found = self._part(name).glob("*.npy")
        return {file.stem: np.load(file, mmap_mode="r", allow_pickle=False) for file in found}

    def parts(self, step: int) -> dict[str, int]:
        """Name → checksum of the parts of a step, in order; empty if the step is corrupt."""
        try:
            return files.load_json(self._path(step) / "leaves.json").get("parts", {})
        except files.Corrupt:
            return {}

    def latest(self, like: Any) -> tuple[int, Any] | None:
        """Loads the newest step that is not corrupt; None if there is none.

        Args:
          like: an example of the tree, of arrays or `jax.ShapeDtypeStruct`s: it gives the
            structure, the static fields, and which leaves are Python numbers.

        Returns:
          the step and its tree. Arrays are NumPy arrays, random keys are on the first device;
          the caller moves them to their devices.

        Raises:
          BadInput: the leaves have other names, shapes or dtypes than those of `like`.
        """
        for step in reversed(steps := self.steps()):
            try:
                self._verify(step)
            except files.Corrupt as corrupt:
                then = "beginning anew" if step == steps[0] else "trying the one before it"
                print(f"warning: {corrupt}; {then}", file=sys.stderr)
            else:
                return step, _restore(self._path(step), like)
        return None

    def _verify(self, step: int) -> None:
        """Raises Corrupt unless a step and its parts are complete and unchanged."""
        files.verify(self._path(step))
        for name, checksum in self.parts(step).items():
            files.verify(self._part(name))
            if _checksum(self._part(name)) != checksum:
                raise files.Corrupt(
                    f"{self._part(name)} is not the part that {self._path(step)} names"
                )


def _checksum(part: Path) -> int:
    """The checksum of a part's manifest, which contains the checksums of its files."""
    return zlib.crc32((part / files.MANIFEST).read_bytes())


def _write(directory: Path, arrays: dict[str, np.ndarray]) -> None:
    import orbax.checkpoint as ocp  # slow to import

    log = logging.getLogger("absl")
    level = log.level
    log.setLevel(logging.CRITICAL)  # `disk` reports a full disk; orbax would log three tracebacks
    try:
        if arrays:
            ocp.PyTreeCheckpointer(use_compression=False).save(directory.absolute(), arrays)
    finally:
        log.setLevel(level)


def _restore(path: Path, like: Any) -> Any:
    import orbax.checkpoint as ocp

    wanted, record = trees.named(like), files.load_json(path / "leaves.json")
    if differs := trees.difference(record["kinds"], trees.kinds(like)):
        difference = "{} is {} in the checkpoint, {} in this run".format(*differs)
        raise BadInput(f"{path} is a checkpoint of another robot or setting: {difference}")
    tree = (path / "tree").absolute()
    with files.disk(path):
        arrays = ocp.PyTreeCheckpointer().restore(tree) if tree.exists() else {}
    leaves = [_leaf(arrays.get(k), record["keys"].get(k), x) for k, x in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _leaf(array: Any, key: str | None, like: Any) -> Any:
    if array is None:  # an array without elements: orbax did not store it
        return np.zeros(like.shape, like.dtype)
    if key is not None:
        return jax.random.wrap_key_data(array, impl=key)
    if type(like) in (bool, int, float):
        return type(like)(np.asarray(array).item())
    array = np.asarray(array)
    dtype = getattr(like, "dtype", array.dtype)
    # `item` makes a number that is too large for the dtype an error.
    return array if array.dtype == dtype else np.array(array.item(), dtype)
