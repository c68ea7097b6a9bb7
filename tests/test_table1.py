"""The whole table: its rows and training seeds, what a failure or a kill costs, its report."""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from killing import Killed, dies_at
from point import Point
from small_cells import counted
from tiny import AGENTS, TEST, tiny

from experiments import table1
from experiments.table1 import Table, chosen, grouped, run, work
from genidm import files, robots
from genidm.agents.random import RandomActions
from genidm.errors import BadInput
from genidm.evaluation.scenarios import scenarios
from genidm.paper import methods
from genidm.progress import Progress
from genidm.report import shown
from genidm.report.runs import Tested
from genidm.runs import cell as cell_module
from genidm.runs import run as run_module
from genidm.runs.cell import make_run, scenarios_of
from genidm.runs.command import run_cli
from genidm.tasks import WalkForward

# One record for all that learn from one, and one policy.
RECORD = dict(agent=AGENTS[RandomActions], task=WalkForward(episode_steps=20))
METHODS = [
    *(tiny(m, **RECORD) for m in (methods.HF, methods.LR, methods.RS)),
    tiny(methods.VGCP),
]


def options(out: Path, **changes) -> Table:
    this = Table(
        scale="0.25",
        run_dir=out / "runs",
        episodes=2,
        seeds=2,
        episodes_per_extra_seed=1,
        test=TEST,
    )
    return dataclasses.replace(this, **{"report_dir": out / "results", **changes})


@pytest.fixture(scope="module", autouse=True)
def one_bank() -> Iterator[None]:
    """Scenarios are drawn once for all cells: they see the robot and two numbers alone."""
    with pytest.MonkeyPatch.context() as m:
        draw = functools.cache(lambda *numbers: scenarios(Point(), *numbers))
        m.setattr(cell_module, "scenarios", lambda robot, *numbers: draw(*numbers))
        m.setitem(robots.ROBOTS, "point", Point)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("table")
    report, failures = run(Point(), METHODS, options(out))
    assert report == out / "runs" / "point" / "report-0.25" and not failures
    return out


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    return shutil.copytree(finished, tmp_path / "copy")


def results(out: Path) -> dict:
    return json.loads((out / "results" / "point_0.25.json").read_text())


def without_made(results: dict) -> dict:
    """Results without how often and how long was worked on them."""
    methods = {
        n: {k: x for k, x in m.items() if k != "made"} for n, m in results["methods"].items()
    }
    return results | {"methods": methods}


def stages(out: Path, glob: str) -> list[Path]:
    return sorted(path.parent for path in (out / "runs" / "point").glob(f"{glob}/done.json"))


# ── what is run ─────────────────────────────────────────────────────────────────────────────


def test_table1_has_the_papers_seven_methods_and_its_rows_two_more() -> None:
    paper = ("RS", "RL", "VGCP", "HER_SP", "HER_DE", "GE", "LR")
    for column in methods.TABLES.values():
        assert tuple(m.name for m in column) == (*paper, *methods.EXTRA) == methods.ORDER
    assert Table().methods == methods.ORDER


def test_methods_are_chosen_by_name() -> None:
    assert chosen(Table()) == list(methods.ANT)
    assert chosen(Table(robot="humanoid")) == list(methods.HUMANOID)
    assert chosen(Table(include_hf=False)) == list(methods.ANT[:-2])
    assert chosen(Table(methods=("LR", "RS", "LR"))) == [methods.LR, methods.RS]
    with pytest.raises(BadInput, match="'XX'; there are: RS"):
        chosen(Table(methods=("RS", "XX")))
    with pytest.raises(BadInput, match="no method to run"):
        chosen(Table(methods=("HF",), include_hf=False))


def test_methods_with_one_experience_follow_each_other() -> None:
    order = [m.name for m in grouped(methods.ANT)]
    assert order == ["RS", "RL", "GE", "LR", "HF", "AGENT", "VGCP", "HER_SP", "HER_DE"]


def test_the_later_seeds_are_tested_on_the_beginning_of_the_bank(tmp_path: Path) -> None:
    todo = work(Point(), METHODS, options(tmp_path, seed=3, seeds=3))
    assert [item.run.seed for item in todo] == [3] * 4 + [4] * 4 + [5] * 4
    assert [item.scenarios.shape for item in todo] == [(10, 2)] * 4 + [(10, 1)] * 8
    whole, part = todo[0].scenarios, todo[-1].scenarios
    assert np.array_equal(whole.target[:, :1], part.target)
    all_alike = work(Point(), METHODS, options(tmp_path, episodes_per_extra_seed=7))
    assert {item.scenarios.shape for item in all_alike} == {(10, 2)}


def test_papers_settings_are_for_the_methods_that_fit(tmp_path: Path) -> None:
    todo = work(Point(), METHODS, options(tmp_path, seeds=1, paper_settings=True))
    names = [item.run.method.name for item in todo]
    assert sorted(names) == ["HF paper", "LR paper", "RS paper", "VGCP"]


def test_every_method_with_every_seed_has_been_tested_once(finished: Path) -> None:
    tests = Counter(path.name.split("-")[1] for path in stages(finished, "test-*"))
    assert tests == dict.fromkeys(("RS", "VGCP", "LR", "HF"), 2)
    assert len(stages(finished, "experience-*")) == 2, "one a seed, shared by three methods"


def test_what_is_done_is_not_done_again(copy: Path) -> None:
    def written() -> dict[Path, int]:
        paths = (p for p in copy.rglob("*") if p.is_file() and "report" not in str(p))
        return {p: p.stat().st_mtime_ns for p in paths}

    before = written()
    with counted() as calls, pytest.MonkeyPatch.context() as m:
        m.setattr(table1, "write_report", lambda this, tested_scenarios, options, own: copy)
        run(Point(), METHODS, options(copy))
    assert not calls
    assert written() == before


def test_a_whole_test_of_a_later_seed_stands_whoever_made_it(copy: Path) -> None:
    """A lone command tests on all scenarios; the table then asks for no other test."""
    alone = make_run(Point(), METHODS[2], options(copy, seed=1))
    whole = alone.run_test(scenarios_of(alone, options(copy)))
    with counted() as calls:
        run(Point(), METHODS, options(copy))
    assert not calls
    over = results(copy)["methods"]["RS"]["training_seeds"]
    assert over["episodes"] == [[10, 2], [10, 2]]
    assert over["means"][1] == pytest.approx(Tested(whole.directory, {}).episodes.closest.mean())


def test_a_commands_own_test_is_its_row(copy: Path) -> None:
    """A, then B of the same name, then A again: the row is A's."""
    a, b = METHODS[2], dataclasses.replace(METHODS[2], goal_horizon=2)
    rows = {}
    for name, method in (("a", a), ("b", b), ("a again", a)):
        run(Point(), [method], options(copy, seeds=1))
        rows[name] = results(copy)["methods"]["RS"]
    assert rows["a"]["settings"]["goal_horizon"] != rows["b"]["settings"]["goal_horizon"] == 2
    assert rows["a again"] == rows["a"]


# ── the table ───────────────────────────────────────────────────────────────────────────────


def test_one_table_and_one_json_hold_all(finished: Path) -> None:
    r = results(finished)
    assert list(r["methods"]) == ["RS", "VGCP", "LR", "HF"]
    assert r["scenarios"] == scenarios(Point(), 10, 2).digest()
    assert list(r["paired"]) == ["VGCP-RS", "LR-VGCP", "HF-LR", "LR-RS"]
    report = finished / "runs" / "point" / "report-0.25"
    assert (report / "results.json").read_bytes() == (
        finished / "results" / "point_0.25.json"
    ).read_bytes()
    for directory, prefix in ((report, ""), (finished / "results", "point_0.25_")):
        drawn = {path.name.removeprefix(prefix) for path in directory.glob("*.png")}
        assert {"invariance.png", "learning.png", "fitting.png", "violins.png"} < drawn
        last = (directory / f"{prefix}table.txt").read_text().splitlines()[-1]
        assert sorted(last.partition(": ")[2].split(", ")) == sorted(
            path.name for path in directory.glob("*.png")
        )


def test_the_training_seeds_stand_beside(finished: Path) -> None:
    for method in results(finished)["methods"].values():
        over = method["training_seeds"]
        assert method["training_seed"] == 0
        assert (over["seeds"], over["episodes"]) == ([0, 1], [[10, 2], [10, 1]])
        assert over["means"][0] == method["mean"] != over["means"][1]
    text = (finished / "results" / "point_0.25_table.txt").read_text()
    assert "Every column except “over seeds” uses training seed 0" in text
    assert "“Over seeds” uses 2 training seeds" in text
    assert "seeds after the first: 10 × 1 test episodes" in text.replace("\n", " ")


def test_invariance_is_measured_on_one_record_for_all(finished: Path) -> None:
    found = {name: m["invariance"] for name, m in results(finished)["methods"].items()}
    assert found.keys() == {"RS", "VGCP", "LR", "HF"}
    assert found["HF"] < 1e-5 < 1e-2 < min(found[n] for n in ("RS", "VGCP", "LR"))


def test_a_report_reads_and_computes_once_for_both_places(copy: Path, monkeypatch) -> None:
    read, made = Counter(), Counter()
    load, angles = files.load_arrays, shown.angles
    monkeypatch.setattr(files, "load_arrays", lambda p, **k: (read.update([p]), load(p, **k))[1])
    monkeypatch.setattr(shown, "angles", lambda *a: (made.update("a"), angles(*a))[1])
    shutil.rmtree(copy / "results")
    run(Point(), METHODS, options(copy))
    assert (copy / "results" / "point_0.25_paths.png").exists()
    assert made.total() == 1
    assert {n for path, n in read.items() if path.name == "episodes"} == {1}


def test_without_a_record_there_is_no_figure_of_invariance(copy: Path) -> None:
    for stage in stages(copy, "experience-*"):
        shutil.rmtree(stage)
    shutil.rmtree(copy / "runs" / "point" / "report-0.25")
    report, failures = run(Point(), METHODS, options(copy, seeds=1, report_dir=None))
    assert report and not failures
    names = {path.name for path in report.glob("*.png")}
    assert not names & {"invariance.png", "collecting.png"} and "paths.png" in names
    assert "there is no record" in (report / "table.txt").read_text()
    found = json.loads((report / "results.json").read_text())["methods"]
    assert not any("invariance" in method for method in found.values())


# ── failures and kills ──────────────────────────────────────────────────────────────────────


@pytest.fixture
def failing(monkeypatch) -> dict[str, Exception]:
    """Method → what its cells fail with."""
    wrong: dict[str, Exception] = {}
    episodes = run_module.Run.run_test

    def failing(self, *args):
        if self.method.name in wrong:
            raise wrong[self.method.name]
        return episodes(self, *args)

    monkeypatch.setattr(run_module.Run, "run_test", failing)
    return wrong


def test_a_method_that_fails_does_not_stop_the_others(copy: Path, failing, capsys) -> None:
    for stage in stages(copy, "test-*"):
        if "LR" in stage.name or "RS" in stage.name:
            shutil.rmtree(stage)
    failing |= {"HF": BadInput("the disk is full"), "LR": RuntimeError("out of memory")}
    report, failures = run(Point(), METHODS, options(copy))
    assert [str(error) for error in failures] == ["the disk is full", "out of memory"] * 2
    said = capsys.readouterr().err
    assert "error: HF, training seed 1: the disk is full\n" in said
    assert "RuntimeError: out of memory" in said and "error: LR, training seed 0 failed" in said
    assert report and list(results(copy)["methods"]) == ["RS", "VGCP", "HF"]


def test_where_all_fail_there_is_no_report(tmp_path: Path, failing) -> None:
    failing |= {method.name: BadInput("no") for method in METHODS}
    report, failures = run(Point(), METHODS, options(tmp_path))
    assert report is None and len(failures) == 8
    assert not list(tmp_path.rglob("report*"))


def test_a_table_that_was_killed_goes_on(copy: Path, monkeypatch) -> None:
    whole = results(copy)
    for stage in [*stages(copy, "LR-1-*"), *stages(copy, "test-LR-1-*")]:
        shutil.rmtree(stage)
    with monkeypatch.context() as m:
        m.setattr(Progress, "advance", dies_at(1))
        with pytest.raises(Killed):
            run(Point(), METHODS, options(copy))
    assert not stages(copy, "LR-1-*")
    with counted() as calls:
        run(Point(), METHODS, options(copy))
    assert calls == Counter(fit=1, run=1)
    assert without_made(results(copy)) == without_made(whole)


# ── the command ─────────────────────────────────────────────────────────────────────────────


def command(monkeypatch, *flags: str) -> int:
    """The exit status of `python -m experiments.table1`."""
    monkeypatch.setattr(sys, "argv", ["table1", *flags])
    try:
        run_cli(table1.main, "")
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--robot", "cow"), "'cow'"),
        (("--methods", "RS", "XX"), "'XX'"),
        (("--methods", "HF", "--no-include-hf"), "no method"),
        (("--scale", "huge"), "--scale"),
        (("--seeds", "0"), "seeds"),
        (("--episodes-per-extra-seed", "0"), "episodes_per_extra_seed"),
        (("--test.num-envs", "0"), "num_envs"),
    ],
)
def test_bad_input_ends_in_a_sentence(tmp_path, monkeypatch, capsys, flags, why) -> None:
    assert command(monkeypatch, "--robot", "point", "--run-dir", str(tmp_path), *flags) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and why in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("errors", "status"),
    [([], 0), ([BadInput("a")], 2), ([BadInput("a"), RuntimeError("b")], 1)],
)
def test_the_exit_status_tells_of_failures(
    tmp_path, monkeypatch, capsys, errors: list[Exception], status: int
) -> None:
    (tmp_path / "table.txt").write_text("the table")
    asked = []

    def ran(*args):
        asked.append(args)
        return tmp_path, errors

    monkeypatch.setattr(table1, "run", ran)
    assert (
        command(monkeypatch, "--robot", "point", "--methods", "LR", "RS", "--seed", "4") == status
    )
    ((robot, rows, given, _),) = asked
    assert (robot.name, [row.name for row in rows], given.seed) == ("point", ["LR", "RS"], 4)
    out = capsys.readouterr()
    assert out.out == "the table\n"
    assert (f"cells that failed: {len(errors)};" in out.err) == bool(errors)
