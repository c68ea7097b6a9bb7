"""What a kill costs a cell, wherever it strikes: nothing.

Run as a script, `python tests/test_kills.py OUT POINT...`, this module runs a cell again
and again, killed by SIGKILL at each point in turn, and lets the last run end.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from killing import Killed, dies_at
from point import Point
from small_cells import LR, VGCP, Finished, arrays, counted, options, stage_of

from genidm.agents import collect as collecting
from genidm.progress import Progress
from genidm.runs.cell import run_method
from genidm.store import Stage

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("one_bank")


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
                run_method(Point(), VGCP, options(tmp_path))
    with counted() as calls:
        run_method(Point(), VGCP, options(tmp_path))
    assert calls == Counter(run=1)
    for stage in ("VGCP", "test-VGCP"):
        whole, killed = (arrays(stage_of(out, stage)) for out in (direct.out, tmp_path))
        assert whole and whole == killed


def dying(*args, **kwargs):
    raise Killed


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
    assert a | {"invariance": 0, "made": 0} == b | {"invariance": 0, "made": 0}


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
            run_method(Point(), LR, options(out))
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if point:
            said = "killed" if status == -signal.SIGKILL else status
            print(point, said, sep=":", flush=True)  # or a child would print it again
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
        return bar.name.startswith(where) and next(calls) == int(when)

    if where == "finish":
        Stage.finish = at(lambda s: s.directory.name.startswith(f"{when}-"), Stage.finish)
    elif where == "report":
        figures.violins = at(lambda rows: True, figures.violins)
    else:
        Progress.advance = at(nth, Progress.advance)


ANT = (
    *("-m", "experiments.ant_lr", "--scale", "0.002", "--episodes", "10"),
    *("--method.goal-horizon", "5", "--test.max-steps", "200"),
)


@pytest.mark.slow
def test_an_ant_killed_from_outside_in_every_stage_ends_with_the_same_bits(tmp_path: Path) -> None:
    env = {**os.environ, "GENIDM_CHECKPOINT_SECONDS": "0", "GENIDM_DEVICES": "2"}
    whole, killed = (
        [sys.executable, *ANT, "--run-dir", str(tmp_path / n)] for n in ("whole", "killed")
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
