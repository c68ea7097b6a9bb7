"""A stage is found again, and knows whether it is done."""

from __future__ import annotations

import errno
import fcntl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bits import truncate
from killing import Killed
from test_config import Config, Other

from genidm import files, store
from genidm.config import digest, to_json
from genidm.files import Corrupt, load_json
from genidm.provenance import environment
from genidm.store import Stage


def test_a_stage_is_found_again_and_knows_whether_it_is_done(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "collect", Config())
    assert stage.directory == tmp_path / f"collect-{digest(Config())}"
    assert not stage.done and not stage.directory.exists(), "nothing is written by a look"

    def work() -> dict[str, Any]:
        stage.checkpoints().save(3, {"a": 1})
        assert Stage.open(tmp_path, "collect", Config()).checkpoints().steps() == [3]
        assert load_json(stage.path("config.json")) == {"config": to_json(Config()), "code": {}}
        return {"interactions": np.int64(7), "mean": np.float32(0.5)}

    stage.run_once(work)
    again = Stage.open(tmp_path, "collect", Config())
    assert again.done and again.summary() == {"interactions": 7, "mean": 0.5}
    assert again.checkpoints().steps() == []
    assert sorted(p.name for p in stage.directory.iterdir()) == [
        *("config.json", "done.json", "made.json"),
    ]
    assert not Stage.open(tmp_path, "collect", Other()).done


def test_a_corrupt_done_is_not_done(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    stage.finish({"loss": 1.0})
    truncate(stage.path("done.json"))
    assert not stage.done


def test_a_stage_resumed_elsewhere_warns(tmp_path: Path, monkeypatch, capfd) -> None:
    stage = Stage.open(tmp_path, "fit", {})

    def dies() -> dict[str, int]:
        stage.checkpoints().save(1, {"a": 1})
        raise Killed

    for _ in range(2):
        with pytest.raises(Killed):
            stage.run_once(dies)
    assert "warning" not in capfd.readouterr().err
    here = environment()
    monkeypatch.setattr(store, "environment", lambda: {**here, "hardware": "another"})
    stage.run_once(lambda: {})
    assert "bits may differ" in capfd.readouterr().err
    assert [session["hardware"] for session in stage.made] == [here["hardware"]] * 2 + ["another"]


def test_a_stage_says_who_made_it_and_how_long_it_took(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("sys.argv", ["run me", "--seed", "1"])
    stage = Stage.open(tmp_path, "fit", {})
    stage.run_once(lambda: time.sleep(0.2) or {})
    (session,) = stage.made
    assert session["command"].endswith("--seed 1")
    assert {name: session[name] for name in environment()} == environment()
    assert 0.2 <= session["seconds"] < 5
    assert abs(session["start"] - time.time()) < 60


def test_the_time_of_a_stage_is_without_that_of_stages_inside(tmp_path: Path) -> None:
    test, fit = (Stage.open(tmp_path, name, {}) for name in ("test", "fit"))

    def work() -> dict[str, Any]:
        fit.run_once(lambda: time.sleep(1.0) or {})
        time.sleep(0.3)
        return {}

    test.run_once(work)
    assert 1.0 <= fit.made[0]["seconds"] < 1.3 and 0.3 <= test.made[0]["seconds"] < 0.6


OLD, NEW = {"genidm.paper.fit": "aaaa"}, {"genidm.paper.fit": "bbbb"}


def test_a_stage_of_other_code_is_made_anew_and_said(tmp_path: Path, capfd) -> None:
    old = Stage.open(tmp_path, "LR-0", {"k": 10}, OLD)
    old.run_once(lambda: {"by": "old"})
    assert Stage.open(tmp_path, "LR-0", {"k": 10}, OLD) == old
    assert capfd.readouterr().err == ""
    new = Stage.open(tmp_path, "LR-0", {"k": 10}, NEW)
    said = capfd.readouterr().err
    assert new != old and not new.done
    assert f"{old.directory} was made by other code (genidm.paper.fit)" in said
    assert Stage.open(tmp_path, "LR-0", {"k": 11}, NEW).directory not in (old, new)
    assert capfd.readouterr().err == "", "another config is another stage, and no news"
    new.run_once(lambda: {"by": "new"})
    assert old.summary() == {"by": "old"}


def test_a_stage_of_other_code_is_used_where_the_user_says_so(tmp_path: Path, capfd) -> None:
    old = Stage.open(tmp_path, "LR-0", {"k": 10}, OLD)
    half = Stage.open(tmp_path, "LR-0", {"k": 10}, NEW, reuse=True)
    assert half != old, "one that is not finished is not used"
    old.run_once(lambda: {"by": "old"})
    assert Stage.open(tmp_path, "LR-0", {"k": 10}, NEW, reuse=True) == old
    assert "warning" in (said := capfd.readouterr().err) and "it is used" in said
    half.run_once(lambda: {"by": "new"})
    assert Stage.open(tmp_path, "LR-0", {"k": 10}, NEW, reuse=True) == half


def test_a_checkpoint_of_other_code_is_not_gone_on_from(tmp_path: Path) -> None:
    Stage.open(tmp_path, "LR-0", {}, OLD).checkpoints().save(1, {"a": 1})
    assert Stage.open(tmp_path, "LR-0", {}, NEW).checkpoints().steps() == []
    assert Stage.open(tmp_path, "LR-0", {}, OLD).checkpoints().steps() == [1]


def test_work_is_done_once_and_its_checkpoints_go(tmp_path: Path) -> None:
    stage, calls = Stage.open(tmp_path, "fit", {}), []

    def work() -> dict[str, int]:
        stage.checkpoints().save(1, {"a": 1})
        calls.append(stage.done)
        return {"n": 7}

    stage.run_once(work)
    stage.run_once(work)
    assert calls == [False] and stage.summary() == {"n": 7}
    assert stage.checkpoints().steps() == []


def test_work_that_fails_is_not_done_and_can_be_done_again(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    with pytest.raises(ZeroDivisionError):
        stage.run_once(lambda: {"n": 1 // 0})
    assert not stage.done
    stage.run_once(lambda: {"n": 1})
    assert stage.done


HOLDS = """
import sys, time
from genidm.provenance import environment
from genidm.store import Stage
def work():
    print("at work", flush=True)
    sys.stdin.readline()
    return {"by": "the other"}
Stage.open(sys.argv[1], "fit", {}).run_once(work)
"""


@pytest.fixture
def other(tmp_path: Path) -> Iterator[subprocess.Popen]:
    """A process in the middle of a stage; it ends the stage when it is told a line."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout and process.stdout.readline() == b"at work\n"
        yield process
        process.kill()


def test_a_stage_that_another_process_does_is_waited_for(tmp_path: Path, other, capfd) -> None:
    stage, calls = Stage.open(tmp_path, "fit", {}), []
    waiting = threading.Thread(target=stage.run_once, args=[lambda: calls.append(1) or {}])
    waiting.start()
    waiting.join(1)
    assert waiting.is_alive() and not calls
    assert f"waiting for another process that works in {stage.directory}" in capfd.readouterr().err
    other.communicate(b"end\n")
    waiting.join(20)
    assert not waiting.is_alive() and not calls
    assert stage.summary() == {"by": "the other"}


def test_a_stage_whose_process_was_killed_is_free(tmp_path: Path, other) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    other.kill()
    other.wait()
    stage.run_once(lambda: {"by": "this"})
    assert stage.summary() == {"by": "this"}


def test_without_locks_work_is_done_all_the_same(tmp_path: Path, monkeypatch) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks here")

    monkeypatch.setattr(fcntl, "flock", none)
    stage = Stage.open(tmp_path, "fit", {})
    stage.run_once(lambda: {"n": 1})
    assert stage.done


def test_what_is_corrupt_in_a_stage_says_which_directory_to_delete(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    files.save_arrays(stage.path("controller"), {"a": np.ones(3)}, {})
    assert stage.read(files.load_arrays, "controller", True)[1] == {}
    (stage.path("controller") / "a.npy").write_bytes(b"")
    for name in ("controller", "policy"):
        with pytest.raises(Corrupt, match=rf"{name}.* Delete {stage.directory} to make it anew$"):
            stage.read(files.load_arrays, name)

    def said_already(path: Path) -> None:
        raise Corrupt(f"{path} lacks a chunk. Delete {stage.directory} to make it anew")

    with pytest.raises(Corrupt) as corrupt:
        stage.read(said_already, "experience")
    assert str(corrupt.value).count("Delete") == 1
