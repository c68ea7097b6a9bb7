"""What the environment of a command may be: each was seen on somebody's machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def python(code: str, *, cwd: Path = ROOT, **env: str | None) -> subprocess.CompletedProcess:
    """Runs a line of Python with some variables set, or taken away."""
    given = {**os.environ, "PYTHONPATH": str(ROOT)} | env
    kept = {name: value for name, value in given.items() if value is not None}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=kept, cwd=cwd, capture_output=True, text=True)


CACHE = "import genidm.devices, jax; print(jax.config.jax_compilation_cache_dir)"
COMMAND = (
    "from genidm.runs.command import guarded\n"
    "def run() -> None:\n    print('ran ≤')\n"
    "guarded(run, 'A command.')"
)


def test_importing_genidm_does_nothing_and_importing_what_computes_configures_jax() -> None:
    assert python("import sys, genidm; print('jax' in sys.modules)").stdout == "False\n"
    asked = "import genidm.robots, jax; print(jax.config.jax_default_matmul_precision)"
    made = python(asked, JAX_DEFAULT_MATMUL_PRECISION=None)
    assert made.stdout == "highest\n" and made.stderr == ""


def test_a_folder_of_the_same_name_in_the_working_directory_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "genidm").mkdir()
    asked = "import genidm.robots, jax; print(jax.config.jax_default_matmul_precision)"
    made = python(asked, cwd=tmp_path, JAX_DEFAULT_MATMUL_PRECISION=None)
    assert made.stdout == "highest\n", made.stderr


@pytest.mark.parametrize("cache", ["", "cache", "./cache"])
def test_a_cache_that_is_no_absolute_path_counts_as_not_set(cache: str, tmp_path: Path) -> None:
    home = {"XDG_CACHE_HOME": cache, "HOME": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": None}
    made = python(CACHE, cwd=tmp_path, **home)
    assert made.stdout == f"{tmp_path}/.cache/genidm/xla\n", made.stderr


def test_without_a_home_programs_are_not_kept_and_that_is_said_once() -> None:
    nobody = "import pwd\ndef none(_): raise KeyError\npwd.getpwuid = none\n"
    made = python(nobody + CACHE, HOME=None, XDG_CACHE_HOME=None, JAX_COMPILATION_CACHE_DIR=None)
    assert made.stdout == "None\n"
    assert made.stderr == "warning: no home directory: compiled programs are not kept\n"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("GENIDM_DEVICES", "auto"), ("GENIDM_DEVICES", "0"), ("GENIDM_DEVICES", "-1"),
        ("GENIDM_DEVICES", "1.5"), ("GENIDM_DEVICES", "99999999999"),
        ("GENIDM_CHECKPOINT_SECONDS", "soon"), ("GENIDM_CHECKPOINT_SECONDS", "nan"),
        ("GENIDM_CHECKPOINT_SECONDS", "-1"),
    ],
)  # fmt: skip
def test_a_variable_that_is_no_number_is_said_in_a_sentence(name: str, value: str) -> None:
    made = python(COMMAND, **{name: value})
    assert made.returncode == 2 and made.stdout == ""
    assert made.stderr.startswith(f"error: {name} is a number of ") and made.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["GENIDM_DEVICES", "GENIDM_CHECKPOINT_SECONDS"])
def test_an_empty_variable_counts_as_not_set(name: str) -> None:
    made = python(COMMAND, **{name: ""})
    assert (made.returncode, made.stdout, made.stderr) == (0, "ran ≤\n", "")


def test_a_terminal_without_a_character_shows_another() -> None:
    made = python(COMMAND, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert (made.returncode, made.stdout, made.stderr) == (0, "ran ?\n", "")


def test_a_backend_of_jupyters_is_not_inherited() -> None:
    drawn = COMMAND.replace("print(", "import matplotlib.pyplot as p; p.figure(); print(")
    made = python(drawn, MPLBACKEND="module://a_backend_that_is_not_there")
    assert (made.returncode, made.stdout) == (0, "ran ≤\n"), made.stderr


def test_output_into_something_that_ends_is_no_traceback() -> None:
    many = COMMAND.replace("print('ran ≤')", "[print('x' * 1000, flush=True) for _ in range(999)]")
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    shell = f'"{sys.executable}" -c "$CODE" | head -n 1'
    made = subprocess.run(
        ["bash", "-c", shell], env=env | {"CODE": many}, capture_output=True, text=True
    )
    assert made.stdout == "x" * 1000 + "\n" and made.stderr == ""
