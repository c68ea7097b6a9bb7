"""A cell end to end: its stages, which methods share them, its report and its results."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from bits import same, truncate
from point import Point
from small_cells import LR, RS, VGCP, Finished, command, counted, files, options, stage_of
from tiny import TEST

from genidm import controller
from genidm.agents.policy import Policy
from genidm.errors import BadInput
from genidm.evaluation import stats
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.scenarios import scenarios
from genidm.files import load_arrays
from genidm.paper import methods
from genidm.paper.generalize import Generalize
from genidm.progress import METRICS, read_metrics
from genidm.provenance import code_digest
from genidm.runs import run as run_module
from genidm.runs.cell import make_run, run_method
from genidm.store import Stage
from genidm.tasks import WalkForward

pytestmark = pytest.mark.usefixtures("one_bank")


def test_methods_share_the_stages_that_they_agree_on(finished: Finished) -> None:
    assert finished.done == [
        Counter(collect=1, replay=1, fit=1, run=1),
        Counter(collect=1, fit=1, run=1),
        Counter(fit=1, run=1),  # LR learns from what GE collected and replayed
    ]
    stages = Counter(p.parent.name.rsplit("-", 1)[0] for p in finished.out.rglob("done.json"))
    both = ["experience-PPO-0", "experience-RandomActions-0", "replay-segments-0"]
    each = [f"{prefix}{m}-0" for prefix in ("", "test-") for m in ("RS", "GE", "LR")]
    assert stages == Counter(both + each)


def test_the_report_is_there(finished: Finished) -> None:
    names = {p.name for p in finished.report.iterdir()}
    assert {"results.json", "table.txt", "table.md", "violins.png", "paths.png"} <= names
    assert {"collecting.png", "fitting.png", "residual.png", "bearings.png"} <= names
    for png in finished.report.glob("*.png"):
        assert png.read_bytes()[:4] == b"\x89PNG" and png.stat().st_size > 5000
    lines = (finished.report / "table.txt").read_text().splitlines()
    rows = [line.split()[0] for line in lines if line[:2] in ("RS", "GE", "LR") and "±" in line]
    assert rows == ["RS", "GE", "LR"] and "paths.png" in lines[-1]


def test_a_fit_keeps_its_error_on_what_it_has_not_seen(finished: Finished) -> None:
    for method in ("RS", "GE", "LR"):
        stage = stage_of(finished.out, f"{method}-0")
        found, summary = json.loads((stage / "held_out.json").read_text()), Stage(stage).summary()
        totals = {name: found[name] for name in ("samples", "error", "shuffled", "nearest")}
        assert summary["held_out"] == totals and min(totals.values()) > 0
        made = controller.load(stage / "controller", Point())
        np.testing.assert_array_equal(np.float32(summary["bearings"]), made.bearings)
        row = finished.results["methods"][method]
        assert row["held_out"] == {name: pytest.approx(x, abs=1e-6) for name, x in totals.items()}
        assert row["bearings"] == pytest.approx(summary["bearings"], abs=1e-6)
    table = (finished.report / "table.txt").read_text()
    assert "Held-out action error of the fits" in table and "Bearings of 98 %" in table
    assert (finished.report / "held_out.png").exists()


def test_results_hold_what_the_table_is_made_of(finished: Finished) -> None:
    results = finished.results
    tested_scenarios = scenarios(Point(), 10, 2)
    assert (results["robot"], results["scale"]) == ("point", "0.5")
    assert results["scenarios"] == tested_scenarios.digest()
    assert list(results["methods"]) == ["RS", "GE", "LR"]
    lr = results["methods"]["LR"]
    keys = {"interactions", "replayed", "seeds", "episodes", "mean", "std", "ci95", "iqm"}
    assert keys | {"success", "fell", "settings"} <= lr.keys()
    assert (lr["interactions"], lr["replayed"]) == (1024, 512)
    assert (results["methods"]["RS"]["replayed"], lr["seeds"], lr["episodes"]) == (0, 10, 2)
    assert list(lr["success"]) == ["0.25", "0.5", "1.0"]
    assert lr["settings"]["fit"]["latent_size"] == 2 and lr["settings"]["goal_horizon"] == 10
    assert results["paired"].keys() == {"GE-RS", "LR-GE", "LR-RS"}


def test_every_stage_of_a_row_says_what_made_it(finished: Finished) -> None:
    made = finished.results["methods"]["LR"]["made"]
    kinds = [name.partition("-")[0] for name in made]
    assert kinds == ["experience", "replay", "LR", "test"]
    for name, origin in made.items():
        stage = Stage(finished.out / "point" / name)
        assert origin["code"] == code_digest(stage.code) and origin["versions"]["jax"]
        assert origin["commands"] == 1 and origin["seconds"] == stage.made[0]["seconds"] > 0
    assert "genidm.paper.fit" in Stage(stage_of(finished.out, "LR-0")).code
    assert finished.results["other_code"] == {}


def test_a_test_holds_the_whole_config_of_its_run(finished: Finished) -> None:
    stage = next(finished.out.glob("point/test-LR-0-*"))
    run = Stage(stage).summary()["run"]
    assert run["robot"]["name"] == "point" and run["seed"] == 0
    assert run["method"]["fit"]["updates"] == LR.fit.updates * 0.5
    assert run["scale"]["interactions"] == 1024 and run["test"]["max_steps"] == 40
    assert any("chosen for this scale" in note for note in run["notes"])


def test_the_numbers_of_a_row_are_those_of_its_episodes(finished: Finished) -> None:
    stage = next(finished.out.glob("point/test-LR-0-*"))
    tree, _ = load_arrays(stage / "episodes")
    episodes = Episodes(**tree["episodes"])
    summary = stats.summary(episodes)
    row = finished.results["methods"]["LR"]
    for name in ("mean", "std", "iqm", "fell", "ci95"):
        assert row[name] == pytest.approx(summary[name], abs=1e-6)
    assert len(tree["trajectories"]) == 20
    # A target lies 2 to 5 m away; no episode of 40 steps at 1 m/s comes nearer than it walks.
    assert (episodes.start >= 2).all() and (episodes.start <= 5).all()
    assert (episodes.path_length <= 2 + 1e-4).all() and (episodes.path_length > 0).all()
    gained = episodes.start - episodes.closest
    assert (gained >= 0).all() and (gained <= episodes.path_length + 1e-4).all()


def test_the_agent_turned_is_the_policy_of_the_record_that_a_fit_learns_from(copy: Path) -> None:
    agent = methods.AgentTurned("AGENT", LR.agent, LR.task)
    run = make_run(Point(), agent, options(copy))
    fitted = make_run(Point(), LR, options(copy))
    with counted() as calls:
        stage = run.run_test(scenarios(Point(), 10, 2))
    assert calls == Counter(run=1)  # nothing is collected or fitted
    assert run.policy_stage.directory == fitted.experience_stage.directory
    policy = controller.load(run.policy_stage.path("policy"), Point())
    assert run.controller().params.keys() == policy.params.keys() and run.controller().faces_goal
    same(run.controller().params, policy.params)
    summary = stage.summary()
    assert (summary["method"], summary["interactions"], summary["replayed"]) == ("AGENT", 1024, 0)
    assert [s.partition("-")[0] for s in summary["stages"]] == ["experience", "AGENT"]


def test_an_agent_that_learns_nothing_cannot_be_turned(tmp_path: Path) -> None:
    agent = methods.AgentTurned("AGENT", RS.agent, RS.task)
    with pytest.raises(BadInput, match="RandomActions learns no policy"):
        make_run(Point(), agent, options(tmp_path)).controller()


def test_a_second_run_does_nothing_again_but_the_report(copy: Path, tmp_path: Path, capsys) -> None:
    """By its command line, which ends with the table, and with results where it is told."""
    before = {p: p.stat().st_mtime_ns for p in copy.rglob("*") if "report" not in str(p)}
    names, results = files(copy).keys(), "point/report-0.5/results.json"
    was = (copy / results).read_bytes()
    with counted() as calls:
        command(copy, "--report-dir", str(tmp_path / "results"))
    assert not calls and files(copy).keys() == names
    assert {p: p.stat().st_mtime_ns for p in copy.rglob("*") if "report" not in str(p)} == before
    table = (copy / "point" / "report-0.5" / "table.txt").read_text()
    assert capsys.readouterr().out == table + "\n"
    written = files(tmp_path / "results")
    assert written["point_0.5.json"] == (copy / results).read_bytes() == was
    assert {"point_0.5_table.txt", "point_0.5_violins.png", "point_0.5_paths.png"} <= written.keys()


def test_a_test_that_cannot_be_read_is_left_out_of_the_report(copy: Path, capsys) -> None:
    stage = next(copy.glob("point/test-RS-0-*"))
    truncate(stage / "episodes" / "episodes.closest.npy")
    command(copy)
    said = capsys.readouterr()
    assert f"warning: {stage / 'done.json'} is not the summary of a test" in said.err
    assert "LR" in said.out and "\nRS " not in said.out


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"scale": "0.5", "test": {}}', "\x00"])
def test_what_is_no_summary_spoils_no_report(copy: Path, capsys, content: str) -> None:
    was, _, _ = (copy / "point" / "report-0.5" / "table.txt").read_text().partition("Figures in")
    foreign = copy / "point" / "test-theirs" / "done.json"
    foreign.parent.mkdir()
    foreign.write_text(content)
    command(copy)
    said = capsys.readouterr()
    assert said.out.startswith(was) and f"{foreign} is not the summary of a test" in said.err


@pytest.mark.parametrize(
    ("changes", "again"),
    [
        (dict(fit=dataclasses.replace(LR.fit, latent_size=3)), {"fit", "run"}),
        (dict(goal_horizon=3), {"fit", "run"}),
        (dict(generalize=Generalize(segment=3)), {"replay", "fit", "run"}),
        (dict(task=WalkForward(19)), {"collect", "replay", "fit", "run"}),
    ],
)
def test_one_change_runs_what_depends_on_it_again(
    copy: Path, monkeypatch, changes: dict, again: set
) -> None:
    """Which of the stages are to be made is all that is looked at: none is made."""
    this = make_run(Point(), dataclasses.replace(LR, **changes), options(copy))
    made = {
        "collect": this.experience_stage.done,
        "replay": this.replay_stage.done,
        "fit": this.controller_stage.done,
    }
    assert {name for name, done in made.items() if not done} == again - {"run"}


def test_another_seed_and_another_test_have_stages_of_their_own(copy: Path, monkeypatch) -> None:
    seed = make_run(Point(), LR, options(copy, seed=1))
    assert not (seed.experience_stage.done or seed.replay_stage.done or seed.controller_stage.done)
    monkeypatch.setattr(run_module, "run", ran)
    for changes in (dict(episodes=1), dict(test=dataclasses.replace(TEST, goal_radius=0.2))):
        with counted() as calls, pytest.raises(Ran):
            run_method(Point(), LR, options(copy, **changes))
        assert calls == Counter(run=1)


class Ran(Exception):
    pass


def ran(*args, **kwargs):
    raise Ran


# ── a method that learns to go to goals itself ───────────────────────────────────────────


def test_a_policy_is_its_own_controller(direct: Finished) -> None:
    assert direct.done == [Counter(collect=1, run=1)]
    stages = {p.parent.name.rsplit("-", 1)[0] for p in direct.out.rglob("done.json")}
    assert stages == {"VGCP-0", "test-VGCP-0"}
    stage = Stage(stage_of(direct.out, "VGCP"))
    policy = controller.load(stage.path("controller"), Point())
    assert isinstance(policy, Policy) and policy.goal_conditioned
    assert not any(stage.path(x).exists() for x in ("experience", "checkpoints"))
    lines = read_metrics(stage.path(METRICS))
    assert lines[-1]["step"] == stage.summary()["learned_from"] == 1024
    assert {"reward", "speed", "reached", "policy_loss"} <= lines[-1].keys()


def test_its_row_stands_among_the_others(direct: Finished, copy: Path) -> None:
    for stage in (direct.out / "point").glob("*VGCP-0-*"):
        shutil.copytree(stage, copy / "point" / stage.name)
    with counted() as calls:
        report = run_method(Point(), VGCP, options(copy))
    assert not calls
    results = json.loads((report / "results.json").read_text())["methods"]
    assert list(results) == ["RS", "VGCP", "GE", "LR"]
    row, alone = results["VGCP"], direct.results["methods"]["VGCP"]
    assert {n: x for n, x in row.items() if n != "invariance"} == alone  # that needs a record
    assert (row["interactions"], row["replayed"], row["seeds"], row["episodes"]) == (1024, 0, 10, 2)
    assert row["settings"]["task"]["episode_steps"] == 20
