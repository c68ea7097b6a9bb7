"""What is on the disk is whole, or is known not to be."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import jax
import numpy as np
import pytest
from bits import flip, same, truncate

from genidm import checkpoints, files
from genidm.checkpoints import Checkpoints
from genidm.errors import BadInput
from genidm.files import Corrupt, load_arrays, save_arrays
from genidm.store import Stage


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# --- arrays ----------------------------------------------------------------------------

TREE = {
    "physics": {
        "qpos": np.arange(12.0, dtype=np.float32).reshape(3, 4).T,
        "empty": np.zeros((0, 2)),
    },
    "ends": np.array([True, False]),
    "count": np.uint64(2**63),
}


@pytest.mark.parametrize("mmap", [False, True])
def test_arrays_come_back_bit_by_bit(tmp_path: Path, mmap: bool) -> None:
    save_arrays(tmp_path / "x", TREE, {"seed": 3, "robot": "ant"})
    tree, meta = load_arrays(tmp_path / "x", mmap=mmap)
    same(tree, TREE)
    assert meta == {"seed": 3, "robot": "ant"}
    assert isinstance(tree["physics"]["qpos"], np.memmap) == mmap


NAMES = ["physics.qpos.npy", "meta.json", "manifest.json"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("harm", [flip, truncate, Path.unlink])
def test_corrupt_arrays_are_recognised_and_replaced(tmp_path: Path, name: str, harm) -> None:
    save_arrays(tmp_path / "x", TREE, {})
    harm(tmp_path / "x" / name)
    with pytest.raises(Corrupt, match=r"corrupt|missing"):
        load_arrays(tmp_path / "x")
    if name == "manifest.json" and harm is not flip:  # nobody knows then whose files they are
        with pytest.raises(BadInput, match="something else"):
            save_arrays(tmp_path / "x", TREE, {"again": True}, overwrite=True)
    else:
        save_arrays(tmp_path / "x", TREE, {"again": True})
        assert load_arrays(tmp_path / "x")[1] == {"again": True}


def test_missing_arrays_are_corrupt(tmp_path: Path) -> None:
    with pytest.raises(Corrupt, match="missing"):
        load_arrays(tmp_path / "nowhere")


def test_complete_arrays_are_overwritten_only_when_told(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", TREE, 1)
    with pytest.raises(BadInput, match="not overwritten"):
        save_arrays(tmp_path / "x", TREE, 2)
    assert load_arrays(tmp_path / "x")[1] == 1
    save_arrays(tmp_path / "x", {"a": np.ones(1)}, 3, overwrite=True)
    assert load_arrays(tmp_path / "x")[1] == 3
    assert sorted(p.name for p in (tmp_path / "x").iterdir()) == ["a.npy", *sorted(NAMES[1:])]


def test_a_directory_of_something_else_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(BadInput, match="something else"):
        save_arrays(tmp_path, TREE, {}, overwrite=True)
    assert (tmp_path / "thesis.tex").exists()


def test_files_that_a_user_put_beside_ours_are_never_removed(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", TREE, 1)
    (tmp_path / "x" / "notes.txt").write_text("seed 3 walks best")
    with pytest.raises(BadInput, match=r"holds something else \(notes.txt\)"):
        save_arrays(tmp_path / "x", TREE, 2, overwrite=True)
    assert load_arrays(tmp_path / "x")[1] == 1 and (tmp_path / "x" / "notes.txt").exists()


@pytest.mark.parametrize("manifest", ['{"name": "app", "icons": []}', "[1, 2]", '{"a.npy": [1]}'])
def test_a_manifest_of_another_program_makes_a_directory_not_ours(
    tmp_path: Path, manifest: str
) -> None:
    (tmp_path / "manifest.json").write_text(manifest)
    (tmp_path / "index.html").write_text("a web app")
    for overwrite in (False, True):
        with pytest.raises(BadInput, match=r"something else \(index.html\)"):
            save_arrays(tmp_path, TREE, {}, overwrite=overwrite)
    assert (tmp_path / "manifest.json").read_text() == manifest


def test_an_old_version_comes_back_where_a_kill_left_no_new_one(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", TREE, 1)
    (tmp_path / "x").rename(files.scratch_path(tmp_path / "x", "old"))
    save_arrays(tmp_path / "y", TREE, 2)  # tidies up, but not the only version of x
    assert load_arrays(tmp_path / "x")[1] == 1
    (tmp_path / "x").rename(files.scratch_path(tmp_path / "x", "old"))
    with pytest.raises(BadInput, match="exists already"):
        save_arrays(tmp_path / "x", TREE, 3)
    assert load_arrays(tmp_path / "x")[1] == 1


def test_what_another_container_is_writing_stays(tmp_path: Path, monkeypatch) -> None:
    """Its process ids are not ours: one that is dead here may be at work there."""
    dead = 2**22 + 1
    monkeypatch.setattr(os, "getpid", lambda: dead)
    monkeypatch.setattr(files, "_here", lambda: "elsewhere")
    theirs = files.scratch_path(tmp_path / "x", "new")
    monkeypatch.undo()
    theirs.mkdir()
    save_arrays(tmp_path / "y", TREE, 1)
    assert theirs.exists()
    os.utime(theirs, (0, 0))  # for so long nobody writes
    save_arrays(tmp_path / "y", TREE, 2, overwrite=True)
    assert not theirs.exists()


def test_a_directory_that_vanishes_while_it_is_written_is_not_installed(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", TREE, 1)
    with pytest.raises(BadInput, match="has vanished"), files.building(tmp_path / "x") as scratch:
        scratch.rmdir()
    assert load_arrays(tmp_path / "x")[1] == 1


@pytest.mark.parametrize(
    ("tree", "why"),
    [
        ({"x": np.array([{}], object)}, "pickle"),
        ({"x": jax.eval_shape(lambda: 0)}, "pickle"),
        ({"x": jax.random.key(0)}, "random keys"),
        ({"../x": np.ones(1)}, "cannot name"),
        ({"a.b": np.ones(1)}, "cannot name"),
    ],
)
def test_what_cannot_be_kept_is_refused(tmp_path: Path, tree: dict, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        save_arrays(tmp_path / "x", tree, {})
    assert not list(tmp_path.iterdir())


def test_pickle_is_not_loaded_even_with_a_true_manifest(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", {"a": np.ones(1)}, {})
    file = tmp_path / "x" / "a.npy"
    np.save(file, np.array([print], object), allow_pickle=True)
    manifest = files.load_json(tmp_path / "x" / "manifest.json")
    files.save_json(tmp_path / "x" / "manifest.json", {**manifest, "a.npy": files.measure(file)})
    for mmap in (False, True):
        with pytest.raises(BadInput, match="cannot be read"):
            load_arrays(tmp_path / "x", mmap=mmap)


def claim(file: Path, shape: tuple[int, ...], dtype: str = "<f4") -> None:
    """Writes a header that claims an array of this shape before 64 bytes."""
    with file.open("wb") as f:
        header = {"descr": dtype, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(f, header)
        f.write(bytes(64))


def believed(directory: Path, name: str) -> None:
    """Makes the manifest say that a file is as it should be."""
    manifest = files.load_json(directory / "manifest.json")
    files.save_json(
        directory / "manifest.json", {**manifest, name: files.measure(directory / name)}
    )


@pytest.mark.parametrize("mmap", [False, True])
@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((10**13,), "<f4"), ((10**6, 10**7), "<f4"), ((2**62, 4), "<f4"), ((17,), "<f4"),
     ((15,), "<f4"), ((-4, -4), "<f4"), ((10**13,), "|O"), ((2,), "<U9999999")],
)  # fmt: skip
def test_a_header_that_claims_what_is_not_there_is_refused_before_anything_is_allocated(
    tmp_path: Path, shape: tuple[int, ...], dtype: str, mmap: bool
) -> None:
    save_arrays(tmp_path / "x", {"a": np.ones(1)}, {})
    claim(tmp_path / "x" / "a.npy", shape, dtype)
    believed(tmp_path / "x", "a.npy")
    with pytest.raises(BadInput, match=r"a\.npy cannot be read"):
        load_arrays(tmp_path / "x", mmap=mmap)
    claim(tmp_path / "x" / "a.npy", (16,))
    believed(tmp_path / "x", "a.npy")
    assert load_arrays(tmp_path / "x", mmap=mmap)[0]["a"].shape == (16,)


@pytest.mark.parametrize(
    "content", [b"", b"text", b"\x93NUMPY\x09\x00", b"\x93NUMPY\x01\x00\x05\x00{[(("]
)
def test_what_is_no_array_is_refused(tmp_path: Path, content: bytes) -> None:
    save_arrays(tmp_path / "x", {"a": np.ones(1)}, {})
    (tmp_path / "x" / "a.npy").write_bytes(content)
    believed(tmp_path / "x", "a.npy")
    with pytest.raises(BadInput, match=r"a\.npy cannot be read"):
        load_arrays(tmp_path / "x")


def test_an_array_inside_an_array_is_refused(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", {"a": {"b": np.ones(1)}}, {})
    np.save(tmp_path / "x" / "a.npy", np.ones(2))
    believed(tmp_path / "x", "a.npy")
    with pytest.raises(BadInput, match="not a tree of arrays"):
        load_arrays(tmp_path / "x")


def test_json_nested_without_end_is_corrupt(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("[" * 10**6)
    with pytest.raises(Corrupt, match="not JSON"):
        files.load_json(tmp_path / "x.json")


# --- what cannot be written ------------------------------------------------------------


@pytest.mark.parametrize("path", ["x.json", "new/x.json", "a/b/c/x.json", "."])
def test_what_can_be_written_is_and_nothing_is_left_of_the_trial(tmp_path: Path, path: str) -> None:
    files.check_writable(tmp_path / path, directory=True)
    if path != ".":
        files.check_writable(tmp_path / path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "here.json").write_text("1")
    files.check_writable(tmp_path / "here.json")
    assert (tmp_path / "here.json").read_text() == "1" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("directory", [False, True])
@pytest.mark.parametrize(
    "path", ["/proc/x/y", "file/x", "file/a/b", "link/x", "n" * 300, "n" * 300 + "/x"]
)
def test_what_cannot_be_written_is_refused(tmp_path: Path, path: str, directory: bool) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(BadInput, match="cannot use"):
        files.check_writable(tmp_path / path, directory)


def test_a_file_is_no_directory_and_a_directory_no_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="not a directory"):
        files.check_writable(tmp_path / "file", directory=True)
    with pytest.raises(BadInput, match="is a directory, not a file"):
        files.check_writable(tmp_path)


# --- full disks ------------------------------------------------------------------------


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch) -> None:
    save_arrays(tmp_path / "x", TREE, 1)
    files.save_json(tmp_path / "y.json", 1)
    Checkpoints(tmp_path / "z").save(1, {"a": np.ones(3)})
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(os, "fsync", full_disk)
    for write in (
        lambda: save_arrays(tmp_path / "x", TREE, 2, overwrite=True),
        lambda: save_arrays(tmp_path / "new", TREE, 2),
        lambda: files.save_json(tmp_path / "y.json", 2),
        lambda: Checkpoints(tmp_path / "z").save(2, {"a": np.ones(3)}),
    ):
        with pytest.raises(BadInput, match="no space left on the disk that holds"):
            write()
    assert sorted(tmp_path.rglob("*")) == before
    assert load_arrays(tmp_path / "x")[1] == files.load_json(tmp_path / "y.json") == 1


@pytest.mark.parametrize(
    "error",
    [
        OSError("12000 requested and 512 written"),  # numpy
        ValueError("RESOURCE_EXHAUSTED: Failed to write to file 14: No space left on device"),
    ],
)
def test_a_full_disk_without_errno_is_recognised(tmp_path: Path, monkeypatch, error) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(np, "save", fail)
    monkeypatch.setattr(checkpoints, "_write", fail)
    with pytest.raises(BadInput, match="no space left"):
        save_arrays(tmp_path / "x", TREE, {})
    with pytest.raises(BadInput, match="no space left"):
        Checkpoints(tmp_path / "z").save(2, {"a": np.ones(3)})
    assert not [p for p in tmp_path.rglob("*") if p.name != "z"]


def test_a_place_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for write in (
        lambda: Stage.open(tmp_path / "file", "collect", {}),
        lambda: save_arrays(tmp_path / "file" / "x", TREE, {}),
        lambda: save_arrays(tmp_path / "file", TREE, {}, overwrite=True),
        lambda: files.save_json("/proc/nothing/x.json", {}),
        lambda: Checkpoints(tmp_path / "file").save(0, {"a": np.ones(3)}),
    ):
        with pytest.raises(BadInput, match="cannot use"):
            write()
