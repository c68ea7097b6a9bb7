"""Command lines: what is run, what is said of it, and what is refused."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from point import Point
from small_cells import HER_SP, LR, Finished, command, files, stage_of
from tiny import TEST

from experiments import evaluate, walk, waypoints
from genidm import controller
from genidm.errors import BadInput
from genidm.evaluation.waypoints import WaypointSettings
from genidm.files import load_arrays, save_arrays
from genidm.paper import methods
from genidm.paper.methods import paper_settings
from genidm.robots import ROBOTS, Ant, Humanoid, Minitaur, Robot
from genidm.runs import command as command_module
from genidm.runs import run as run_module
from genidm.runs.cell import make_run
from genidm.runs.resolve import Options
from genidm.runs.scale import Scale, scale_of
from genidm.store import MADE, Stage

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("one_bank")


# ── what is run: scale, literal, what the user sets ──────────────────────────────────────


def test_the_method_with_paper_settings_is_the_papers() -> None:
    this = make_run(Point(), LR, Options(paper_settings=True)).method
    assert (
        this == paper_settings(LR, Point.name)
        and this.name == "LR paper"
        and this.goal_horizon == 1
    )
    kept = (
        this.generalize.mode,
        this.fit.latent_loss_weight,
        this.fit.mean_latent,
        this.fit.cosine_decay,
    )
    assert kept == ("episodes", 0.25, True, False)
    with pytest.raises(BadInput, match="changes nothing"):
        make_run(Point(), methods.VGCP, Options(paper_settings=True))


def test_scales_are_shares_of_the_paper() -> None:
    assert scale_of("paper", 2000) == Scale("paper", 2000, 1.0, 10, 1000)
    assert scale_of("1", 2000) == scale_of("1.0", 2000) == scale_of("paper", 2000)
    assert scale_of("0.1", 2000) == Scale(
        "0.1", 200, 0.1, 10, 100, goal_horizon=50, min_learning_fraction=2 / 3
    )
    million = scale_of("0.5", 2_000_000)
    assert million == Scale("0.5", 1_000_000, 0.5, 10, 500, min_learning_fraction=2 / 3)
    assert scale_of("2", 2_000_000) == Scale("2", 4_000_000, 1.0, 10, 1000)
    quick = scale_of("quick", 2_000_000)
    assert quick.interactions < 500_000 and quick.updates < 0.5 and quick.goal_horizon < 100
    this = make_run(Point(), dataclasses.replace(LR, goal_horizon=999), Options(scale="quick"))
    assert this.method.goal_horizon == quick.goal_horizon
    assert (this.method.skip, this.method.fraction) == (0.5, 0.5)  # the last half, at any scale
    first = make_run(Point(), LR, Options(scale="quick", paper_settings=True))
    assert first.method.fraction == quick.fraction == 1.0
    given = {
        name: make_run(Point(), methods.LR, Options(scale=name)) for name in ("quick", "paper")
    }
    assert given["quick"].method.agent == dataclasses.replace(quick.ppo, mirror=True)
    assert given["quick"].method.agent != methods.LR.agent
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
        (("--scale", "quick", "--method.agent.discounting", "0.99"), "agent.discounting", 0.99),
        (("--scale", "quick", "--method.agent.num-envs", "256"), "agent.discounting", 0.97),
        (("--scale", "quick", "--method.fraction", "0.5"), "fraction", 0.5),
        (("--scale", "0.1", "--method.goal-horizon", "80"), "goal_horizon", 80),
        (("--scale", "0.1", "--method.fit.updates", "5000"), "fit.updates", 5000),
        (
            (
                "--scale",
                "0.1",
            ),
            "fit.updates",
            1000,
        ),
        (("--paper-settings", "--method.goal-horizon", "7"), "goal_horizon", 7),
        (
            ("--paper-settings", "--method.fit.latent-loss-weight", "0.9"),
            "fit.latent_loss_weight",
            0.9,
        ),
        (
            ("--paper-settings", "--method.generalize.mode", "segments"),
            "generalize.mode",
            "segments",
        ),
        (("--method.generalize.segment", "20"), "generalize.segment", 20),
    ],
)
def test_what_the_user_sets_is_what_is_run(
    flags: tuple[str, ...], name: str, value: object, monkeypatch, tmp_path: Path
) -> None:
    ran: list[run_module.Run] = []
    (tmp_path / "table.txt").write_text("")
    monkeypatch.setattr(command_module, "execute", lambda c, _: ran.append(c) or tmp_path)
    monkeypatch.setattr(sys, "argv", ["ant_lr", *flags])
    command_module.main(Point, methods.LR)
    made = functools.reduce(getattr, name.split("."), ran[0].method)
    assert made == value


def test_who_has_set_what_is_known(monkeypatch, tmp_path: Path) -> None:
    ran: list[run_module.Run] = []
    (tmp_path / "table.txt").write_text("")
    monkeypatch.setattr(command_module, "execute", lambda c, _: ran.append(c) or tmp_path)
    monkeypatch.setattr(sys, "argv", ["lr", "--scale", "0.1", "--method.fit.batch-size", "64"])
    command_module.main(Point, methods.LR)
    chosen, given, papers = ran[0].notes
    assert chosen.startswith("LR, chosen for this scale and machine: fit.updates 1000 (10000), ")
    assert given == "LR, set by you: fit.batch_size 64 (512)"
    assert papers.startswith(
        "LR, unlike the paper (see --paper-settings): agent.mirror True (False)"
    )
    assert "fit.mean_latent False (True)" in papers


@pytest.mark.parametrize("seed", [-1, 2**32, 10**30, 1.5])
def test_seeds_have_32_bits(seed: float) -> None:
    with pytest.raises(BadInput, match="seed must be"):
        Options(seed=seed)
    assert Options(seed=2**32 - 1).seed == 2**32 - 1


@pytest.mark.parametrize("name", methods.ORDER)
@pytest.mark.parametrize("robot", [Ant, Humanoid, Minitaur])
def test_every_method_has_a_command(robot: type[Robot], name: str, monkeypatch) -> None:
    asked: list = []
    monkeypatch.setattr(command_module, "main", lambda *args: asked.append(args))
    runpy.run_module(f"experiments.{robot.name}_{name.lower()}", run_name="__main__")
    assert asked == [(robot, methods.by_name(name, robot.name))]


# ── the commands for finished runs ───────────────────────────────────────────────────────


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
    runs, walk = (stage_of(direct.out, "VGCP"),) * 2, waypoints.Walk(robots=2)
    settings = WaypointSettings(max_steps=20, chunk=10)
    waypoints.main(runs, walk, out=tmp_path, settings=settings)
    written = json.loads((tmp_path / "point_waypoints.json").read_text())
    assert list(written["methods"]) == ["VGCP", f"VGCP, {runs[0].name}"]
    one, again = written["methods"].values()
    assert one == again and one["runs"] == 2 and len(one["reached"]) == 5 and one["all"] == 0
    assert (tmp_path / "point_waypoints.png").stat().st_size > 10_000
    header, row, _ = capsys.readouterr().out.splitlines()[:3]
    assert header.split()[:9] == ["reached", "1", "2", "3", "4", "5", "all", "falls", "off"]
    assert row.split()[:8] == ["VGCP", *["0%"] * 7] and f"{one['speed']:.2f} m/s" in row
    with pytest.raises(BadInput, match="of a run"):
        waypoints.main((), walk, out=tmp_path)
    with pytest.raises(BadInput, match="an even number, not 3"):
        waypoints.main(runs, waypoints.Walk((3.0, 0.0, 5.0)), out=tmp_path)
    for wrong in ({"robots": 0}, {"planner": ()}, {"turning_radius": 0.0}, {"yaw": math.nan}):
        with pytest.raises(BadInput, match=next(iter(wrong))):
            waypoints.Walk(**wrong)


def test_planners_walk_the_same_course_from_the_same_starts(
    direct: Finished, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setitem(ROBOTS, "point", Point)
    walk = waypoints.Walk((1.0, 0.0, 1.0, 1.0), 2, 0.3, planner=("straight", "arc"), look_ahead=0.2)
    settings = WaypointSettings(max_steps=20, chunk=10)
    waypoints.main((stage_of(direct.out, "VGCP"),), walk, out=tmp_path, settings=settings)
    written = json.loads((tmp_path / "point_waypoints.json").read_text())
    assert list(written["methods"]) == ["VGCP, straight", "VGCP, arc"]
    assert written["waypoints"] == [[1, 0], [1, 1]]
    assert written["starts"] == {"robots": 2, "yaw": 0.3, "seed": 0}
    # A third of a leg, which is 0.6 times the point's greatest target distance.
    assert written["planners"] == {
        "straight": {},
        "arc": {"turning_radius": 1.0, "look_ahead": 0.2},
    }
    assert written["settings"]["max_steps"] == 20 and written["made"]["code"]


def test_the_course_bends_both_ways_and_fits_the_robot() -> None:
    legs = np.diff(waypoints.course(Point()), axis=0, prepend=np.zeros((1, 2)))
    np.testing.assert_allclose(np.linalg.norm(legs, axis=-1), 3.0, atol=2e-3)
    angles = np.degrees(np.diff(np.arctan2(legs[:, 1], legs[:, 0])))
    np.testing.assert_allclose(angles, [60, 60, -60, -60], atol=0.1)


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


# ── bad input: one sentence on stderr, exit status 2, nothing overwritten ────────────────


def refused(out: Path, capsys, why: str, *flags: str, **options) -> None:
    before = files(out) if out.is_dir() else {}
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        command(out, *flags, **options)
    said = [line for line in capsys.readouterr().err.splitlines() if line[:6] == "error:"]
    assert exit_.value.code == 2 and len(said) == 1 and why in said[0]
    after = files(out) if out.is_dir() else {}
    # Who has begun to work is written down, whatever becomes of it.
    kept = [name for name in before if not name.endswith(MADE)]
    assert {name: after.get(name) for name in kept} == {name: before[name] for name in kept}


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--scale", "huge"), "'huge'"),
        (("--scale", "-0.5"), "--scale"),
        (("--method.fit.latent-loss-weight", "1.5"), "λ"),
        (("--method.fit.latent-loss-weight", "0"), "λ"),
        (("--method.fit.latent-size", "0"), "k (latent_size)"),
        (("--method.goal-horizon", "0"), "goal_horizon"),
        (("--method.fraction", "2"), "fraction"),
        (("--method.agent.num-updates-per-batch", "0"), "num_updates_per_batch"),
        (("--episodes", "0"), "episodes must be at least 1"),
        (("--test.num-envs", "0"), "num_envs"),
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
        (("--method.agent.discounting", "1"), "discounting"),
        (("--method.agent.her.n-sampled-goal", "0"), "n_sampled_goal must be at least 1"),
        (("--method.agent.max-replay-size", "7"), "buffer"),
        (("--method.task.goal-radius", "0"), "goal_radius"),
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


def forget(out: Path, *names: str) -> None:
    """As if these stages had not been finished."""
    for name in names:
        (stage_of(out, name) / "done.json").unlink()


def test_nan_in_the_experience_is_refused(copy: Path, capsys) -> None:
    forget(copy, "test-LR", "LR", "replay")
    chunk = stage_of(copy, "experience-PPO") / "experience" / "chunk_00000"
    tree, meta = load_arrays(chunk)
    tree["o"][-3, 2, 1] = np.nan
    save_arrays(chunk, tree, meta, overwrite=True)
    refused(copy, capsys, "o holds NaN")


def test_a_corrupt_experience_is_refused(copy: Path, capsys) -> None:
    forget(copy, "test-LR", "LR", "replay")
    file = stage_of(copy, "experience-PPO") / "experience" / "chunk_00000" / "s.npy"
    file.write_bytes(file.read_bytes()[:-1])
    refused(copy, capsys, "cut short")


def test_a_corrupt_controller_is_refused(copy: Path, capsys) -> None:
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
    refused(copy, capsys, "physics of another robot, not point")
    save_arrays(chunk, {**tree, "s": tree["s"][..., 1:]}, meta, overwrite=True)
    refused(copy, capsys, "s has shape")
    save_arrays(chunk, {"x": tree["s"]}, meta, overwrite=True)
    refused(copy, capsys, "does not hold an experience")


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
