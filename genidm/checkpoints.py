"""The newest states of a long stage, kept by orbax; the one before stands in for a torn one."""

from __future__ import annotations

import logging
import math
import os
import re
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from genidm import files
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

    Attributes:
      directory: where they lie.
      keep: how many are kept: two, so that there is one before a torn one.
    """

    def __init__(self, directory: Path | str, keep: int = 2):
        self.directory, self.keep = Path(directory), keep
        self._saved = time.monotonic()

    def due(self) -> bool:
        """Whether the last save, or the start, is CHECKPOINT_SECONDS ago."""
        return time.monotonic() - self._saved >= CHECKPOINT_SECONDS

    def _path(self, step: int) -> Path:
        return self.directory / f"step_{step:09d}"

    def steps(self) -> list[int]:
        """The steps that are there, oldest first, torn ones too."""
        found = (re.fullmatch(r"step_(\d+)", p.name) for p in self.directory.glob("step_*"))
        return sorted(int(m[1]) for m in found if m)

    def save(self, step: int, tree: Any) -> None:
        """Keeps a tree of arrays (on any devices), typed random keys and Python numbers.

        Steps are saved in order: one that is there and lies beyond `step` is torn, or of a
        future that a resume has left, and is removed with the old ones.
        """
        leaves = _named(tree)
        keys = {name: str(jax.random.key_impl(x)) for name, x in leaves.items() if files.is_key(x)}
        raw = {k: jax.random.key_data(x) if k in keys else x for k, x in leaves.items()}
        arrays = {name: files.as_array(name, x) for name, x in raw.items()}
        kinds = {name: _kind(x) for name, x in leaves.items()}
        with files.building(self._path(step)) as scratch:
            files.save_json(scratch / "leaves.json", {"kinds": kinds, "keys": keys})
            # orbax refuses arrays without elements; their kind is all there is to them.
            _write(scratch / "tree", {name: x for name, x in arrays.items() if x.size})
        self._saved = time.monotonic()
        with files.disk(self.directory):
            keep = [s for s in self.steps() if s <= step][-self.keep :]
            for old in set(self.steps()) - set(keep):
                files.remove(self._path(old))

    def latest(self, like: Any) -> tuple[int, Any] | None:
        """The newest step that is not torn, and its tree; None if there is none.

        Args:
          like: an example of the tree, or of `jax.ShapeDtypeStruct`s: it gives the
            structure, the static fields, and which leaves are Python numbers.

        Returns:
          arrays are NumPy's, random keys lie on the first device: the caller puts them
          where they belong.

        Raises:
          BadInput: the leaves have other names, shapes or dtypes than those of `like`.
        """
        for step in reversed(self.steps()):
            try:
                files.verify(self._path(step))
            except files.Torn as torn:
                print(f"warning: {torn}; trying the one before it", file=sys.stderr)
            else:
                return step, _restore(self._path(step), like)
        return None


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

    wanted, record = _named(like), files.load_json(path / "leaves.json")
    kinds = {name: _kind(x) for name, x in wanted.items()}
    for name in sorted(kinds.keys() | record["kinds"].keys()):
        there, here = record["kinds"].get(name, "absent"), kinds.get(name, "absent")
        if there != here:
            difference = f"{name} is {there} there, {here} here"
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


def _named(tree: Any) -> dict[str, Any]:
    """Leaves by their paths, which do not tell a dict from a dataclass or a tuple."""
    pairs = jax.tree_util.tree_flatten_with_path(tree)[0]
    named = {jax.tree_util.keystr(p, simple=True, separator="/") or "tree": x for p, x in pairs}
    if len(named) < len(pairs):
        raise BadInput("two leaves of a checkpoint have one name")
    return named


def _kind(x: Any) -> str:
    """Dtype and shape; of one number only its kind, as jit makes arrays of Python's."""
    shape, dtype = np.shape(x), str(x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype)
    return f"{dtype}{list(shape)}" if shape else dtype.rstrip("0123456789")
