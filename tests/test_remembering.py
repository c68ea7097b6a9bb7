"""A buffer's rows are written once, and come back bit by bit, whatever is corrupt or killed."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from bits import flip, same, truncate
from killing import Killed
from test_buffer import LANES, ROWS, UNROLL, filled

from genidm import files
from genidm.agents.buffer import Buffer, add, empty
from genidm.agents.remembering import Remembering
from genidm.checkpoints import Checkpoints
from genidm.errors import BadInput


def tree(parts: int) -> dict[str, Any]:
    """What a learner of such a buffer would be."""
    return {"learner": {"buffer": filled(parts)[0], "params": np.full(3, parts)}, "chunks": parts}


LIKE = tree(0)


def saved(directory: Path, steps: list[int]) -> Remembering:
    """A run that makes a checkpoint after so many parts, again and again."""
    remembering = Remembering(Checkpoints(directory))
    for step in steps:
        remembering.save(step, tree(step))
    return remembering


def found(directory: Path) -> tuple[int, Any] | None:
    return Remembering(Checkpoints(directory)).latest(LIKE)


def spans(directory: Path) -> list[tuple[int, int]]:
    names = sorted(p.name.split("_")[1:] for p in directory.glob("part_*"))
    return [(int(first), int(end)) for first, end in names]


# The ring has room for 4 parts: never full, just full, run over once, again and again, and in
# one go by more than it holds.
HISTORIES = ([1], [2, 4], [3, 5], list(range(1, 15)), [2, 3, 7, 8, 14], [14], [1, 14])


@pytest.mark.parametrize("steps", HISTORIES, ids=str)
def test_a_buffer_comes_back_bit_by_bit(tmp_path: Path, steps: list[int]) -> None:
    for step in steps:
        # As a run that is killed after each save, and goes on.
        remembering = Remembering(Checkpoints(tmp_path))
        remembering.latest(LIKE)
        remembering.save(step, tree(step))
    got = found(tmp_path)
    assert got and got[0] == steps[-1]
    same(got[1], tree(steps[-1]))


@pytest.mark.parametrize("steps", HISTORIES, ids=str)
def test_rows_are_written_once_and_go_when_they_are_written_over(
    tmp_path: Path, steps: list[int], monkeypatch
) -> None:
    written, write = [], Checkpoints.save_part
    monkeypatch.setattr(
        Checkpoints, "save_part",
        lambda self, name, arrays: (written.append(len(arrays["last"])), write(self, name, arrays)),
    )  # fmt: skip
    saved(tmp_path, steps)
    gaps = np.diff([0, *steps]) * UNROLL
    assert written == [min(gap, ROWS) for gap in gaps]
    there = spans(tmp_path)
    assert there[-1][1] == steps[-1] * UNROLL
    # Two checkpoints are kept: what the older one's ring held is still there, and no more.
    oldest = max(0, steps[-2:][0] * UNROLL - ROWS)
    assert all(end > oldest for _, end in there) and there[0][0] <= oldest
    assert sum(end - first for first, end in there) <= 3 * ROWS


def test_the_steps_themselves_hold_no_rows(tmp_path: Path) -> None:
    saved(tmp_path, [8])
    names = files.load_json(tmp_path / "step_000000008" / "leaves.json")["kinds"]
    assert names["learner/buffer/rows/s"] == f"float32[0, {ROWS}, {LANES}, 2]"
    sizes = [p.stat().st_size for p in (tmp_path / "step_000000008").rglob("*") if p.is_file()]
    assert sum(sizes) < 10_000


def test_a_tree_without_a_buffer_has_no_parts(tmp_path: Path) -> None:
    remembering = Remembering(Checkpoints(tmp_path))
    remembering.save(1, {"params": np.ones(3)})
    assert not spans(tmp_path)
    same(
        Remembering(Checkpoints(tmp_path)).latest({"params": np.zeros(3)}),
        (1, {"params": np.ones(3)}),
    )


def test_a_corrupt_part_gives_way_to_the_checkpoint_before(tmp_path: Path, capsys) -> None:
    saved(tmp_path, [3, 5, 6])
    newest = sorted(tmp_path.glob("part_*"))[-1]
    harmed = [newest / name for name in ("s.npy", "last.npy", "manifest.json")]
    for file in harmed:
        whole = file.read_bytes()
        for harm in (flip, truncate, Path.unlink):
            harm(file)
            got = found(tmp_path)
            assert got and got[0] == 5
            same(got[1], tree(5))
            assert "trying the one before" in capsys.readouterr().err
            file.write_bytes(whole)
    shutil.rmtree(newest)
    assert found(tmp_path)[0] == 5
    # The run goes on from there, and makes the part anew.
    remembering = Remembering(Checkpoints(tmp_path))
    remembering.latest(LIKE)
    remembering.save(6, tree(6))
    same(found(tmp_path), (6, tree(6)))


def test_a_corrupt_part_of_both_checkpoints_is_said(tmp_path: Path, capsys) -> None:
    saved(tmp_path, [3, 5, 6])
    flip(sorted(tmp_path.glob("part_*"))[0] / "a.npy")
    assert found(tmp_path) is None
    first, second = capsys.readouterr().err.splitlines()
    assert "a.npy was cut short or changed; trying the one before it" in first
    assert "a.npy was cut short or changed; beginning anew" in second
    saved(tmp_path, [2])
    same(found(tmp_path), (2, tree(2)))
    assert spans(tmp_path) == [(0, 2 * UNROLL)]


def test_a_part_made_anew_is_not_taken_for_the_one_before(tmp_path: Path) -> None:
    """Other bits, of another machine, say: the checkpoint of the first ones is lost with them."""
    saved(tmp_path, [1, 2])
    other = tree(2)
    buffer = other["learner"]["buffer"]
    rows = buffer.rows.replace(a=buffer.rows.a + 1)
    other["learner"]["buffer"] = buffer.replace(rows=rows)
    flip(tmp_path / "step_000000002" / "leaves.json")
    remembering = Remembering(Checkpoints(tmp_path))
    assert remembering.latest(LIKE)[0] == 1
    flip(tmp_path / "step_000000002" / "leaves.json")  # it was only for once, as disks have it
    remembering.append(other["learner"]["buffer"])  # killed before the checkpoint
    got = found(tmp_path)
    assert got[0] == 1
    same(got[1], tree(1))


def test_a_buffer_of_another_size_is_refused(tmp_path: Path) -> None:
    saved(tmp_path, [3])
    rows = LIKE["learner"]["buffer"].rows
    for max_replay_size in (ROWS * LANES // 2, 2 * ROWS * LANES):
        part = rows.replace(**{k: x[:UNROLL] for k, x in vars(rows).items()})
        like = {**LIKE, "learner": {**LIKE["learner"], "buffer": empty(part, max_replay_size)}}
        with pytest.raises(BadInput, match=r"rows/a is float32\[0, 12, 5, 1\] in the"):
            Remembering(Checkpoints(tmp_path)).latest(like)


def test_killed_at_any_moment_old_or_new_is_there(tmp_path: Path, monkeypatch) -> None:
    """From a ring that is full to one that has been written over, of which parts go."""
    moments = 0

    def dying(call, at: int):
        def replacement(*args, **kwargs):
            nonlocal moments
            moments += 1
            if moments == at:
                raise Killed
            if moments < at:  # the dead do not tidy up
                return call(*args, **kwargs)

        return replacement

    seen = set()
    saved(tmp_path / "0", [2, 4])
    for at in range(1, 200):
        moments, directory = 0, tmp_path / str(at)
        shutil.copytree(tmp_path / "0", directory)
        remembering = Remembering(Checkpoints(directory))
        remembering.latest(LIKE)
        with monkeypatch.context() as m:
            m.setattr(os, "fsync", dying(os.fsync, at))
            m.setattr(os, "replace", dying(os.replace, at))
            m.setattr(Path, "rename", dying(Path.rename, at))
            m.setattr(files, "delete", dying(files.delete, at))
            with contextlib.suppress(Killed):
                remembering.save(8, tree(8))
                break
        step, back = found(directory)
        assert step in (4, 8)
        same(back, tree(step))
        seen.add(step)
        if at % 5 == 0:
            again = Remembering(Checkpoints(directory))
            again.latest(LIKE)
            again.save(8, tree(8))
            same(found(directory), (8, tree(8)))
            assert spans(directory) == [(0, 6), (6, 12), (12, 24)]
    assert at > 20 and seen == {4, 8}
    same(found(directory), (8, tree(8)))


LOOP = """
import sys, numpy as np
from genidm.agents.buffer import Buffer, ReplayTransition
from genidm.agents.remembering import Remembering
from genidm.checkpoints import Checkpoints
remembering, rows = Remembering(Checkpoints(sys.argv[1])), np.zeros((100, 20), np.int32)
for step in range(1, 10**6):
    new = np.arange((step - 1) * 30, step * 30)
    rows[new % 100] = new[:, None]
    memory = ReplayTransition(**dict.fromkeys(ReplayTransition.__dataclass_fields__, rows.copy()))
    remembering.save(step, {"buffer": Buffer(memory, np.int32(step * 30)), "n": step})
    print(step, flush=True)
"""


@pytest.mark.parametrize("wait", [0.0, 0.013, 0.04])
def test_kill_9_leaves_a_readable_newest_checkpoint(tmp_path: Path, wait: float) -> None:
    env = {**os.environ, "PYTHONPATH": str(Path(files.__file__).parents[1])}
    command = [sys.executable, "-c", LOOP, str(tmp_path)]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        for _ in range(9):
            said = int(process.stdout.readline())
        time.sleep(wait)  # into one of the next saves
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
    said = int(rest[-1]) if rest else said
    blank = Buffer(_memory(np.zeros((100, 20), np.int32)), np.int32(0))
    step, back = Remembering(Checkpoints(tmp_path)).latest({"buffer": blank, "n": 0})
    assert step in (said, said + 1) and back["n"] == step
    number = np.arange(step * 30 - 100, step * 30)
    for x in vars(back["buffer"].rows).values():
        np.testing.assert_array_equal(x[number % 100], np.repeat(number[:, None], 20, axis=1))


def _memory(rows: np.ndarray) -> Any:
    return filled(0)[0].rows.replace(**dict.fromkeys(vars(filled(0)[0].rows), rows))


def test_what_is_inserted_after_a_resume_lies_where_it_would(tmp_path: Path) -> None:
    saved(tmp_path, [5])
    _, back = found(tmp_path)
    buffer, part = back["learner"]["buffer"], filled(6)[0].rows
    at = np.arange(5 * UNROLL, 6 * UNROLL) % ROWS
    new = part.replace(**{k: jnp.asarray(x)[at] for k, x in vars(part).items()})
    same(add(buffer, new), filled(6)[0])
