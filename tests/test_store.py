"""A stage is found again, and knows whether it is done."""

from __future__ import annotations

from pathlib import Path

import numpy as np
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
