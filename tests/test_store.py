"""A stage is found again, and knows whether it is done."""

from __future__ import annotations

import errno
import fcntl
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bits import truncate
from test_config import Config, Other

from genidm import store
from genidm.config import digest, environment, plain
from genidm.files import load_json
from genidm.store import Stage


def test_a_stage_is_found_again_and_knows_whether_it_is_done(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "collect", Config())
    assert stage.directory == tmp_path / f"collect-{digest(Config())}"
    config = load_json(stage.path("config.json"))
    assert config["config"] == plain(Config())
    assert config["environment"] == environment()
    assert not stage.done
    stage.checkpoints().save(3, {"a": 1})
    assert Stage.open(tmp_path, "collect", Config()).checkpoints().steps() == [3]
    stage.finish({"interactions": np.int64(7), "mean": np.float32(0.5)})
    stage.clear_checkpoints()
    again = Stage.open(tmp_path, "collect", Config())
    assert again.done and again.summary() == {"interactions": 7, "mean": 0.5}
    assert again.checkpoints().steps() == []
    assert sorted(p.name for p in stage.directory.iterdir()) == ["config.json", "done.json"]
    assert not Stage.open(tmp_path, "collect", Other()).done


def test_a_torn_done_is_not_done(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    stage.finish({"loss": 1.0})
    truncate(stage.path("done.json"))
    assert not stage.done


def test_a_stage_resumed_elsewhere_warns(tmp_path: Path, monkeypatch, capfd) -> None:
    here = environment()
    stage = Stage.open(tmp_path, "fit", {})
    stage.checkpoints().save(1, {"a": 1})
    Stage.open(tmp_path, "fit", {})
    assert "warning" not in capfd.readouterr().err
    monkeypatch.setattr(store, "environment", lambda: {**here, "hardware": "another"})
    Stage.open(tmp_path, "fit", {})
    assert "bits may differ" in capfd.readouterr().err
    stage.finish({})
    Stage.open(tmp_path, "fit", {})
    assert "warning" not in capfd.readouterr().err


def test_work_is_done_once_and_its_checkpoints_go(tmp_path: Path) -> None:
    stage, calls = Stage.open(tmp_path, "fit", {}), []

    def work() -> dict[str, int]:
        stage.checkpoints().save(1, {"a": 1})
        calls.append(stage.done)
        return {"n": 7}

    stage.once(work)
    stage.once(work)
    assert calls == [False] and stage.summary() == {"n": 7}
    assert stage.checkpoints().steps() == []


def test_work_that_fails_is_not_done_and_can_be_done_again(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    with pytest.raises(ZeroDivisionError):
        stage.once(lambda: {"n": 1 // 0})
    assert not stage.done
    stage.once(lambda: {"n": 1})
    assert stage.done


HOLDS = """
import sys, time
from genidm.store import Stage
def work():
    print("at work", flush=True)
    sys.stdin.readline()
    return {"by": "the other"}
Stage.open(sys.argv[1], "fit", {}).once(work)
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
    waiting = threading.Thread(target=stage.once, args=[lambda: calls.append(1) or {}])
    waiting.start()
    waiting.join(1)
    assert waiting.is_alive() and not calls
    assert f"waiting for another process, at work in {stage.directory}" in capfd.readouterr().err
    other.communicate(b"end\n")
    waiting.join(20)
    assert not waiting.is_alive() and not calls
    assert stage.summary() == {"by": "the other"}


def test_a_stage_whose_process_was_killed_is_free(tmp_path: Path, other) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    other.kill()
    other.wait()
    stage.once(lambda: {"by": "this"})
    assert stage.summary() == {"by": "this"}


def test_without_locks_work_is_done_all_the_same(tmp_path: Path, monkeypatch) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks here")

    monkeypatch.setattr(fcntl, "flock", none)
    stage = Stage.open(tmp_path, "fit", {})
    stage.once(lambda: {"n": 1})
    assert stage.done
