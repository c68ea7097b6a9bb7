"""Where PyBullet is not installed."""

from __future__ import annotations

import sys

import pytest

from genidm.errors import BadInput
from genidm.paper.methods import by_name
from genidm.robots import Minitaur
from genidm.runs import command


@pytest.fixture
def absent(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)


def test_asking_for_the_minitaur_says_what_to_install(absent: None) -> None:
    with pytest.raises(BadInput, match=r'pip install "genidm\[minitaur\]".*3\.11.*Linux x86-64'):
        Minitaur()


def test_its_command_ends_in_one_sentence(absent: None, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["minitaur_rs", "--run-dir", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        command.main(Minitaur, by_name("RS", "minitaur"))
    said = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2
    assert len(said) == 1 and said[0].startswith("error: the Minitaur needs PyBullet")
    assert not list(tmp_path.iterdir())
