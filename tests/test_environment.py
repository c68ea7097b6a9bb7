"""What the environment of a command may be: each was seen on somebody's machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from genidm.checkpoints import Checkpoints

ROOT = Path(__file__).parents[1]


def python(code: str, *, cwd: Path = ROOT, **env: str | None) -> subprocess.CompletedProcess:
    """Runs a line of Python with some variables set, or taken away."""
    given = {**os.environ, "PYTHONPATH": str(ROOT)} | env
    kept = {name: value for name, value in given.items() if value is not None}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=kept, cwd=cwd, capture_output=True, text=True)


CACHE = "import genidm.devices, jax; print(jax.config.jax_compilation_cache_dir)"
COMMAND = (
    "from genidm.runs.command import run_cli\n"
    "def run() -> None:\n    print('ran ≤')\n"
    "run_cli(run, 'A command.')"
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
    assert (
        made.stderr.startswith(f"error: {name} must be a number ") and made.stderr.count("\n") == 1
    )


SAVING = """
import sys, numpy as np
from genidm.runs.command import run_cli
from genidm.checkpoints import Checkpoints
where = sys.argv.pop()
def run() -> None:
    kept = Checkpoints(where)
    tree = {f"a{i}": np.ones((300, 1000), np.float32) for i in range(8)}
    for step in range(10_000):
        kept.save(step, tree)
        if not step:
            print("began", flush=True)
run_cli(run, "A command.")
"""


def interrupted(command: list[str], ready: bool, seconds: float) -> tuple[int, str]:
    """Exit status and stderr of a command that gets Ctrl-C."""
    made = subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)}, cwd=ROOT,
        # Tests that run in the background inherit that Ctrl-C is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        assert made.stdout
        if ready:
            assert made.stdout.readline() == "began\n"
        time.sleep(seconds)
        made.send_signal(signal.SIGINT)
        said = made.communicate(timeout=60)[1]
        return made.returncode, said
    finally:
        made.kill()


@pytest.mark.parametrize("seconds", [0.01, 0.06, 0.11])
def test_ctrl_c_in_a_checkpoint_is_a_sentence_and_leaves_it_whole(
    tmp_path: Path, seconds: float
) -> None:
    said = "stopped: run the same command again to resume\n"
    assert interrupted(["-c", SAVING, str(tmp_path)], True, seconds) == (130, said)
    assert all(path.name.startswith("step_") for path in tmp_path.iterdir())
    latest = Checkpoints(tmp_path).latest(
        {f"a{i}": np.ones((300, 1000), np.float32) for i in range(8)}
    )
    assert latest and (latest[1]["a7"] == 1).all()


def test_ctrl_c_while_a_command_is_read_in_is_a_sentence(tmp_path: Path) -> None:
    # A module that takes its time stands in for the seconds that jax takes.
    (tmp_path / "tyro.py").write_text("import time\nprint('began', flush=True)\ntime.sleep(60)")
    stand_in = (
        f"import sys, runpy; sys.path.insert(0, {str(tmp_path)!r}); sys.argv = ['-m']; "
        "runpy.run_module('experiments.ant_lr', run_name='__main__', alter_sys=False)"
    )
    said = "stopped before the command began\n"
    assert interrupted(["-c", stand_in], True, 0.0) == (130, said)


def test_an_error_from_inside_a_program_is_a_sentence() -> None:
    inside = COMMAND.replace(
        "    print(",
        "    import jax, jax.numpy as jnp\n"
        "    from genidm.errors import BadInput\n"
        "    def ask(x):\n        raise BadInput('no worker starts')\n"
        "    y = jax.jit(lambda x: jax.pure_callback(ask, x, x))(jnp.ones(3)); print(y); print(",
    )
    made = python(inside)
    assert (made.returncode, made.stdout) == (2, "")
    assert made.stderr.splitlines()[-1] == "error: no worker starts"


def test_more_memory_than_there_is_is_a_sentence() -> None:
    huge = COMMAND.replace(
        "print(", "import jax.numpy as jnp; print(jnp.zeros(10**14).sum()); print("
    )
    made = python(huge)
    assert made.returncode == 2 and made.stderr.splitlines()[-1].startswith("error: not enough mem")


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


@pytest.mark.parametrize("said", [COMMAND, f"import sys; sys.argv.append('--help')\n{COMMAND}"])
def test_output_that_nobody_reads_is_no_traceback_either(said: str) -> None:
    """So short that it is only written at the end."""
    shell = f'"{sys.executable}" -c "$CODE" | true; echo "${{PIPESTATUS[0]}}"'
    env = {**os.environ, "PYTHONPATH": str(ROOT), "CODE": f"import time; time.sleep(0.2)\n{said}"}
    made = subprocess.run(["bash", "-c", shell], env=env, capture_output=True, text=True)
    assert (made.stdout, made.stderr) == ("2\n", "")
