"""Files and directories on disk: whole, or not at all.

Everything is written beside its final name and renamed into place once it is on the disk,
so that a run killed at any moment leaves the old files or the new ones. Directories carry
the size and crc32 of each file; one that does not match is corrupt, and is not used. Nothing
is ever pickled. A full disk, or one that cannot be written, is BadInput everywhere.
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
# Seconds after which nobody is still writing what was begun.
_ABANDONED = 24 * 3600.0


class Corrupt(BadInput):
    """Files that are missing, cut short or changed since they were written."""


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


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Holds Ctrl-C back until its end.

    For libraries that write with threads of their own, which say what they think of it.
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


def _scratch(path: Path, use: str) -> Path:
    """A new name beside `path`, for "new", "old" or "gone"; what killed runs left there goes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".*{_SCRATCH}"):
        name, old, _ = left.name[1:].rpartition(".old.")
        only_version = old and not left.with_name(name).exists()
        if _abandoned(left) and not only_version:
            _delete(left)
    token = secrets.token_hex(4)
    return path.with_name(f".{path.name}.{use}.{_here()}.{os.getpid()}.{token}{_SCRATCH}")


@functools.cache
def _here() -> str:
    """Names the process ids that can be told apart from here: two containers may have one each."""
    parts = [platform.node()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text())
        parts.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def _abandoned(left: Path) -> bool:
    """Whether nobody writes it any more: its process is dead, or it is a day old."""
    *_, here, process, _token, _suffix = left.name.split(".")
    try:
        old = time.time() - left.stat().st_mtime > _ABANDONED
        return old or (here == _here() and process.isdecimal() and not _alive(int(process)))
    except FileNotFoundError:
        return False


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


def _recover(path: Path) -> None:
    """Brings back the old version of a directory, if a kill has left no new one in its place."""
    if not path.exists():
        for old in path.parent.glob(f".{glob.escape(path.name)}{_OLD}"):
            if _complete(old):
                old.rename(path)
                return


def remove(path: Path) -> None:
    """Removes a directory, if it is there, so that a kill leaves no half of it under its name.

    Raises:
      OSError: it cannot be removed; `disk` around the call says so in a sentence.
    """
    if path.exists():
        _delete(path.rename(_scratch(path, "gone")))


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
        scratch = _scratch(path, "new")
        try:
            scratch.write_bytes(content)
            _sync(scratch)
            os.replace(scratch, path)
            _sync(path.parent)
        finally:
            _delete(scratch)


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
    """Refuses a path that cannot be written, before the work that it is for.

    Args:
      path: a file, or a directory to write files to; what lies there is left as it is, and
        directories that are missing are not made yet.
      directory: whether it is one.

    Raises:
      BadInput: it cannot be written, or is a directory where a file is wanted, or the reverse.
    """
    path = Path(path)
    with disk(path):
        there, missing = (path, "probe") if directory else (path.parent, path.name)
        if not directory and path.is_dir():
            raise BadInput(f"cannot use {path}: it is a directory, not a file")
        # A link to nothing is there, and is not made by mkdir.
        while not (os.path.lexists(there) or there == there.parent):
            there, missing = there.parent, there.name
        if not there.is_dir():
            raise BadInput(f"cannot use {path}: {there} is not a directory")
        probe = _scratch(there / missing, "new")
        try:
            probe.touch(exist_ok=False)
        finally:
            _delete(probe)


@contextlib.contextmanager
def building(path: Path) -> Iterator[Path]:
    """A directory to fill, which then takes the place of `path`, with a manifest.

    An error while it is filled leaves `path` as it was. A kill leaves the old version or the
    new one: `verify` brings back an old one that was moved away when the kill came.

    Raises:
      BadInput: the disk is full, `path` cannot be written, or it holds what its manifest does
        not list.
    """
    with disk(path):
        _recover(path)
        _only_ours(path)
        scratch = _scratch(path, "new")
        try:
            scratch.mkdir()
            yield scratch
            entries = sorted(scratch.rglob("*"))
            if not entries:
                raise BadInput(f"{scratch} has vanished while it was written")
            for entry in entries:
                _sync(entry)
            files = {str(p.relative_to(scratch)): _measure(p) for p in entries if p.is_file()}
            save_json(scratch / MANIFEST, files)
            _install(scratch, path)
        finally:
            _delete(scratch)


def _install(scratch: Path, path: Path) -> None:
    """Puts a directory in the place of another: that is moved away, and deleted afterwards."""
    if path.exists():
        old = path.rename(_scratch(path, "old"))
        try:
            scratch.rename(path)
        except OSError:
            old.rename(path)
            raise
    else:
        scratch.rename(path)
    _sync(path.parent)
    for old in path.parent.glob(f".{glob.escape(path.name)}{_OLD}"):
        _delete(old)


def _only_ours(path: Path) -> None:
    """Refuses a directory with files that are not in its manifest."""
    if not path.exists() or not any(path.iterdir()):
        return
    try:
        listed = {MANIFEST, *_manifest(path)}
    except Corrupt:
        listed = set()
    for file in sorted(path.rglob("*")):
        name = str(file.relative_to(path))
        if file.is_file() and name not in listed and not name.endswith(_SCRATCH):
            raise BadInput(f"{path} holds something else ({name}), and is not overwritten")


def _manifest(directory: Path) -> dict[str, list[int]]:
    """Size and crc32 of each file; raises Corrupt if there is no such list."""
    files = load_json(directory / MANIFEST)
    measures = files.values() if isinstance(files, dict) else [None]
    if not all(isinstance(m, list) and [type(x) for x in m] == [int, int] for m in measures):
        raise Corrupt(f"{directory / MANIFEST} is no list of files")
    return files


def _measure(file: Path) -> list[int]:
    size = crc = 0
    with file.open("rb") as f:
        while block := f.read(1 << 20):
            size, crc = size + len(block), zlib.crc32(block, crc)
    return [size, crc]


def verify(directory: Path | str) -> list[str]:
    """The files of a complete directory; raises Corrupt if it is not."""
    directory = Path(directory)
    with disk(directory):
        _recover(directory)
        if not directory.exists():
            raise Corrupt(f"{directory} is missing")
        files = _manifest(directory)
        for name, measure in files.items():
            if not (directory / name).is_file():
                raise Corrupt(f"{directory} is corrupt: {name} is missing")
            if _measure(directory / name) != measure:
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
      path: the directory; a corrupt one there is replaced.
      tree: nested dicts of arrays; `{"a": {"b": x}}` becomes `a.b.npy`.
      meta: what JSON can hold (see `to_json`), kept beside them.
      overwrite: replace a complete directory, too.

    Raises:
      BadInput: `path` is complete already, or a name or an array cannot be kept.
    """
    path, arrays = Path(path), {name: as_array(name, x) for name, x in _dotted(tree)}
    if not overwrite and _complete(path):
        raise BadInput(f"{path} is there already, and is not overwritten")
    with building(path) as scratch:
        for name, array in arrays.items():
            np.save(scratch / f"{name}.npy", array, allow_pickle=False)
        save_json(scratch / "meta.json", meta)


def load_arrays(path: Path | str, mmap: bool = False) -> tuple[dict[str, Any], Any]:
    """What `save_arrays` wrote: `(tree, meta)`.

    Args:
      path: the directory.
      mmap: leave the arrays on the disk, read-only, and read what is looked at.

    Raises:
      Corrupt: a file is missing, cut short or changed.
      BadInput: a file holds pickled objects.
    """
    path, tree = Path(path), dict[str, Any]()
    for file in verify(path):
        if not file.endswith(".npy"):
            continue
        *parents, name = file.removesuffix(".npy").split(".")
        node: dict[str, Any] = functools.reduce(lambda d, k: d.setdefault(k, {}), parents, tree)
        if not isinstance(node, dict) or name in node:
            raise BadInput(f"{path} is no tree of arrays: {file} lies inside another array")
        node[name] = _read(path / file, mmap)
    return tree, load_json(path / "meta.json")


def _read(file: Path, mmap: bool) -> np.ndarray:
    """An array, once its header says no more than there is: it may claim any number of bytes."""
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
    except Exception as error:  # what NumPy's parser raises for a header that is none varies
        raise BadInput(f"{file} cannot be read: {shown(error)}") from None
    return array


def _dotted(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if not isinstance(key, str) or not re.fullmatch(r"[\w-]+", key):
            raise BadInput(f"{key!r} cannot name an array: letters, digits, _ and - can")
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def as_array(name: str, x: Any) -> np.ndarray:
    """`x` as NumPy's, of any shape and dtype that can be kept without pickle.

    Args:
      name: what an error calls it.
      x: an array, or a number.

    Raises:
      BadInput: it holds objects, text or typed random keys.
    """
    if is_key(x):
        raise BadInput(f"{name} holds typed random keys: keep jax.random.key_data of them")
    array = np.asarray(x)
    if array.dtype.kind not in "biufc":
        raise BadInput(f"{name} cannot be kept without pickle: its dtype is {array.dtype}")
    return array


def is_key(x: Any) -> bool:
    """Whether `x` is an array of typed random keys (`jax.random.key`)."""
    return hasattr(x, "dtype") and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)
