"""`python -m experiments.train`: any robot and method, as a named cell runs them."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
from point import Point

from experiments import train
from genidm.paper import methods
from genidm.robots import ROBOTS, Ant, Humanoid, Minitaur
from genidm.runs import command


def run(*flags: str) -> None:
    with pytest.MonkeyPatch.context() as m:
        m.setattr(sys, "argv", ["train.py", *flags])
        train.main()


def asked(module: str, *flags: str) -> tuple[Any, ...]:
    """The robot, the method and the flags that a command gives to `command.main`."""
    seen: list[Any] = []
    with pytest.MonkeyPatch.context() as m:
        m.setattr(sys, "argv", ["a command", *flags])
        m.setattr(command, "main", lambda *given: seen.append((*given, sys.argv[1:])))
        runpy.run_module(f"experiments.{module}", run_name="__main__")
    (call,) = seen
    return call


@pytest.mark.parametrize("method", methods.ORDER)
@pytest.mark.parametrize("robot", [Ant, Humanoid, Minitaur])
def test_it_runs_what_the_named_cell_runs(robot: type[Any], method: str) -> None:
    flags = ["--scale", "0.1", "--method.fit.updates", "7", "--out=x"]
    named = asked(f"{robot.name}_{method.lower()}", *flags)
    assert named == (robot, methods.by_name(method, robot.name), flags)
    for given in (
        ["--robot", robot.name, "--method", method, *flags],
        [*flags, f"--method={method}", f"--robot={robot.name}"],
        [*flags[:2], "--robot", robot.name, *flags[2:], "--method", method],
    ):
        assert asked("train", *given) == named


def test_a_robot_without_a_file_of_its_own_is_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ROBOTS, "point", Point)
    small = ("--test.max-steps", "40", "--test.num-envs", "16", "--test.chunk", "10")
    run("--robot", "point", "--method", "RS", "--scale", "0.5", "--episodes", "2", *small,
        "--method.fit.updates", "20", "--method.goal-horizon", "5", "--method.agent.num-envs", "16",
        "--run-dir", str(tmp_path))  # fmt: skip
    assert capsys.readouterr().out.count("\nRS ") == 1
    stages = {
        path.parent.name.rsplit("-", 1)[0] for path in (tmp_path / "point").glob("*/done.json")
    }
    assert stages == {"experience-RandomActions-0", "RS-0", "test-RS-0"}


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ([], "give --robot and --method; robots: ant, ant_v2, humanoid, humanoid_world, "),
        (["--robot", "ant"], "give --robot and --method; robots: ant, "),
        (["--method", "LR"], "give --robot and --method; robots: ant, "),
        (["--robot", "any", "--method", "LR"], "no robot is called 'any'; robots: ant, ant_v2, "),
        (["--robot", "ant", "--method", "XX"], "no method is called 'XX'; there are: RS, RL, VGCP"),
        (["--robot", "ant", "--method", "lr"], "no method is called 'lr'; there are: RS, RL, VGCP"),
        (["--method", "LR", "--robot"], "argument --robot: expected one argument"),
        (["--robot", "ant", "--method", "--scale", "1"], "argument --method: expected one"),
        (["--robot", "ant", "--method", "LR", "--scale", "x"], "--scale takes "),
    ],
)  # fmt: skip
def test_what_cannot_be_run_is_said_in_a_sentence(
    flags: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        run(*flags)
    said = capsys.readouterr()
    assert (stop.value.code, said.out) == (2, "")
    assert said.err.startswith(f"error: {sentence}") and said.err.count("\n") == 1


def test_help_lists_robots_and_methods_then_the_flags(capsys: pytest.CaptureFixture[str]) -> None:
    run("--help")
    shown = capsys.readouterr().out
    for name in (*ROBOTS, *methods.ORDER):
        assert name in shown
    with pytest.raises(SystemExit) as stop:
        run("--robot", "ant", "--method", "LR", "--help")
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert "--method.fit.latent-size" in shown and "--scale" in shown
