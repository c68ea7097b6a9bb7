"""What is kept on disk: run directories, arrays, checkpoints; whole or not at all.

Everything is written beside its final name and renamed into place once it is on the disk,
so that a run killed at any moment leaves the old files or the new ones. Directories carry
the size and crc32 of each file; one that does not match is torn, and is not used. Nothing
is ever pickled. A full disk, or one that cannot be written, is BadInput everywhere.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import errno
import functools
import hashlib
import importlib.metadata
import json
import logging
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePath
from typing import Any

import jax
import numpy as np

from genidm.errors import BadInput

PACKAGES = (
    *("genidm", "numpy", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint"),
    *("brax", "mujoco", "mujoco-mjx"),
)
MANIFEST = "manifest.json"
# Seconds between checkpoints of a long stage; tests that kill runs ask for fewer.
CHECKPOINT_SECONDS = float(os.environ.get("GENIDM_CHECKPOINT_SECONDS", "60"))
_SCRATCH = ".genidm-tmp"


class Torn(BadInput):
    """Files that are missing, cut short or changed since they were written."""


def plain(config: Any) -> Any:
    """A config as JSON can hold it.

    Dataclasses become dicts that also name their `class`; tuples and arrays, lists; paths
    and numbers that are not finite, strings; enums, functions and classes, their qualified
    names (what a function has captured is not seen).

    Raises:
      BadInput: nothing tells a thing in it from others of its type.
    """
    if isinstance(config, enum.Enum):
        return f"{_qualified(type(config))}.{config.name}"
    if config is None or isinstance(config, bool | int | str):
        return config
    if isinstance(config, float):
        return float(config) if math.isfinite(config) else str(float(config))
    if isinstance(config, PurePath):
        return str(config)
    if isinstance(config, np.ndarray | np.generic | jax.Array):
        return plain(config.tolist())
    if isinstance(config, Mapping):
        return {k if isinstance(k, str) else str(plain(k)): plain(v) for k, v in config.items()}
    if isinstance(config, tuple | list):
        return [plain(x) for x in config]
    if hasattr(config, "__qualname__"):
        return _qualified(config)
    if dataclasses.is_dataclass(config):
        values = {f.name: plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
        return {"class": _qualified(type(config)), **values}
    raise BadInput(f"a {type(config).__name__} cannot stand in a config: {config!r:.80}")


def _qualified(x: Any) -> str:
    module = x.__module__
    if module == "__main__":  # `python -m experiments.ant_lr` is experiments.ant_lr
        module = getattr(getattr(sys.modules[module], "__spec__", None), "name", module)
    return f"{module}.{x.__qualname__}"


def digest(config: Any) -> str:
    """Ten hex digits of the sha256 of the config's canonical JSON: its name in paths."""
    text = json.dumps(plain(config), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def environment() -> dict[str, Any]:
    """Where a run is made: `versions` of packages, `hardware` in a line, git `commit`."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    devices = f"{jax.device_count()} jax devices ({jax.devices()[0].device_kind})"
    return {"versions": versions, "hardware": f"{_machine()}, {devices}", "commit": _commit()}


def _machine() -> str:
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", info.read_text()) if info.exists() else None
    model = found[1] if found else platform.processor() or platform.machine()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{model}, {os.cpu_count()} cores, {memory:.0f} GiB"


def _commit() -> str | None:
    package = Path(__file__).resolve().parent
    command = ["git", "-C", str(package), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    top, commit = out.split("\n")[:2]
    # Not the commit of a repository that happens to lie around an installed package.
    return commit if Path(top) == package.parent else None


@contextlib.contextmanager
def disk(path: Path | str) -> Iterator[None]:
    """Says in a sentence, as BadInput, why `path` cannot be read or written."""
    try:
        yield
    except BadInput:
        raise
    except Exception as error:
        # tensorstore gives a ValueError, and numpy no errno after a short write.
        full = re.search("No space left|quota exceeded|requested and .* written", str(error))
        if full or getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            raise BadInput(f"no space left on the disk that holds {path}") from error
        if isinstance(error, OSError):
            raise BadInput(f"cannot use {path}: {error.strerror or error}") from error
        raise


def _scratch(path: Path, use: str) -> Path:
    """A free name beside `path`; what killed processes left there is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".*{_SCRATCH}"):
        if not _alive(int(left.stem.rpartition(".")[2])):
            _delete(left)
    name = path.with_name(f".{path.name}.{use}.{os.getpid()}{_SCRATCH}")
    _delete(name)
    return name


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 only asks
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


def _delete(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _remove(path: Path) -> None:
    """Removes a directory so that a kill leaves no half of it under its name."""
    if path.exists():
        away = path.rename(_scratch(path, "old"))
        _delete(away)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def save_text(path: Path | str, text: str) -> None:
    """Writes a text file."""
    path = Path(path)
    with disk(path):
        scratch = _scratch(path, "new")
        try:
            scratch.write_text(text, encoding="utf-8")
            _sync(scratch)
            os.replace(scratch, path)
            _sync(path.parent)
        finally:
            _delete(scratch)


def save_json(path: Path | str, obj: Any) -> None:
    """Writes `plain(obj)`."""
    save_text(path, json.dumps(plain(obj), indent=2) + "\n")


def load_json(path: Path | str) -> Any:
    """Reads JSON; raises Torn if the file is missing or is not JSON."""
    with disk(path):
        try:
            return json.loads(Path(path).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise Torn(f"{path} is missing") from None
        except ValueError:
            raise Torn(f"{path} is torn: it is not JSON") from None


@contextlib.contextmanager
def _building(path: Path) -> Iterator[Path]:
    """A directory to fill, which then takes the place of `path`, with a manifest."""
    with disk(path):
        scratch = _scratch(path, "new")
        try:
            scratch.mkdir()
            yield scratch
            entries = sorted(scratch.rglob("*"))
            for entry in entries:
                _sync(entry)
            files = {str(p.relative_to(scratch)): _measure(p) for p in entries if p.is_file()}
            save_json(scratch / MANIFEST, files)
            _remove(path)
            scratch.rename(path)
            _sync(path.parent)
        finally:
            _delete(scratch)


def _measure(file: Path) -> list[int]:
    size = crc = 0
    with file.open("rb") as f:
        while block := f.read(1 << 20):
            size, crc = size + len(block), zlib.crc32(block, crc)
    return [size, crc]


def verify(directory: Path | str) -> list[str]:
    """The files of a complete directory; raises Torn if it is not."""
    directory = Path(directory)
    with disk(directory):
        if not directory.exists():
            raise Torn(f"{directory} is missing")
        files: dict[str, list[int]] = load_json(directory / MANIFEST)
        for name, measure in files.items():
            if not (directory / name).is_file():
                raise Torn(f"{directory} is torn: {name} is missing")
            if _measure(directory / name) != measure:
                raise Torn(f"{directory} is torn: {name} was cut short or changed")
        return list(files)


def _complete(directory: Path) -> bool:
    try:
        return bool(verify(directory))
    except Torn:
        return False


def save_arrays(path: Path | str, tree: Any, meta: Any, overwrite: bool = False) -> None:
    """Writes arrays as a directory of .npy files.

    Args:
      path: the directory; a torn one there is replaced.
      tree: nested dicts of arrays; `{"a": {"b": x}}` becomes `a.b.npy`.
      meta: what JSON can hold (see `plain`), kept beside them.
      overwrite: replace a complete directory, too.

    Raises:
      BadInput: `path` is complete already, or a name or an array cannot be kept.
    """
    path, arrays = Path(path), {name: _array(name, x) for name, x in _dotted(tree)}
    if not overwrite and _complete(path):
        raise BadInput(f"{path} is there already, and is not overwritten")
    with disk(path):
        if path.exists() and any(path.iterdir()) and not (path / MANIFEST).exists():
            raise BadInput(f"{path} holds something else, and is not overwritten")
    with _building(path) as scratch:
        for name, array in arrays.items():
            np.save(scratch / f"{name}.npy", array, allow_pickle=False)
        save_json(scratch / "meta.json", meta)


def load_arrays(path: Path | str, mmap: bool = False) -> tuple[dict[str, Any], Any]:
    """What `save_arrays` wrote: `(tree, meta)`.

    Args:
      path: the directory.
      mmap: leave the arrays on the disk, read-only, and read what is looked at.

    Raises:
      Torn: a file is missing, cut short or changed.
      BadInput: a file holds pickled objects.
    """
    path, tree = Path(path), dict[str, Any]()
    for file in verify(path):
        if not file.endswith(".npy"):
            continue
        *parents, name = file.removesuffix(".npy").split(".")
        node: dict[str, Any] = functools.reduce(lambda d, k: d.setdefault(k, {}), parents, tree)
        try:
            node[name] = np.load(path / file, mmap_mode="r" if mmap else None, allow_pickle=False)
        except ValueError as error:
            raise BadInput(f"{path / file} cannot be read: {error}") from None
    return tree, load_json(path / "meta.json")


def _dotted(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if not isinstance(key, str) or not re.fullmatch(r"[\w-]+", key):
            raise BadInput(f"{key!r} cannot name an array: letters, digits, _ and - can")
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _array(name: str, x: Any) -> np.ndarray:
    if _is_key(x):
        raise BadInput(f"{name} holds typed random keys: keep jax.random.key_data of them")
    array = np.asarray(x)
    if array.dtype.kind not in "biufc":
        raise BadInput(f"{name} cannot be kept without pickle: its dtype is {array.dtype}")
    return array


def _is_key(x: Any) -> bool:
    return hasattr(x, "dtype") and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)


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
        keys = {name: str(jax.random.key_impl(x)) for name, x in leaves.items() if _is_key(x)}
        raw = {k: jax.random.key_data(x) if k in keys else x for k, x in leaves.items()}
        arrays = {name: _array(name, x) for name, x in raw.items()}
        kinds = {name: _kind(x) for name, x in leaves.items()}
        with _building(self._path(step)) as scratch:
            save_json(scratch / "leaves.json", {"kinds": kinds, "keys": keys})
            # orbax refuses arrays without elements; their kind is all there is to them.
            _write(scratch / "tree", {name: x for name, x in arrays.items() if x.size})
        self._saved = time.monotonic()
        with disk(self.directory):
            keep = [s for s in self.steps() if s <= step][-self.keep :]
            for old in set(self.steps()) - set(keep):
                _remove(self._path(old))

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
                verify(self._path(step))
            except Torn as torn:
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

    wanted, record = _named(like), load_json(path / "leaves.json")
    kinds = {name: _kind(x) for name, x in wanted.items()}
    for name in sorted(kinds.keys() | record["kinds"].keys()):
        there, here = record["kinds"].get(name, "absent"), kinds.get(name, "absent")
        if there != here:
            difference = f"{name} is {there} there, {here} here"
            raise BadInput(f"{path} is a checkpoint of another robot or setting: {difference}")
    tree = (path / "tree").absolute()
    with disk(path):
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
        return load_json(self.path("done.json"))

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
            _remove(self.path("checkpoints"))
