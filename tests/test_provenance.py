"""What made a result: code that it depends on, commit, versions, command."""

from __future__ import annotations

import ast
import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from genidm import provenance
from genidm.agents.ddpg import DDPG
from genidm.agents.ppo import PPO
from genidm.agents.sac import SAC
from genidm.paper import methods
from genidm.provenance import changed, code_digest, code_of
from genidm.robots import Ant
from genidm.runs.cell import make_run
from genidm.runs.resolve import Options

ROBOT = Ant(engine="mujoco")
COLLECT = "genidm.agents.collect"


def test_code_is_what_is_imported_one_through_another() -> None:
    code = code_of(COLLECT, PPO(), ROBOT, ROBOT.engine)
    for name in ("agents.ppo", "agents.unroll", "rollout", "tasks", "robots.ant", "symmetry"):
        assert f"genidm.{name}" in code
    assert {"genidm.robots.mujoco", "genidm.robots.base", "genidm.engines.mujoco"} < code.keys()
    others = ("agents.sac", "robots.humanoid", "engines.mjx", "paper.fit", "report.table")
    assert not {f"genidm.{name}" for name in others} & code.keys()
    assert not provenance.UNRELATED & code.keys()
    assert all(re.fullmatch("[0-9a-f]{10}", digest) for digest in code.values())


@pytest.mark.parametrize(
    ("settings", "there", "absent"),
    [
        (SAC(), "genidm.agents.sac", "genidm.agents.ddpg"),
        (DDPG(), "genidm.agents.ddpg", "genidm.agents.sac"),
        (methods.LR.fit, "genidm.paper.fit", "genidm.agents.ppo"),
        ({"a": [1, (methods.VGCP.task,)]}, "genidm.tasks", "genidm.paper.fit"),
    ],
)
def test_settings_bring_the_modules_that_define_them(settings, there, absent) -> None:
    code = code_of(settings)
    assert there in code and absent not in code


def test_a_stage_depends_on_its_own_code(tmp_path: Path) -> None:
    run = make_run(ROBOT, methods.LR, Options(run_dir=tmp_path, scale="0.001"))
    collected, fitted = run.experience_stage.code, run.controller_stage.code
    assert {"genidm.agents.ppo", "genidm.runs.recording", "genidm.robots.ant"} <= collected.keys()
    others = {"genidm.paper.fit", "genidm.agents.sac", "genidm.evaluation.evaluate"}
    assert not others & collected.keys()
    assert {"genidm.paper.fit", "genidm.paper.idm", "genidm.runs.fitting"} <= fitted.keys()
    assert not {"genidm.agents.ppo", "genidm.evaluation.evaluate"} & fitted.keys()


def test_a_subclass_elsewhere_brings_its_own_module_and_its_base() -> None:
    @dataclasses.dataclass(frozen=True)
    class Mine(PPO):
        pass

    code = code_of(Mine())
    assert {__name__, "genidm.agents.ppo"} < code.keys()


PACKAGE = {
    "__init__.py": "",
    "a.py": '"""A."""\nfrom genidm import b\n\n\ndef f():\n    """F."""\n    return b.x  # why\n',
    "b.py": "x = 1\n",
    "c.py": "y = 2\n",
}
PRINT = "import json, genidm.provenance as p; print(json.dumps(p.code_of('genidm.a')))"


def code_with(tmp_path: Path, **changed: str) -> dict[str, str]:
    """The code of `genidm.a` in a package of three modules, some of them changed."""
    package = tmp_path / "genidm"
    package.mkdir(exist_ok=True)
    (package / "provenance.py").write_text(Path(provenance.__file__).read_text())
    for name, text in (PACKAGE | {f"{k}.py": v for k, v in changed.items()}).items():
        (package / name).write_text(text)
    out = subprocess.run(
        [sys.executable, "-B", "-c", PRINT], cwd=tmp_path, capture_output=True, check=True,
        env={"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin:/bin"},
    ).stdout  # fmt: skip
    code: dict[str, str] = json.loads(out)
    return code


def test_an_edit_changes_what_depends_on_it_and_prose_changes_nothing(tmp_path: Path) -> None:
    before = code_with(tmp_path)
    assert before.keys() == {"genidm.a", "genidm.b"}
    assert changed(before, code_with(tmp_path, b="x = 2\n")) == ["genidm.b"]
    assert changed(before, code_with(tmp_path, c="y = 3\n")) == []
    prose = PACKAGE["a.py"].replace("F.", "What f does.").replace("# why", "# why, at length")
    assert changed(before, code_with(tmp_path, a=prose)) == []
    assert changed(before, code_with(tmp_path, a=PACKAGE["a.py"].replace("b.x", "-b.x"))) == [
        "genidm.a"
    ]
    assert code_digest(before) != code_digest(code_with(tmp_path, b="x = 2\n"))


def test_an_edit_while_a_process_runs_is_not_its_code(tmp_path: Path) -> None:
    before = code_with(tmp_path)
    edit = "import genidm.provenance as p; open('genidm/b.py', 'w').write('x = 3'); "
    out = subprocess.run(
        [sys.executable, "-B", "-c", edit + PRINT], cwd=tmp_path, capture_output=True, check=True,
        env={"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin:/bin"},
    ).stdout  # fmt: skip
    assert json.loads(out) == before
    assert (tmp_path / "genidm" / "b.py").read_text() == "x = 3"


def test_a_digest_does_not_see_what_python_versions_add_to_a_tree() -> None:
    source = "def f(x, *, y=1):\n    return [x, y]\n"
    plain, with_more = ast.parse(source), ast.parse(source)
    function = with_more.body[0]
    function._fields = (*function._fields, "type_params")  # as Python 3.12 has it
    function.type_params = []  # type: ignore[attr-defined]
    assert provenance.dump(plain) == provenance.dump(with_more)
    assert provenance.dump(plain) != provenance.dump(ast.parse(source.replace("1", "2")))


def test_environment_names_versions_and_hardware() -> None:
    here = provenance.environment()
    assert here["versions"]["jax"] == jax.__version__
    assert f"{jax.device_count()} jax devices" in here["hardware"]
    assert here["commit"] is None or re.fullmatch("[0-9a-f]{40}", here["commit"])
    assert here["clean"] in ((None,) if here["commit"] is None else (True, False))
    assert json.loads(json.dumps(here)) == here


def test_a_command_can_be_given_again() -> None:
    out = subprocess.run(
        [sys.executable, "-m", "experiments.table1", "--robot", "no such"], capture_output=True
    )
    assert out.returncode == 2
    asked = "import sys; sys.argv[1:] = ['a b', '--x']; from genidm.provenance import command; "
    out = subprocess.run([sys.executable, "-c", asked + "print(command())"], capture_output=True)
    assert out.stdout.decode().strip().endswith("'a b' --x")
