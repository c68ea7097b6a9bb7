"""The command for a GPU, on a robot that costs nothing: what it writes, when it stops, failures."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

import jax
import pytest
from point import Point
from tiny import AGENTS, TEST, tiny

from experiments.gpu import __main__ as command
from experiments.gpu import cells, children, jobs, speeds
from experiments.gpu.children import Ended
from experiments.gpu.results import Results
from genidm import robots
from genidm.agents.random import RandomActions
from genidm.paper import methods
from genidm.runs import cell as cell_module
from genidm.runs import fitting
from genidm.runs.command import run_cli

CALL = {"minutes": 1, "environment": {"versions": {}, "hardware": "a machine", "commit": None}}


def reported(this, scenarios, options, own=()) -> Path:
    """Stands for a report, whose figures take longer than all else."""
    place = this.root / f"report-{this.scale.name}"
    place.mkdir(exist_ok=True)
    (place / "table.txt").write_text("the table")
    return place


@pytest.fixture(autouse=True)
def small(monkeypatch) -> None:
    """Sizes at which every part takes a moment."""
    record = dict(agent=AGENTS[RandomActions])
    column = tuple(tiny(m, **record) for m in (methods.LR, methods.HF))
    monkeypatch.setitem(methods.TABLES, "point", column)
    monkeypatch.setitem(robots.ROBOTS, "point", Point)
    monkeypatch.setattr(cells, "INTERACTIONS", 512)
    monkeypatch.setattr(cells, "TEST", TEST)
    for module in (cell_module, jobs):
        monkeypatch.setattr(module, "write_report", reported)
    monkeypatch.setattr(speeds, "FEW_LANES", (4, 8))
    monkeypatch.setattr(speeds, "STEPS", 2)
    monkeypatch.setattr(speeds, "SECONDS", 0.0)


@pytest.fixture
def results(tmp_path: Path) -> Results:
    results = Results(tmp_path)
    results.begin("a machine", CALL)
    return results


# ── children ────────────────────────────────────────────────────────────────────────────────


def python(code: str, seconds: float) -> Ended:
    return children.run([sys.executable, "-c", code], seconds)


def test_a_child_is_stopped_when_its_time_is_over(monkeypatch) -> None:
    monkeypatch.setattr(children, "GRACE", 0.5)
    deaf = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)"
    for code in ("import subprocess; subprocess.run(['sleep', '60'])", f"{deaf}; input; {SLEEP}"):
        began = time.monotonic()
        assert python(f"print('hello', flush=True); {code}", 1.0) == (None, "hello")
        assert time.monotonic() - began < 5.0


SLEEP = "import time; time.sleep(60)"


def test_a_childs_last_words_are_kept_without_its_bars() -> None:
    bars = "print('a\\rfit: 10%|█  | 1/10\\rfit: 100%|██| 10/10\\nb')"
    assert python(f"{bars}; raise SystemExit(3)", 60.0) == (3, "a\nb")
    killed = python("import os; os.kill(os.getpid(), 9)", 60.0)
    assert killed.status == -9


def test_a_child_ends_itself_where_nobody_stops_it() -> None:
    code = f"from experiments.gpu import children; children.end_after(0.1); {SLEEP}"
    assert python(code, 60.0).status is None


# ── results ─────────────────────────────────────────────────────────────────────────────────


def test_a_row_is_on_the_disk_at_once_and_takes_an_older_ones_place(results: Results) -> None:
    names = dict(robot="point", what="step", engine="mjx", lanes=8)
    for rate in (100.0, 200.0):
        row = dict(steps_per_second=rate, spread=[1, 2], calls=3, compiling=4.0)
        results.put("speeds", names | row | {"peak_bytes": None})
        (written,) = json.loads(results.path.read_text())["machines"]["a machine"]["speeds"]
        assert written["steps_per_second"] == rate
        assert f"| {rate:.0f} |" in results.path.with_suffix(".md").read_text()
    assert results.current("speeds", names) and not results.current("speeds", names | {"lanes": 9})
    results.begin("a machine", CALL | {"environment": CALL["environment"] | {"versions": {"a": 1}}})
    assert results.find("speeds", names) and not results.current("speeds", names)
    results.begin("another", CALL)
    assert not results.rows("speeds") and "a machine" in results.path.read_text()


# ── speeds ──────────────────────────────────────────────────────────────────────────────────


def measured(seconds: float = 60.0, known=lambda names: None) -> tuple[bool, list[dict]]:
    rows: list[dict] = []
    return speeds.Measuring(Point(), "its own", seconds, known, rows.append).run(), rows


def test_speeds_are_measured_from_few_lanes_to_many() -> None:
    complete, rows = measured()
    assert complete
    assert [(r["what"], r["lanes"]) for r in rows] == [
        (what, lanes) for lanes in (4, 8) for what in ("step", "𝒢", "test")
    ]
    assert all(r["spread"][0] <= r["steps_per_second"] <= r["spread"][1] for r in rows)
    again, nothing = measured(known=lambda names: rows[0])
    assert again and not nothing


def test_lanes_that_fail_are_said_and_more_are_not_tried(monkeypatch) -> None:
    def full(robot, lanes):
        raise RuntimeError("RESOURCE_EXHAUSTED: out of memory\nand a long dump")

    monkeypatch.setattr(speeds, "PROBES", {"step": speeds.stepping, "full": full})
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")  # compiled side by side
    complete, rows = measured()
    assert complete and [(r["what"], r["lanes"]) for r in rows] == [
        ("step", 4), ("full", 4), ("step", 8),
    ]  # fmt: skip
    assert rows[1]["error"] == "RuntimeError: RESOURCE_EXHAUSTED: out of memory"


def test_what_would_take_too_long_is_left_out(monkeypatch) -> None:
    monkeypatch.setattr(speeds, "PROBES", {"step": speeds.stepping})
    complete, rows = measured(seconds=0.01)
    assert not complete and [r["lanes"] for r in rows] == [4]


# ── the command ─────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def started(monkeypatch) -> Counter:
    """Parts are done in this process; how often each was started."""
    parts: Counter = Counter()
    monkeypatch.setattr(speeds, "PROBES", {"step": speeds.stepping})

    def start(job: jobs.Job, seconds: float) -> Ended:
        parts[" ".join(filter(None, (job.part, job.method)))] += 1
        try:
            jobs.PARTS[job.part](dataclasses.replace(job, seconds=seconds))
        except Exception:
            return Ended(1, traceback.format_exc())
        return Ended(0, "")

    monkeypatch.setattr(jobs, "start", start)
    return parts


def run(monkeypatch, tmp_path: Path, *flags: str) -> int:
    """The exit status of `python -m experiments.gpu`."""
    places = ("--results-dir", str(tmp_path / "results"), "--run-dir", str(tmp_path / "runs"))
    monkeypatch.setattr(
        sys, "argv", ["gpu", *places, "--robots", "point", "--scale", "0.25", *flags]
    )
    try:
        run_cli(command.gpu, "")
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def section(tmp_path: Path) -> dict:
    data = json.loads((tmp_path / "results" / "gpu.json").read_text())
    return data["machines"][data["now"]]


def test_a_call_tries_measures_and_runs_cells_once(monkeypatch, tmp_path, started, capsys) -> None:
    assert run(monkeypatch, tmp_path, "--methods", "LR") == 0
    once = {"look": 1, "trial": 1, "speeds": 1, "cell LR": 1, "report LR": 1}
    assert started == once
    found = section(tmp_path)
    assert {k: len(found[k]) for k in ("trials", "speeds", "stages", "cells")} == {
        "trials": 1, "speeds": 2, "stages": 4, "cells": 1,
    }  # fmt: skip
    assert all(row["done"] for row in found["stages"])
    assert found["calls"][0]["ended"] == "done: point LR"
    out = capsys.readouterr().out
    assert "| point | LR | its own | 0.25 |" in out and "again to resume" in out
    assert (tmp_path / "runs" / "point" / "report-0.25" / "table.txt").exists()
    assert run(monkeypatch, tmp_path, "--methods", "LR") == 0
    assert started == once | {"look": 2}


def test_a_cell_that_fails_is_written_down_and_the_rest_goes_on(
    monkeypatch, tmp_path, started
) -> None:
    with monkeypatch.context() as m:
        m.setattr(cells, "run_method", lambda *args: 1 / 0)
        m.setattr(fitting, "replay", lambda *args: 1 / 0)
        assert run(m, tmp_path, "--methods", "LR", "HF") == 1
    found = section(tmp_path)
    assert [(x["part"], x["method"]) for x in found["failures"]] == [
        ("trial", None),
        ("cell", "LR"),
    ]
    assert "ZeroDivisionError" in found["failures"][0]["why"]
    assert len(found["speeds"]) == 2 and [x["method"] for x in found["cells"]] == ["HF"]
    assert found["calls"][0]["ended"] == "done: point HF; point LR is 𝒢"
    assert "ZeroDivisionError" in (tmp_path / "results" / "gpu.md").read_text()
    monkeypatch.setattr(cells, "run_method", lambda *args: tmp_path)
    (tmp_path / "table.txt").write_text("the table")
    assert run(monkeypatch, tmp_path, "--methods", "LR", "HF") == 0
    found = section(tmp_path)
    assert not found["failures"] and len(found["trials"]) == 1 and len(found["cells"]) == 2


def test_a_call_stops_at_its_time_limit_and_says_how_far_it_is(
    monkeypatch, tmp_path, started, capsys
) -> None:
    inside = jobs.start

    def start(job: jobs.Job, seconds: float) -> Ended:
        if job.part != "cell":
            return inside(job, seconds) if job.part == "look" else Ended(0, "")
        stage = tmp_path / "runs" / "point" / "experience-0"
        stage.mkdir(parents=True)
        (stage / "metrics.jsonl").write_text('{"step": 512}\n')
        row = dict(robot="point", stage="experience-0", method="LR", part="collecting")
        job.results.put("stages", row | {"done": False, "seconds": 5.0, "began": time.time()})
        return python(SLEEP, seconds)

    monkeypatch.setattr(jobs, "start", start)
    monkeypatch.setattr(command, "LEAST", 0.5)
    monkeypatch.setattr(children, "GRACE", 0.5)
    began = time.monotonic()
    assert run(monkeypatch, tmp_path, "--minutes", "0.05", "--methods", "LR", "HF") == 0
    assert time.monotonic() - began < 3.0 + 5.0
    (row,) = section(tmp_path)["stages"]
    assert row["step"] == 512 and 6.0 < row["seconds"] < 9.0 and "began" not in row
    said = capsys.readouterr()
    assert "point LR is collecting at step 512. Run the same command again" in said.out
    assert "point HF cell on its own: no time is left for it" in said.err


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--minutes", "0"), "minutes"),
        (("--engine", "bullets"), "'bullets'; there are: mjx"),
        (("--robots", "cow"), "'cow'"),
    ],
)
def test_bad_input_ends_in_a_sentence(monkeypatch, tmp_path, capsys, flags, why) -> None:
    assert run(monkeypatch, tmp_path, *flags) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and why in said
    assert not list(tmp_path.iterdir())


def test_a_machine_where_jax_does_not_start_ends_the_call(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(jobs, "start", lambda *args: Ended(1, "no CUDA"))
    assert run(monkeypatch, tmp_path) == 2
    assert "jax does not start here, or takes too long:\nno CUDA" in capsys.readouterr().err


def test_a_job_in_a_process_of_its_own(tmp_path: Path) -> None:
    job = jobs.Job("look", str(tmp_path), str(tmp_path))
    assert jobs.start(job, 120.0).status == 0
    assert Results(tmp_path).call["platform"] == "cpu"
