"""Curves have every point once, whatever happened to the run."""

from __future__ import annotations

import errno
import json
import os
import re
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.event_file_writer import EventsWriter

from genidm import progress
from genidm.errors import BadInput
from genidm.progress import Progress, compile_ahead, read_metrics


def events(directory: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard would show: (step, value) by tag."""
    from tensorboardX.proto.event_pb2 import Event

    curves: dict[str, list[tuple[int, float]]] = {}
    for file in sorted(directory.glob("events.out.tfevents.*")):
        data = file.read_bytes()
        while data:  # TFRecord: length, its crc, the record, its crc
            size = int.from_bytes(data[:8], "little")
            event = Event.FromString(data[12 : 12 + size])
            for value in event.summary.value:
                curves.setdefault(value.tag, []).append((event.step, value.simple_value))
            data = data[16 + size :]
    return curves


def points(directory: Path) -> list[tuple[int, float]]:
    return [(line["step"], line["loss"]) for line in read_metrics(directory / "metrics.jsonl")]


def test_metrics_go_to_jsonl_and_tensorboard(tmp_path: Path) -> None:
    before = time.time()
    with Progress("fit", 30, "updates", tmp_path / "new", quiet=True) as bar:
        bar.advance(10, loss=jnp.float32(0.5), n=np.int64(3))
        bar.advance(10)
        bar.advance(10, loss=0.25, n=4)
        assert bar.done == 30
    first, second = read_metrics(tmp_path / "new" / "metrics.jsonl")
    assert before - 1 < first.pop("time") <= second.pop("time") < time.time() + 1
    assert first == {"step": 10, "loss": 0.5, "n": 3}
    assert second == {"step": 30, "loss": 0.25, "n": 4}
    shown = events(tmp_path / "new")
    assert shown == {"loss": [(10, 0.5), (30, 0.25)], "n": [(10, 3.0), (30, 4.0)]}


def test_what_is_not_finite_is_null(tmp_path: Path) -> None:
    with Progress("fit", 2, "updates", tmp_path, quiet=True) as bar:
        bar.advance(1, loss=jnp.nan, reward=1.0)
        bar.advance(1, loss=-np.inf, reward=2.0)
    for text in (tmp_path / "metrics.jsonl").read_text().splitlines():
        line = json.loads(text, parse_constant=pytest.fail)
        assert line["loss"] is None and line["reward"]
    assert set(events(tmp_path)) == {"reward"}


def test_a_resume_leaves_no_doubled_part(tmp_path: Path) -> None:
    with Progress("fit", 50, "updates", tmp_path, quiet=True) as bar:
        for step in range(5):
            bar.advance(10, loss=float(step))
    with (tmp_path / "metrics.jsonl").open("a") as f:
        f.write('{"step": 60, "lo')  # killed while writing
    for old in tmp_path.glob("events.*"):  # its name is that of an earlier second
        old.rename(tmp_path / "events.out.tfevents.1.host")
    with Progress("fit", 50, "updates", tmp_path, initial=30, quiet=True) as bar:
        assert bar.done == 30
        bar.advance(10, loss=-1.0)
    expected = [(10, 0.0), (20, 1.0), (30, 2.0), (40, -1.0)]
    assert points(tmp_path) == expected
    assert events(tmp_path)["loss"] == expected
    with Progress("fit", 50, "updates", tmp_path, quiet=True) as bar:
        bar.advance(10, loss=7.0)
    assert points(tmp_path) == events(tmp_path)["loss"] == [(10, 7.0)]


def test_lines_are_there_before_the_end(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(progress, "FLUSH_SECONDS", -1.0)
    with Progress("fit", 2, "updates", tmp_path, quiet=True) as bar:
        bar.advance(1, loss=1.0)
        assert points(tmp_path) == events(tmp_path)["loss"] == [(1, 1.0)]


def test_corrupt_metrics(tmp_path: Path) -> None:
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 1, "loss": 1}\n{"step": 2, "lo')
    assert read_metrics(file) == [{"step": 1, "loss": 1}]
    file.write_text('{"step": 1, "lo\n{"step": 2, "loss": 1}\n')
    with pytest.raises(BadInput, match="corrupt in line 1"):
        read_metrics(file)
    with pytest.raises(BadInput, match="cannot use"):
        read_metrics(tmp_path / "nowhere.jsonl")


def test_a_full_disk_is_said(tmp_path: Path, monkeypatch) -> None:
    def full_disk(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with Progress("fit", 2, "updates", tmp_path, quiet=True) as bar:
        bar.advance(1, loss=1.0)
        monkeypatch.setattr(EventsWriter, "write_event", full_disk)
        with pytest.raises(BadInput, match="no space left"):
            bar.advance(1, loss=2.0)
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(BadInput, match="no space left"):
        Progress("fit", 2, "updates", tmp_path, initial=1, quiet=True)
    monkeypatch.undo()
    assert points(tmp_path)[0] == (1, 1.0)


def test_the_bar_shows_rate_and_time_left(capfd) -> None:
    with Progress("collect", 4000, "steps", initial=1000) as bar:
        time.sleep(0.05)
        bar.advance(1000, reward=1.23456)
    out, err = capfd.readouterr()
    assert out == ""
    line = err.rstrip("\n").split("\r")[-1]
    assert "collect:  50%" in line and "2.00k/4.00k" in line and "reward=1.23" in line
    assert re.search(r"\d\d:\d\d<\d\d:\d\d, *[\d.]+k? steps/s", line)


def test_quiet_is_quiet(capfd) -> None:
    with Progress("collect", 10, "steps", quiet=True) as bar:
        bar.advance(10, reward=1.0)
    assert capfd.readouterr() == ("", "")


def test_an_error_goes_through_and_closes_the_files(tmp_path: Path) -> None:
    def fail() -> None:
        with Progress("fit", 2, "updates", tmp_path, quiet=True) as bar:
            bar.advance(1, loss=1.0)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert events(tmp_path)["loss"] == [(1, 1.0)]


def test_compiling_is_timed_apart(capfd) -> None:
    traces = []

    def double(x: jax.Array) -> jax.Array:
        traces.append(x)
        return 2 * x

    program = compile_ahead("doubling", jax.jit(double), jnp.ones(3))
    assert re.search(r"doubling: program ready in \d+(\.\d)? s\n", capfd.readouterr().err)
    np.testing.assert_array_equal(program(jnp.arange(3.0)), [0, 2, 4])
    assert len(traces) == 1
    with pytest.raises(TypeError):
        program(jnp.ones(4))
