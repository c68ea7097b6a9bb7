"""A cell end to end: its stages, its report, what it refuses, and what a kill costs it.

Run as a script, `python tests/test_experiment.py OUT POINT...`, this module runs a cell
again and again, killed by SIGKILL at each point in turn, and lets the last run end.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import itertools
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from killing import Killed, dies_at
from point import Point
from tiny import TEST, tiny

from experiments import evaluate, walk, waypoints
from genidm import controller
from genidm.agents import collect as collecting
from genidm.agents.policy import Policy
from genidm.errors import BadInput
from genidm.evaluation import stats
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.scenarios import scenarios
from genidm.evaluation.waypoints import Follow
from genidm.files import load_arrays, save_arrays
from genidm.paper import methods
from genidm.paper.generalize import Generalize
from genidm.paper.methods import Inverse, Method, literal
from genidm.progress import METRICS, Progress, read_metrics
from genidm.robots import ROBOTS, Ant, Humanoid, Minitaur, Robot
from genidm.runs import command as experiment
from genidm.runs import run as cells
from genidm.runs.cell import cell, run_cell
from genidm.runs.resolve import Options
from genidm.runs.scale import Scale, scale_of
from genidm.store import Stage
from genidm.tasks import WalkForward


def small(method: Inverse) -> Inverse:
    """Tiny, with updates enough to be killed among."""
    fit = dataclasses.replace(
        tiny(method).fit, updates=2500, latent_size=method.fit.latent_size and 2
    )
    return tiny(method, look_ahead=10, fit=fit)


RS, GE, LR = (small(m) for m in (methods.RS, methods.GE, methods.LR))
VGCP, HER_SP = (tiny(m) for m in (methods.VGCP, methods.HER_SP))


def options(out: Path, **changes) -> Options:
    return dataclasses.replace(Options(scale="0.5", out=out, episodes=2, test=TEST), **changes)


STAGES = ("collect", "replay", "fit", "run")


@contextlib.contextmanager
def counted() -> Iterator[Counter]:
    """Which stages' work is done meanwhile, and how often."""
    calls: Counter = Counter()

    def counting(name: str, work: Callable) -> Callable:
        def counted(*args, **kwargs):
            calls[name] += 1
            return work(*args, **kwargs)

        return counted

    with pytest.MonkeyPatch.context() as m:
        for name in STAGES:
            m.setattr(cells, name, counting(name, getattr(cells, name)))
        yield calls


@dataclasses.dataclass
class Finished:
    """The runs of three methods, one after another, and what each of them had to do."""

    out: Path
    report: Path
    done: list[Counter]

    @property
    def results(self) -> dict:
        return json.loads((self.report / "results.json").read_text())


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Finished:
    out, done = tmp_path_factory.mktemp("runs"), []
    bank = scenarios(Point(), 10, 2)
    for method in (GE, RS, LR):
        with counted() as calls:
            cell(Point(), method, options(out)).episodes(bank)
        done.append(calls)
    return Finished(out, run_cell(Point(), LR, options(out)), done)


@pytest.fixture(scope="module", autouse=True)
def one_bank() -> Iterator[None]:
    """Scenarios are drawn once for all cells: they see the robot and two numbers alone."""
    with pytest.MonkeyPatch.context() as m:
        draw = functools.cache(lambda name, *numbers: scenarios(Point(), *numbers))
        m.setattr(experiment, "scenarios", lambda robot, *numbers: draw(robot.name, *numbers))
        yield


@pytest.fixture
def copy(finished: Finished, tmp_path: Path) -> Path:
    return shutil.copytree(finished.out, tmp_path / "runs")


def files(directory: Path) -> dict[str, bytes]:
    paths = (p for p in sorted(directory.rglob("*")) if p.is_file())
    return {str(p.relative_to(directory)): p.read_bytes() for p in paths}


# ── a cell ──────────────────────────────────────────────────────────────────────────────


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


def test_results_hold_what_the_table_is_made_of(finished: Finished) -> None:
    results = finished.results
    bank = scenarios(Point(), 10, 2)
    assert (results["robot"], results["scale"]) == ("point", "0.5")
    assert results["scenarios"] == bank.digest() and results["versions"]["jax"]
    assert list(results["methods"]) == ["RS", "GE", "LR"] and results["hardware"]
    lr = results["methods"]["LR"]
    keys = {"interactions", "replayed", "seeds", "episodes", "mean", "std", "ci95", "iqm"}
    assert keys | {"success", "fell", "settings"} <= lr.keys()
    assert (lr["interactions"], lr["replayed"]) == (1024, 512)
    assert (results["methods"]["RS"]["replayed"], lr["seeds"], lr["episodes"]) == (0, 10, 2)
    assert list(lr["success"]) == ["0.25", "0.5", "1.0"]
    assert lr["settings"]["fit"]["latent_size"] == 2 and lr["settings"]["look_ahead"] == 10
    assert results["paired"].keys() == {"GE-RS", "LR-GE", "LR-RS"}


def test_the_numbers_of_a_row_are_those_of_its_episodes(finished: Finished) -> None:
    stage = next(finished.out.glob("point/test-LR-0-*"))
    tree, _ = load_arrays(stage / "episodes")
    summary = stats.summary(Episodes(**tree["episodes"]))
    row = finished.results["methods"]["LR"]
    for name in ("mean", "std", "iqm", "fell", "ci95"):
        assert row[name] == pytest.approx(summary[name], abs=1e-6)
    assert len(tree["ways"]) == 20 and 0 < row["mean"] < 5


def test_a_second_run_does_nothing_again_but_the_report(copy: Path, tmp_path: Path, capsys) -> None:
    """By its command line, which ends with the table, and with results where it is told."""
    before = {p: p.stat().st_mtime_ns for p in copy.rglob("*") if "report" not in str(p)}
    names, results = files(copy).keys(), "point/report-0.5/results.json"
    was = (copy / results).read_bytes()
    with counted() as calls:
        command(copy, "--results", str(tmp_path / "results"))
    assert not calls and files(copy).keys() == names
    assert {p: p.stat().st_mtime_ns for p in copy.rglob("*") if "report" not in str(p)} == before
    table = (copy / "point" / "report-0.5" / "table.txt").read_text()
    assert capsys.readouterr().out == table + "\n"
    written = files(tmp_path / "results")
    assert written["point.json"] == (copy / results).read_bytes() == was
    assert {"point_table.txt", "point_violins.png", "point_paths.png"} <= written.keys()


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"scale": "0.5", "test": {}}', "\x00"])
def test_what_is_no_summary_spoils_no_report(copy: Path, capsys, content: str) -> None:
    was, _, _ = (copy / "point" / "report-0.5" / "table.txt").read_text().partition("Figures in")
    foreign = copy / "point" / "test-theirs" / "done.json"
    foreign.parent.mkdir()
    foreign.write_text(content)
    command(copy)
    said = capsys.readouterr()
    assert said.out.startswith(was) and f"{foreign} is no summary of a test" in said.err


@pytest.mark.parametrize(
    ("changes", "again"),
    [
        (dict(fit=dataclasses.replace(LR.fit, latent_size=3)), {"fit", "run"}),
        (dict(look_ahead=3), {"fit", "run"}),
        (dict(generalize=Generalize(segment=3)), {"replay", "fit", "run"}),
        (dict(task=WalkForward(19)), {"collect", "replay", "fit", "run"}),
    ],
)
def test_one_change_runs_what_depends_on_it_again(
    copy: Path, monkeypatch, changes: dict, again: set
) -> None:
    """Which of the stages are to be made is all that is looked at: none is made."""
    this = cell(Point(), dataclasses.replace(LR, **changes), options(copy))
    made = {
        "collect": this.experience_stage.done,
        "replay": this.replay_stage.done,
        "fit": this.controller_stage.done,
    }
    assert {name for name, done in made.items() if not done} == again - {"run"}


def test_another_seed_and_another_test_have_stages_of_their_own(copy: Path, monkeypatch) -> None:
    seed = cell(Point(), LR, options(copy, seed=1))
    assert not (seed.experience_stage.done or seed.replay_stage.done or seed.controller_stage.done)
    monkeypatch.setattr(cells, "run", ran)
    for changes in (dict(episodes=1), dict(test=dataclasses.replace(TEST, reach=0.2))):
        with counted() as calls, pytest.raises(Ran):
            run_cell(Point(), LR, options(copy, **changes))
        assert calls == Counter(run=1)


class Ran(Exception):
    pass


def ran(*args, **kwargs):
    raise Ran


def test_the_literal_method_is_the_papers() -> None:
    this = cell(Point(), LR, Options(literal=True)).method
    assert this == literal(LR) and this.name == "LR literal" and this.look_ahead == 1
    kept = (this.generalize.mode, this.fit.latent_weight, this.fit.averaged, this.fit.decay)
    assert kept == ("episodes", 0.25, True, False)
    with pytest.raises(BadInput, match="letter"):
        cell(Point(), methods.VGCP, Options(literal=True))


def test_scales_are_shares_of_the_paper() -> None:
    assert scale_of("paper", 2000) == Scale("paper", 2000, 1.0, 10, 1000)
    assert scale_of("0.1", 2000) == Scale("0.1", 200, 0.1, 10, 100, look_ahead=50, learning=2 / 3)
    million = scale_of("0.5", 2_000_000)
    assert million == Scale("0.5", 1_000_000, 0.5, 10, 500, learning=2 / 3)
    assert scale_of("2", 2_000_000) == Scale("2", 4_000_000, 1.0, 10, 1000)
    quick = scale_of("quick", 2_000_000)
    assert quick.interactions < 500_000 and quick.updates < 0.5 and quick.look_ahead < 100
    this = cell(Point(), dataclasses.replace(LR, look_ahead=999), Options(scale="quick"))
    assert this.method.look_ahead == quick.look_ahead
    assert this.method.share == quick.share == 1.0
    given = {name: cell(Point(), methods.LR, Options(scale=name)) for name in ("quick", "paper")}
    assert given["quick"].method.agent == quick.ppo != methods.LR.agent
    assert given["paper"].method.agent == methods.LR.agent
    assert this.method.agent == LR.agent  # what a user has set stands
    for wrong in ("huge", "0", "-1", "nan", "inf", ""):
        with pytest.raises(BadInput, match="--scale"):
            scale_of(wrong, 2000)


@pytest.mark.parametrize("text", ["5e-4", "0.00050", "+.0005"])
def test_a_scale_is_a_number_however_it_is_written(text: str) -> None:
    assert scale_of(text, 2_000_000) == scale_of("0.0005", 2_000_000)


@pytest.mark.parametrize(
    ("flags", "name", "value"),
    [
        # Each equals a default, or stands beside what would choose another.
        (("--scale", "quick", "--method.agent.discount", "0.99"), "agent.discount", 0.99),
        (("--scale", "quick", "--method.agent.lanes", "256"), "agent.discount", 0.97),
        (("--scale", "quick", "--method.share", "0.5"), "share", 0.5),
        (("--scale", "0.1", "--method.look-ahead", "80"), "look_ahead", 80),
        (("--scale", "0.1", "--method.fit.updates", "5000"), "fit.updates", 5000),
        (
            (
                "--scale",
                "0.1",
            ),
            "fit.updates",
            2000,
        ),
        (("--literal", "--method.look-ahead", "7"), "look_ahead", 7),
        (("--literal", "--method.fit.latent-weight", "0.9"), "fit.latent_weight", 0.9),
        (("--literal", "--method.generalize.mode", "segments"), "generalize.mode", "segments"),
        (("--method.generalize.segment", "20"), "generalize.segment", 20),
    ],
)
def test_what_the_user_sets_is_what_is_run(
    flags: tuple[str, ...], name: str, value: object, monkeypatch, tmp_path: Path
) -> None:
    ran: list[cells.Cell] = []
    (tmp_path / "table.txt").write_text("")
    monkeypatch.setattr(experiment, "run_to_the_end", lambda c, _: ran.append(c) or tmp_path)
    monkeypatch.setattr(sys, "argv", ["ant_lr", *flags])
    experiment.main(Point, methods.LR)
    made = functools.reduce(getattr, name.split("."), ran[0].method)
    assert made == value


def test_who_has_set_what_is_said(monkeypatch, tmp_path: Path, capsys) -> None:
    (tmp_path / "table.txt").write_text("")
    monkeypatch.setattr(experiment, "run_to_the_end", lambda *_: tmp_path)
    monkeypatch.setattr(sys, "argv", ["lr", "--scale", "0.1", "--method.fit.batch", "64"])
    experiment.main(Point, methods.LR)
    chosen, given, papers = capsys.readouterr().err.splitlines()
    assert chosen.startswith("LR, chosen for this scale and machine: fit.updates 2000 (20000), ")
    assert given == "LR, set by you: fit.batch 64 (512)"
    assert papers.startswith("LR, not the paper's (--literal has those): fit.averaged False (True)")


@pytest.mark.parametrize("seed", [-1, 2**32, 10**30, 1.5])
def test_seeds_have_32_bits(seed: float) -> None:
    with pytest.raises(BadInput, match="seed must be"):
        Options(seed=seed)
    assert Options(seed=2**32 - 1).seed == 2**32 - 1


# ── a method that learns to go to goals itself ──────────────────────────────────────────


@pytest.fixture(scope="module")
def direct(tmp_path_factory) -> Finished:
    out = tmp_path_factory.mktemp("direct")
    with counted() as calls:
        report = run_cell(Point(), VGCP, options(out))
    return Finished(out, report, [calls])


def test_a_policy_is_its_own_controller(direct: Finished) -> None:
    assert direct.done == [Counter(collect=1, run=1)]
    stages = {p.parent.name.rsplit("-", 1)[0] for p in direct.out.rglob("done.json")}
    assert stages == {"VGCP-0", "test-VGCP-0"}
    stage = Stage(stage_of(direct.out, "VGCP"))
    policy = controller.load(stage.path("controller"), Point())
    assert isinstance(policy, Policy) and policy.directed
    assert not any(stage.path(x).exists() for x in ("experience", "checkpoints"))
    lines = read_metrics(stage.path(METRICS))
    assert lines[-1]["step"] == stage.summary()["learned_from"] == 1024
    assert {"reward", "speed", "reached", "policy_loss"} <= lines[-1].keys()


def test_its_row_stands_among_the_others(direct: Finished, copy: Path) -> None:
    for stage in (direct.out / "point").glob("*VGCP-0-*"):
        shutil.copytree(stage, copy / "point" / stage.name)
    with counted() as calls:
        report = run_cell(Point(), VGCP, options(copy))
    assert not calls
    results = json.loads((report / "results.json").read_text())["methods"]
    assert list(results) == ["RS", "VGCP", "GE", "LR"]
    row, alone = results["VGCP"], direct.results["methods"]["VGCP"]
    assert {n: x for n, x in row.items() if n != "invariance"} == alone  # that needs a record
    assert (row["interactions"], row["replayed"], row["seeds"], row["episodes"]) == (1024, 0, 10, 2)
    assert row["settings"]["task"]["episode_steps"] == 20 and 0 < row["mean"] < 5


def test_killed_on_its_way_it_ends_with_the_same_bits(
    direct: Finished, tmp_path: Path, monkeypatch
) -> None:
    """While it learns, as its stage is to be marked done, and in the test."""
    monkeypatch.setattr(collecting, "CHUNK", 2 * 128)
    for owner, name, death in (
        (Progress, "advance", dies_at(5)),
        (Stage, "finish", dying),
        (Progress, "advance", dying),
    ):
        with monkeypatch.context() as m:
            m.setattr(owner, name, death)
            with pytest.raises(Killed):
                run_cell(Point(), VGCP, options(tmp_path))
    with counted() as calls:
        run_cell(Point(), VGCP, options(tmp_path))
    assert calls == Counter(run=1)
    for stage in ("VGCP", "test-VGCP"):
        whole, killed = (arrays(stage_of(out, stage)) for out in (direct.out, tmp_path))
        assert whole and whole == killed


def dying(*args, **kwargs):
    raise Killed


def test_it_is_tested_again_like_any_controller(direct: Finished, capsys, monkeypatch) -> None:
    monkeypatch.setitem(ROBOTS, "point", Point)
    evaluate.main((stage_of(direct.out, "VGCP"),), seeds=10, episodes=2, test=TEST)
    mean = direct.results["methods"]["VGCP"]["mean"]
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("VGCP"))
    assert f"{mean:.2f}" in row


def test_runs_are_tested_again_side_by_side(direct: Finished, capsys, monkeypatch) -> None:
    monkeypatch.setitem(ROBOTS, "point", Point)
    run = stage_of(direct.out, "VGCP")
    evaluate.main((run, run), seeds=2, episodes=2, test=TEST)
    shown = capsys.readouterr().out.splitlines()
    (pair,) = (line.split() for line in shown if line.startswith(f"VGCP, {run.name}-VGCP"))
    assert float(pair[2]) == 0
    for wrong, why in (((), "of a run"), ((run / "controller",), "of a finished run")):
        with pytest.raises(BadInput, match=why):
            evaluate.main(wrong)


def test_it_is_led_through_waypoints(direct: Finished, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setitem(ROBOTS, "point", Point)
    runs = (stage_of(direct.out, "VGCP"),) * 2
    waypoints.main(runs, robots=2, out=tmp_path, settings=Follow(max_steps=20, chunk=10))
    written = json.loads((tmp_path / "point_waypoints.json").read_text())
    assert list(written["methods"]) == ["VGCP", f"VGCP, {runs[0].name}"]
    one, again = written["methods"].values()
    assert one == again and one["journeys"] == 2 and len(one["reached"]) == 5
    assert (tmp_path / "point_waypoints.png").stat().st_size > 10_000
    assert capsys.readouterr().out.splitlines()[0].startswith("VGCP: 0 of 2 through all waypoints")
    for wrong, why in (((), "of a run"), (runs, "robots must")):
        with pytest.raises(BadInput, match=why):
            waypoints.main(wrong, robots=0, out=tmp_path)
    with pytest.raises(BadInput, match="an even number, not 3"):
        waypoints.main(runs, (3.0, 0.0, 5.0), out=tmp_path)


def test_how_fast_a_policy_walks_is_told(finished: Finished, capsys, monkeypatch) -> None:
    """Of the agents that learned; random actions leave no policy."""
    monkeypatch.setitem(ROBOTS, "point", Point)
    with pytest.raises(BadInput, match="no agent has collected"):
        walk.main(finished.out)
    walk.main(finished.out / "point", episodes=4)
    (line,) = capsys.readouterr().out.splitlines()
    name, speed = line.split(": ")
    assert name == stage_of(finished.out, "experience-PPO").name
    assert "m/s" in speed and -1 <= float(speed.split()[0]) <= 1


@pytest.mark.parametrize("name", methods.ORDER)
@pytest.mark.parametrize("robot", [Ant, Humanoid, Minitaur])
def test_every_method_has_a_command(robot: type[Robot], name: str, monkeypatch) -> None:
    asked: list = []
    monkeypatch.setattr(experiment, "main", lambda *args: asked.append(args))
    runpy.run_module(f"experiments.{robot.name}_{name.lower()}", run_name="__main__")
    assert asked == [(robot, methods.by_name(name, robot.name))]


# ── bad input: one sentence on stderr, exit status 2, nothing overwritten ───────────────


def command(out: Path, *flags: str, robot: type[Point] = Point, method: Method = LR) -> None:
    """The command line of a cell, at the scale of these tests."""
    test = ("--test.max-steps", "40", "--test.lanes", "16", "--test.chunk", "10")
    start = ("cell", "--scale", "0.5", "--episodes", "2", "--out", str(out), *test)
    with pytest.MonkeyPatch.context() as m:
        m.setattr(sys, "argv", [*start, *flags])
        experiment.main(robot, method)


def refused(out: Path, capsys, why: str, *flags: str, **options) -> None:
    before = files(out) if out.is_dir() else {}
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        command(out, *flags, **options)
    said = [line for line in capsys.readouterr().err.splitlines() if line[:6] == "error:"]
    assert exit_.value.code == 2 and len(said) == 1 and why in said[0]
    after = files(out) if out.is_dir() else {}
    assert {name: after.get(name) for name in before} == before


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--scale", "huge"), "'huge'"),
        (("--scale", "-0.5"), "--scale"),
        (("--method.fit.latent-weight", "1.5"), "λ"),
        (("--method.fit.latent-weight", "0"), "λ"),
        (("--method.fit.latent-size", "0"), "k (latent_size)"),
        (("--method.look-ahead", "0"), "look_ahead"),
        (("--method.share", "2"), "share"),
        (("--method.agent.epochs", "0"), "epochs"),
        (("--episodes", "0"), "episodes must be at least 1"),
        (("--test.lanes", "0"), "lanes"),
    ],
)
def test_settings_that_cannot_be_are_refused(
    tmp_path: Path, capsys, flags: tuple, why: str
) -> None:
    refused(tmp_path / "runs", capsys, why, *flags)
    assert not list(tmp_path.rglob("experience-*"))


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--method.agent.discount", "1"), "discount"),
        (("--method.agent.her.goals", "0"), "goals must be at least 1"),
        (("--method.agent.capacity", "7"), "buffer"),
        (("--method.task.reach", "0"), "reach"),
    ],
)
def test_settings_that_no_learner_can_have_are_refused(
    tmp_path: Path, capsys, flags: tuple, why: str
) -> None:
    refused(tmp_path / "runs", capsys, why, *flags, method=HER_SP)
    assert not list(tmp_path.rglob("done.json"))


def test_an_out_that_cannot_be_written_is_refused(tmp_path: Path, capsys) -> None:
    (tmp_path / "file").write_text("precious")
    refused(tmp_path / "file", capsys, "cannot use")
    refused(tmp_path / "file" / "deeper", capsys, "cannot use")
    assert (tmp_path / "file").read_text() == "precious"


def stage_of(out: Path, name: str) -> Path:
    return next((out / "point").glob(f"{name}-*"))


def forget(out: Path, *names: str) -> None:
    """As if these stages had not been finished."""
    for name in names:
        (stage_of(out, name) / "done.json").unlink()


def test_nan_in_the_experience_is_refused(copy: Path, capsys) -> None:
    forget(copy, "test-LR", "LR", "replay")
    chunk = stage_of(copy, "experience-PPO") / "experience" / "chunk_00000"
    tree, meta = load_arrays(chunk)
    tree["o"][3, 2, 1] = np.nan
    save_arrays(chunk, tree, meta, overwrite=True)
    refused(copy, capsys, "o holds NaN")


def test_a_torn_experience_is_refused(copy: Path, capsys) -> None:
    forget(copy, "test-LR", "LR", "replay")
    file = stage_of(copy, "experience-PPO") / "experience" / "chunk_00000" / "s.npy"
    file.write_bytes(file.read_bytes()[:-1])
    refused(copy, capsys, "cut short")


def test_a_torn_controller_is_refused(copy: Path, capsys) -> None:
    forget(copy, "test-LR")
    (stage_of(copy, "LR") / "controller" / "mean.npy").unlink()
    refused(copy, capsys, "mean.npy is missing")


def test_the_controller_of_another_robot_is_refused(copy: Path, capsys) -> None:
    class Other(Point):
        name = "other"

    forget(copy, "test-LR")
    path = stage_of(copy, "LR") / "controller"
    controller.load(path, Point()).replace(robot=Other()).save(path, overwrite=True)
    refused(copy, capsys, "controller for other, not for point")


def test_the_experience_of_another_robot_is_refused(copy: Path, capsys) -> None:
    """Of its state, or, where that has as many numbers, of its physics."""
    forget(copy, "test-LR", "LR", "replay")
    chunk = stage_of(copy, "experience-PPO") / "experience" / "chunk_00000"
    tree, meta = load_arrays(chunk)
    wheels = {**tree, "physics": {"wheels": tree["s"]}}
    save_arrays(chunk, wheels, meta, overwrite=True)
    refused(copy, capsys, "physics of another robot than point")
    save_arrays(chunk, {**tree, "s": tree["s"][..., 1:]}, meta, overwrite=True)
    refused(copy, capsys, "s has shape")
    save_arrays(chunk, {"x": tree["s"]}, meta, overwrite=True)
    refused(copy, capsys, "holds no experience")


def test_a_checkpoint_of_another_setting_is_refused(copy: Path, capsys) -> None:
    """It cannot come about by a command, whose settings name the directory."""
    forget(copy, "test-LR", "LR")
    stage = Stage(stage_of(copy, "LR"))
    stage.checkpoints().save(1000, {"update": np.zeros(3)})
    refused(copy, capsys, "another robot or setting")


def test_the_command_itself_exits_with_2() -> None:
    line = [sys.executable, "-m", "experiments.ant_lr", "--scale", "huge"]
    run = subprocess.run(line, capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 2 and run.stdout == "" and run.stderr.count("\n") == 1
    assert run.stderr.startswith("error: --scale takes")


# ── kill -9 ─────────────────────────────────────────────────────────────────────────────

ROOT = Path(__file__).parents[1]

# Where a run is killed: in the nth call of a stage's bar, or as a stage is to be marked done.
POINTS = ("collect:5", "generalize:1", "fit:2", "finish:LR", "evaluate:3")
BETWEEN = ("finish:experience", "finish:replay", "finish:test", "report:1")


@pytest.mark.parametrize(
    "points", [POINTS, pytest.param(BETWEEN, marks=pytest.mark.slow)], ids=["within", "between"]
)
def test_a_run_killed_in_every_stage_ends_with_the_same_bits(
    finished: Finished, tmp_path: Path, points: tuple[str, ...]
) -> None:
    env = {
        **os.environ,
        "GENIDM_CHECKPOINT_SECONDS": "0",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = [sys.executable, __file__, str(tmp_path), *points]
    run = subprocess.run(command, env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [f"{point}:killed" for point in points]
    compare(finished.out / "point", tmp_path / "point", "0.5")


def compare(whole: Path, killed: Path, scale: str) -> None:
    """All that LR left, to the bit; the experience may lie in other chunks."""
    for stage in ("replay-segments", "LR", "test-LR"):
        name = next(whole.glob(f"{stage}-0-*")).name
        a, b = arrays(whole / name), arrays(killed / name)
        assert a and a == b
    experiences = [next(root.glob("experience-PPO-0-*")) for root in (whole, killed)]
    for of in (record, lambda stage: arrays(stage / "policy")):
        a, b = map(of, experiences)
        assert a and a == b
    results = (root / f"report-{scale}" / "results.json" for root in (whole, killed))
    a, b = (json.loads(path.read_text())["methods"]["LR"] for path in results)
    # The invariance is measured on any record that lies there, not on the method's own.
    assert a | {"invariance": 0} == b | {"invariance": 0}


def arrays(stage: Path) -> dict[str, bytes]:
    return {n: x for n, x in files(stage).items() if n.endswith(".npy") and "checkpoint" not in n}


def record(stage: Path) -> dict[str, bytes]:
    chunks = sorted((stage / "experience").iterdir())
    names = (p.name for p in chunks[0].glob("*.npy"))
    return {n: np.concatenate([np.load(c / n) for c in chunks]).tobytes() for n in names}


def run_killed(out: Path, points: list[str]) -> None:
    """Runs the cell in a fork for each point, killed there; then to the end."""
    for slow in ("orbax.checkpoint", "tensorboardX", "genidm.report.write"):
        importlib.import_module(slow)  # once for all
    for point in [*points, None]:
        child = os.fork()
        if child == 0:
            collecting.CHUNK = 2 * 16 * 8
            if point:
                arm(*point.split(":"))
            run_cell(Point(), LR, options(out))
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if point:
            print(point, "killed" if status == -signal.SIGKILL else status, sep=":")
        elif status:
            sys.exit(status)


def arm(where: str, when: str) -> None:
    """Has this process killed at a point of its run."""
    from genidm.report import figures

    calls = itertools.count(1)

    def at(matches: Callable[..., bool], work: Callable) -> Callable:
        @functools.wraps(work)
        def dying(self, *args, **kwargs):
            if matches(self):
                os.kill(os.getpid(), signal.SIGKILL)
            return work(self, *args, **kwargs)

        return dying

    def nth(bar: Progress) -> bool:
        return bar._bar.desc.startswith(where) and next(calls) == int(when)

    if where == "finish":
        Stage.finish = at(lambda s: s.directory.name.startswith(f"{when}-"), Stage.finish)
    elif where == "report":
        figures.violins = at(lambda rows: True, figures.violins)
    else:
        Progress.advance = at(nth, Progress.advance)


ANT = (
    *("-m", "experiments.ant_lr", "--scale", "0.002", "--episodes", "10"),
    *("--method.look-ahead", "5", "--test.max-steps", "200"),
)


@pytest.mark.slow
def test_an_ant_killed_from_outside_in_every_stage_ends_with_the_same_bits(tmp_path: Path) -> None:
    env = {**os.environ, "GENIDM_CHECKPOINT_SECONDS": "0", "GENIDM_DEVICES": "2"}
    whole, killed = (
        [sys.executable, *ANT, "--out", str(tmp_path / n)] for n in ("whole", "killed")
    )
    subprocess.run(whole, env=env, cwd=ROOT, check=True, capture_output=True)
    root = tmp_path / "killed" / "ant"
    for stage in ("experience", "replay", "LR", "test"):
        with subprocess.Popen(killed, env=env, cwd=ROOT, stderr=subprocess.DEVNULL) as process:
            while not list(root.glob(f"{stage}-*/config.json")) and process.poll() is None:
                time.sleep(0.01)
            time.sleep(2.0 if stage == "test" else 0.1)  # some way into it
            process.kill()
        assert process.returncode == -signal.SIGKILL
        assert not list(root.glob(f"{stage}-*/done.json"))
    subprocess.run(killed, env=env, cwd=ROOT, check=True, capture_output=True)
    compare(tmp_path / "whole" / "ant", root, "0.002")


if __name__ == "__main__":
    run_killed(Path(sys.argv[1]), sys.argv[2:])
