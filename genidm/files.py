"""Atomic files and directories, with checksums.

Everything is written under a temporary name, synced, and renamed, so that a kill at any moment
leaves the old version or the new one. A directory has a manifest with the size and crc32 of each
file; a directory that does not match is corrupt and is not used. Nothing is pickled. A disk that
is full or not writable raises BadInput in all functions.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import glob
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
import signal
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import numpy as np

from genidm.checks import shown
from genidm.config import to_json
from genidm.errors import BadInput

MANIFEST = "manifest.json"
_SCRATCH = ".genidm-tmp"
_OLD = f".old.*{_SCRATCH}"
# A temporary file older than this, in seconds, belongs to no running process.
_ABANDONED = 24 * 3600.0


class Corrupt(BadInput):
    """Files that are missing, cut short or changed since they were written."""


@contextlib.contextmanager
def disk(path: Path | str) -> Iterator[None]:
    """Turns errors of reading or writing `path` into a one-sentence BadInput."""
    try:
        yield
    except BadInput:
        raise
    except Exception as error:
        # On a full disk tensorstore raises a ValueError, and NumPy an OSError without errno.
        full = re.search("No space left|quota exceeded|requested and .* written", str(error))
        if full or getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            raise BadInput(f"no space left on the disk that holds {path}") from error
        if isinstance(error, OSError):
            raise BadInput(f"cannot use {path}: {error.strerror or error}") from error
        raise


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Delays Ctrl-C until the end of the block.

    For libraries that write with their own threads, which print tracebacks when interrupted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    before = signal.signal(signal.SIGINT, lambda *what: came.append(what))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
    if came and callable(before):
        before(*came[0])


def scratch_path(path: Path, use: str) -> Path:
    """A new temporary name beside `path`, for "new", "old" or "gone"; deletes abandoned ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".*{_SCRATCH}"):
        name, old, _ = left.name[1:].rpartition(".old.")
        only_version = old and not left.with_name(name).exists()
        if _abandoned(left) and not only_version:
            delete(left)
    token = secrets.token_hex(4)
    return path.with_name(f".{path.name}.{use}.{_here()}.{os.getpid()}.{token}{_SCRATCH}")


@functools.cache
def _here() -> str:
    """Identifies the set of process ids: two containers may both have a process 7."""
    parts = [platform.node()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text())
        parts.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def _abandoned(left: Path) -> bool:
    """Whether no process writes `left`: its process has ended, or it is a day old."""
    *_, here, process, _token, _suffix = left.name.split(".")
    try:
        old = time.time() - left.stat().st_mtime > _ABANDONED
        return old or (here == _here() and process.isdecimal() and not _alive(int(process)))
    except FileNotFoundError:
        return False


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 only tests whether the process exists
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


def delete(path: Path) -> None:
    """Deletes a file or a directory, if it is there."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _recover(path: Path) -> None:
    """Restores the old version of a directory if a kill prevented the rename of the new one."""
    if not path.exists():
        for old in path.parent.glob(f".{glob.escape(path.name)}{_OLD}"):
            if _complete(old):
                old.rename(path)
                return


def remove(path: Path) -> None:
    """Removes a directory if it exists; a kill never leaves a part of it under its name.

    Raises:
      OSError: it cannot be removed; wrap the call in `disk` for a BadInput.
    """
    if path.exists():
        delete(path.rename(scratch_path(path, "gone")))


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def save_text(path: Path | str, text: str) -> None:
    """Writes a text file."""
    save_bytes(path, text.encode())


def save_bytes(path: Path | str, content: bytes) -> None:
    """Writes a file."""
    path = Path(path)
    with disk(path):
        scratch = scratch_path(path, "new")
        try:
            scratch.write_bytes(content)
            _sync(scratch)
            os.replace(scratch, path)
            _sync(path.parent)
        finally:
            delete(scratch)


def save_json(path: Path | str, obj: Any) -> None:
    """Writes `to_json(obj)`."""
    save_text(path, json.dumps(to_json(obj), indent=2) + "\n")


def load_json(path: Path | str) -> Any:
    """Reads JSON; raises Corrupt if the file is missing or is not JSON."""
    with disk(path):
        try:
            return json.loads(Path(path).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise Corrupt(f"{path} is missing") from None
        except (ValueError, RecursionError):
            raise Corrupt(f"{path} is corrupt: it is not JSON") from None


def check_writable(path: Path | str, directory: bool = False) -> None:
    """Checks that a path can be written, before the work whose results it will hold.

    Existing files stay as they are, and missing directories are not made.

    Args:
      path: a file, or a directory for files.
      directory: whether `path` is a directory.

    Raises:
      BadInput: `path` cannot be written, or is a directory instead of a file or the reverse.
    """
    path = Path(path)
    with disk(path):
        there, missing = (path, "probe") if directory else (path.parent, path.name)
        if not directory and path.is_dir():
            raise BadInput(f"cannot use {path}: it is a directory, not a file")
        # `lexists`: a broken link exists, and mkdir cannot replace it.
        while not (os.path.lexists(there) or there == there.parent):
            there, missing = there.parent, there.name
        if not there.is_dir():
            raise BadInput(f"cannot use {path}: {there} is not a directory")
        probe = scratch_path(there / missing, "new")
        try:
            probe.touch(exist_ok=False)
        finally:
            delete(probe)


@contextlib.contextmanager
def building(path: Path) -> Iterator[Path]:
    """Yields an empty directory to fill; at the end, adds a manifest and replaces `path` by it.

    An error in the block leaves `path` unchanged. A kill leaves the old version or the new one:
    `verify` restores an old version that was already moved away.

    Raises:
      BadInput: the disk is full, `path` cannot be written, or `path` contains files that its
        manifest does not list.
    """
    with disk(path):
        _recover(path)
        _only_ours(path)
        scratch = scratch_path(path, "new")
        try:
            scratch.mkdir()
            yield scratch
            entries = sorted(scratch.rglob("*"))
            if not entries:
                raise BadInput(f"{scratch} has vanished while it was being written")
            for entry in entries:
                _sync(entry)
            files = {str(p.relative_to(scratch)): measure(p) for p in entries if p.is_file()}
            save_json(scratch / MANIFEST, files)
            _install(scratch, path)
        finally:
            delete(scratch)


def _install(scratch: Path, path: Path) -> None:
    """Replaces `path` by `scratch`: moves the old directory away, and deletes it afterwards."""
    if path.exists():
        old = path.rename(scratch_path(path, "old"))
        try:
            scratch.rename(path)
        except OSError:
            old.rename(path)
            raise
    else:
        scratch.rename(path)
    _sync(path.parent)
    for old in path.parent.glob(f".{glob.escape(path.name)}{_OLD}"):
        delete(old)


def _only_ours(path: Path) -> None:
    """Raises BadInput if a directory contains files that its manifest does not list."""
    if not path.exists() or not any(path.iterdir()):
        return
    try:
        listed = {MANIFEST, *_manifest(path)}
    except Corrupt:
        listed = set()
    for file in sorted(path.rglob("*")):
        name = str(file.relative_to(path))
        if file.is_file() and name not in listed and not name.endswith(_SCRATCH):
            raise BadInput(f"{path} holds something else ({name}) and is not overwritten")


def _manifest(directory: Path) -> dict[str, list[int]]:
    """Size and crc32 of each file; raises Corrupt if the manifest is missing or invalid."""
    files = load_json(directory / MANIFEST)
    measures = files.values() if isinstance(files, dict) else [None]
    if not all(isinstance(m, list) and [type(x) for x in m] == [int, int] for m in measures):
        raise Corrupt(f"{directory / MANIFEST} is not a list of files")
    return files


def measure(file: Path) -> list[int]:
    """Size in bytes and crc32 of a file, as a manifest lists them."""
    size = crc = 0
    with file.open("rb") as f:
        while block := f.read(1 << 20):
            size, crc = size + len(block), zlib.crc32(block, crc)
    return [size, crc]


def verify(directory: Path | str) -> list[str]:
    """Checks a directory against its manifest and returns its files; raises Corrupt."""
    directory = Path(directory)
    with disk(directory):
        _recover(directory)
        if not directory.exists():
            raise Corrupt(f"{directory} is missing")
        files = _manifest(directory)
        for name, listed in files.items():
            if not (directory / name).is_file():
                raise Corrupt(f"{directory} is corrupt: {name} is missing")
            if measure(directory / name) != listed:
                raise Corrupt(f"{directory} is corrupt: {name} was cut short or changed")
        return list(files)


def _complete(directory: Path) -> bool:
    try:
        return bool(verify(directory))
    except Corrupt:
        return False


def save_arrays(path: Path | str, tree: Any, meta: Any, overwrite: bool = False) -> None:
    """Writes arrays as a directory of .npy files.

    Args:
      path: the directory; a corrupt one is replaced.
      tree: nested dicts of arrays; `{"a": {"b": x}}` becomes `a.b.npy`.
      meta: metadata for `meta.json`; any value that `to_json` accepts.
      overwrite: also replace a complete directory.

    Raises:
      BadInput: `path` is complete already, or a name or an array cannot be stored.
    """
    path, arrays = Path(path), {name: as_array(name, x) for name, x in _dotted(tree)}
    if not overwrite and _complete(path):
        raise BadInput(f"{path} exists already and is not overwritten")
    with building(path) as scratch:
        for name, array in arrays.items():
            np.save(scratch / f"{name}.npy", array, allow_pickle=False)
        save_json(scratch / "meta.json", meta)


def load_arrays(path: Path | str, mmap: bool = False) -> tuple[dict[str, Any], Any]:
    """Reads what `save_arrays` wrote: `(tree, meta)`.

    Args:
      path: the directory.
      mmap: memory-map the arrays, read-only, instead of reading them.

    Raises:
      Corrupt: a file is missing, cut short or changed.
      BadInput: a file contains pickled objects or is not a valid array.
    """
    path, tree = Path(path), dict[str, Any]()
    for file in verify(path):
        if not file.endswith(".npy"):
            continue
        *parents, name = file.removesuffix(".npy").split(".")
        node: dict[str, Any] = functools.reduce(lambda d, k: d.setdefault(k, {}), parents, tree)
        if not isinstance(node, dict) or name in node:
            raise BadInput(f"{path} is not a tree of arrays: {file} is named like part of an array")
        node[name] = _read(path / file, mmap)
    return tree, load_json(path / "meta.json")


def _read(file: Path, mmap: bool) -> np.ndarray:
    """Reads an array after checking its header: a corrupt one may claim any number of bytes."""
    try:
        with file.open("rb") as f:
            version = np.lib.format.read_magic(f)
            header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, _, dtype = header(f)
            there = file.stat().st_size - f.tell()
        claimed = math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or (claimed != there and not dtype.hasobject):
            raise ValueError(f"its header claims {shape} of {dtype}, and {there} bytes follow")
        array: np.ndarray = np.load(file, mmap_mode="r" if mmap else None, allow_pickle=False)
    except OSError:
        raise
    except Exception as error:  # NumPy's parser raises various errors for an invalid header
        raise BadInput(f"{file} cannot be read: {shown(error)}") from None
    return array


def _dotted(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if not isinstance(key, str) or not re.fullmatch(r"[\w-]+", key):
            raise BadInput(f"{key!r} cannot name an array: use only letters, digits, _ and -")
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def as_array(name: str, x: Any) -> np.ndarray:
    """Converts `x` to a NumPy array of a dtype that can be stored without pickle.

    Args:
      name: name of `x` in error messages.
      x: an array of any shape, or a number.

    Raises:
      BadInput: `x` contains objects, text or typed random keys.
    """
    if is_key(x):
        raise BadInput(f"{name} holds typed random keys: store jax.random.key_data of them")
    array = np.asarray(x)
    if array.dtype.kind not in "biufc":
        raise BadInput(f"{name} cannot be stored without pickle: its dtype is {array.dtype}")
    return array


def is_key(x: Any) -> bool:
    """Whether `x` is an array of typed random keys (`jax.random.key`)."""
    return hasattr(x, "dtype") and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)
