"""Old flags: each is refused in a sentence that names the new one, and a command takes that."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pytest
import tyro

from experiments import physics, table1, waypoints
from experiments.benchmark.bench import Options
from genidm.errors import BadInput
from genidm.paper.methods import HUMANOID, LR, VGCP, by_name
from genidm.renamed import RENAMED, refuse
from genidm.runs.command import _settings, run_cli
from genidm.video import __main__ as video


def benchmark(
    options: Annotated[Options, tyro.conf.arg(name="")] = Options(),
) -> None:
    """Takes the flags of the benchmark."""


COMMANDS: list[Callable[..., Any]] = [
    *(_settings(method) for method in (LR, VGCP, by_name("HER_SP"), by_name("HER_DE"))),
    *(_settings(method) for method in HUMANOID if method.name in ("RL", "HER_SP")),
    table1.main, waypoints.main, video.main, benchmark, physics.physics,
]  # fmt: skip
# Agents that no method freezes have settings that stand below two dots on no command line.
FROZEN_ALONE = {"epochs", "minibatches", "gae", "clip", "entropy", "value-hidden", "max-gradient",
                "her.goals", "her.strategy"}  # fmt: skip


@functools.cache
def flags(index: int) -> set[str]:
    """All flags that a command takes, as its help lists them."""
    text = tyro_help(COMMANDS[index])
    return {word.strip(",[]") for word in text.split() if word.startswith(("--", "[--"))}


def tyro_help(command: Callable[..., Any]) -> str:
    config = (tyro.conf.AvoidSubcommands,)
    with pytest.MonkeyPatch.context() as m:
        m.setenv("COLUMNS", "1000")
        pieces: list[str] = []
        m.setattr(sys.stdout, "write", pieces.append)
        with pytest.raises(SystemExit):
            tyro.cli(command, args=["--help"], config=config)
    return "".join(pieces)


def taking(flag: str) -> list[Callable[..., Any]]:
    return [command for i, command in enumerate(COMMANDS) if flag in flags(i)]


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_flag_is_refused_where_the_new_one_is_taken(old: str) -> None:
    new = RENAMED[old]
    if old.startswith("--method.agent.agent.") and old[21:] in FROZEN_ALONE:
        assert not taking(new)
        return
    commands = taking(new)
    assert commands, f"no command takes {new}"
    for command in commands:
        for argument in (old, f"{old}=3", old.replace("-", "_").replace("__", "--", 1)):
            with pytest.raises(BadInput, match=rf"^{old} is now called {new}$"):
                refuse(command, ["--seed", "1", argument])
        refuse(command, [new, "3"])


def test_no_command_takes_an_old_flag_and_the_new_one() -> None:
    for old, new in RENAMED.items():
        for i in range(len(COMMANDS)):
            assert not {old, new} <= flags(i)


def test_a_switch_is_turned_off_by_its_new_name() -> None:
    for old, new in (
        ("--method.fit.no-averaged", "--method.fit.no-mean-latent"),
        ("--no-literal", "--no-paper-settings"),
    ):
        assert new in flags(0)
        with pytest.raises(BadInput, match=rf"^{old} is now called {new}$"):
            refuse(COMMANDS[0], [old])


def test_a_command_with_files_to_write_keeps_its_out() -> None:
    refuse(video.main, ["run", "--out", "a.gif"])
    refuse(waypoints.main, ["run", "--out", "there"])


def test_the_command_line_ends_in_a_sentence(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "argv", ["table1", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        run_cli(table1.main, "")
    assert ended.value.code == 2
    assert capsys.readouterr().err == "error: --out is now called --run-dir\n"
