"""The newest states of a long stage, written by orbax; the one before replaces a corrupt one."""

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
      BadInput: it is no number of seconds. Commands say so before they begin.
    """
    text = os.environ.get("GENIDM_CHECKPOINT_SECONDS", "").strip() or "60"
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not seconds >= 0:
        raise BadInput(f"GENIDM_CHECKPOINT_SECONDS is a number of seconds, not {text!r:.40}")
    return seconds


try:
    CHECKPOINT_SECONDS = requested_seconds()
except BadInput:
    CHECKPOINT_SECONDS = 60.0


class Checkpoints:
    """The newest states of a long stage, `directory/step_000000123`, written by orbax.

    Orbax's CheckpointManager would name and keep them, too, but it has no checksum, and it syncs
    nothing but the arrays: neither what it writes beside them nor the renames.

    What grows from state to state can lie beside them in parts, `directory/part_NAME`, which are
    written once: a step names those that it is no use without.

    Attributes:
      directory: where they lie.
      keep: how many steps are kept: two, so that there is one before a corrupt one.
    """

    def __init__(self, directory: Path | str, keep: int = 2):
        self.directory, self.keep = Path(directory), keep
        self._saved = time.monotonic()

    def due(self) -> bool:
        """Whether the last save, or the start, is CHECKPOINT_SECONDS ago."""
        return time.monotonic() - self._saved >= CHECKPOINT_SECONDS

    def _path(self, step: int) -> Path:
        return self.directory / f"step_{step:09d}"

    def _part(self, name: str) -> Path:
        return self.directory / f"part_{name}"

    def steps(self) -> list[int]:
        """The steps that are there, oldest first, corrupt ones too."""
        found = (re.fullmatch(r"step_(\d+)", p.name) for p in self.directory.glob("step_*"))
        return sorted(int(m[1]) for m in found if m)

    @files.uninterrupted()
    def save(self, step: int, tree: Any, parts: Sequence[str] = ()) -> None:
        """Keeps a tree of arrays (on any devices), typed random keys and Python numbers.

        Steps are saved in order: one that is there and lies beyond `step` is corrupt, or of a
        future that a resume has left, and is removed with the old ones, and with the parts that
        no step names any more.

        Args:
          step: its number.
          tree: what is kept.
          parts: names of the parts that belong to it; `save_part` has written them.
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
            # orbax refuses arrays without elements; their kind is all there is to them.
            _write(scratch / "tree", {name: x for name, x in arrays.items() if x.size})
        self._saved = time.monotonic()
        self._tidy([s for s in self.steps() if s <= step][-self.keep :])

    def _tidy(self, kept: Sequence[int]) -> None:
        """Removes all steps but these, and the parts that none of them names."""
        with files.disk(self.directory):
            for step in set(self.steps()) - set(kept):
                files.remove(self._path(step))
            named = {self._part(name) for step in kept for name in self.parts(step)}
            for part in set(self.directory.glob("part_*")) - named:
                files.remove(part)

    def save_part(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Writes a part, before the first step that names it."""
        files.save_arrays(self._part(name), arrays, {}, overwrite=True)

    def load_part(self, name: str) -> dict[str, np.ndarray]:
        """A part of a step that `latest` has found whole; its arrays stay on the disk."""
        found = self._part(name).glob("*.npy")
        return {file.stem: np.load(file, mmap_mode="r", allow_pickle=False) for file in found}

    def parts(self, step: int) -> dict[str, int]:
        """The parts that a step names, in order, with their checksums; none of a corrupt step."""
        try:
            return files.load_json(self._path(step) / "leaves.json").get("parts", {})
        except files.Corrupt:
            return {}

    def latest(self, like: Any) -> tuple[int, Any] | None:
        """The newest step that is not corrupt, and its tree; None if there is none.

        Args:
          like: an example of the tree, or of `jax.ShapeDtypeStruct`s: it gives the
            structure, the static fields, and which leaves are Python numbers.

        Returns:
          arrays are NumPy's, random keys lie on the first device: the caller puts them
          where they belong.

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
        """Raises Corrupt unless a step is whole, and so are its parts, as they were."""
        files.verify(self._path(step))
        for name, checksum in self.parts(step).items():
            files.verify(self._part(name))
            if _checksum(self._part(name)) != checksum:
                raise files.Corrupt(f"{self._part(name)} is not what {self._path(step)} names")


def _checksum(part: Path) -> int:
    """Of a part's manifest, which has those of its files."""
    return zlib.crc32((part / files.MANIFEST).read_bytes())


def _write(directory: Path, arrays: dict[str, np.ndarray]) -> None:
    import orbax.checkpoint as ocp  # slow to import

    log = logging.getLogger("absl")
    level = log.level
    log.setLevel(logging.CRITICAL)  # a full disk is told by us, not by three tracebacks
    try:
        if arrays:
            ocp.PyTreeCheckpointer(use_compression=False).save(directory.absolute(), arrays)
    finally:
        log.setLevel(level)


def _restore(path: Path, like: Any) -> Any:
    import orbax.checkpoint as ocp

    wanted, record = trees.named(like), files.load_json(path / "leaves.json")
    if differs := trees.difference(record["kinds"], trees.kinds(like)):
        difference = "{} is {} there, {} here".format(*differs)
        raise BadInput(f"{path} is a checkpoint of another robot or setting: {difference}")
    tree = (path / "tree").absolute()
    with files.disk(path):
        arrays = ocp.PyTreeCheckpointer().restore(tree) if tree.exists() else {}
    leaves = [_leaf(arrays.get(k), record["keys"].get(k), x) for k, x in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _leaf(array: Any, key: str | None, like: Any) -> Any:
    if array is None:  # without elements
        return np.zeros(like.shape, like.dtype)
    if key is not None:
        return jax.random.wrap_key_data(array, impl=key)
    if type(like) in (bool, int, float):
        return type(like)(np.asarray(array).item())
    array = np.asarray(array)
    dtype = getattr(like, "dtype", array.dtype)
    # By way of a Python number, so that one too large for the dtype is an error.
    return array if array.dtype == dtype else np.array(array.item(), dtype)
