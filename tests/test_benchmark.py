"""That the benchmark measures what it says, on a robot that costs nothing. No speed is tested."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point

from experiments.benchmark import __main__ as command
from experiments.benchmark import collecting, comparing, fitting, others, sb3, starting, stepping
from experiments.benchmark.bench import Bench, Options
from experiments.benchmark.comparing import Row
from experiments.benchmark.measuring import Probe, Skip, interleave, timed
from experiments.benchmark.rows import ANT, HUMANOID, OTHERS, ROWS, choose
from genidm.errors import BadInput
from genidm.paper.idm import Architecture
from genidm.paper.methods import GE, LR
from genidm.robots import Ant
from genidm.robots.mujoco import Solver

KEYS = ["name", "value", "unit", "ratio_to", "ratio", "hardware", "commit", "command"]


@pytest.fixture
def small(tmp_path, monkeypatch):
    """Sizes at which every row takes a moment."""
    monkeypatch.setattr(stepping, "STEPS", 3)
    monkeypatch.setattr(collecting, "CHUNK", 1000)
    monkeypatch.setattr(fitting, "UPDATES", 2)
    monkeypatch.setattr(fitting, "SAMPLES", 600)
    return Options(
        out=tmp_path / "out" / "benchmark.json",
        seconds=1e-3,
        num_envs=8,
        wide=16,
        scenarios=(1, 20),
    )


def rows_of(values):
    """A row for each value: the numbers that it gives, one a sample."""

    def build(name):
        numbers = iter(values[name])
        return lambda bench: Probe(lambda seconds: next(numbers), "as told")

    return build


def test_every_row_on_a_point(small, monkeypatch, capsys):
    numbers = {"seconds": 8.0, "wall": 9.0, "programs": 3.0}
    both = numbers, dict.fromkeys(numbers, 0.5)
    monkeypatch.setattr(starting, "starts", lambda bench: both)
    # Torch, Stable-Baselines3 and EnvPool need not be there, so here they never are.
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(ROWS, "point", ANT)
    results = command.benchmark(Point(), small)
    assert json.loads(small.out.read_text()) == results
    assert all(list(r) == KEYS for r in results)
    assert all(r["value"] > 0 for r in results)
    skipped = re.findall(r"skipped: (.*?): (.*)", capsys.readouterr().err)
    # No engine steps a point, but others are compared with its raw steps all the same.
    absent = {n for n in (row.name for row in ANT) if re.match("raw |MuJoCo|EnvPool|PPO($| of)", n)}
    compared = {row.name for row in ANT if row.ratio_to}
    assert {name for name, _ in skipped} == absent & compared
    assert dict(skipped)["raw MJX"] == "the point is not stepped by mujoco"
    assert "pip install" in dict(skipped)["PPO"]
    there = {r["name"].partition(" (")[0]: r for r in results}
    assert set(there) == {row.name for row in ANT} - absent
    assert {n for n, r in there.items() if r["ratio"] is not None} == compared - absent
    names = {r["name"] for r in results}
    assert {r["ratio_to"] for r in results} <= names | {None}
    assert there["second start, compiling"]["ratio"] == 0.5 / 8
    assert 0 < there["evaluation, useful"]["ratio"] <= 1
    assert there["evaluation"]["name"] == "evaluation (16 lanes, an untrained controller)"
    assert there["own engine, raw"]["name"].endswith("(robot.step, 8 lanes, 2 devices)")


def test_the_humanoids_rows_on_a_point(small, monkeypatch):
    monkeypatch.setitem(ROWS, "point", HUMANOID)
    texts = ("SAC", "fit of LR")
    results = command.benchmark(Point(), dataclasses.replace(small, rows=texts))
    ratios = {r["name"].partition(" (")[0]: r["ratio"] for r in results}
    against_raw = {
        row.name for row in HUMANOID if row.ratio_to == "own engine, raw" and "SAC" in row.name
    }
    assert {name for name in against_raw if ratios[name] > 0} == against_raw
    assert {"SAC, learning", "SAC, frozen", "fit of LR"} <= set(ratios)


def test_a_robot_without_rows_and_the_place_of_the_others(ant):
    with pytest.raises(BadInput, match="rows for robots with a MuJoCo model"):
        command.benchmark(Point(), Options())
    assert command.place(ant, Options()) == Path("experiments/results/ant_benchmark.json")


def test_mujoco_batch_steps_the_robots_own_model(ant, small):
    made = []

    class Batch(stepping.Batch):
        def __init__(self, model, count, nthread):
            assert (model, count, nthread) == (ant.mj_model, small.num_envs, 1)
            super().__init__(model, count, nthread)
            made.append(self)

    with contextlib.ExitStack() as exits, pytest.MonkeyPatch.context() as patch:
        patch.setattr(stepping, "Batch", Batch)
        patch.setattr(stepping, "on_engine", lambda bench, name: ant)
        probe = stepping.batch(Bench(ant, small, exits), threads=1)
        assert probe.sample(0.0) > 0
    calls = 2  # once to warm up, once timed
    np.testing.assert_allclose(made[0].time, calls * stepping.STEPS * ant.dt)
    assert made[0].ctrl.any() and probe.note == "8 lanes, 1 thread"


def test_a_row_takes_the_engine_that_it_names(small):
    solver = Solver(iterations=2)
    with contextlib.ExitStack() as exits:
        bench = Bench(Ant(solver, "mujoco"), small, exits)
        other = stepping.on_engine(bench, "mjx")
        assert other.settings == {**bench.robot.settings, "engine": "mjx"}
        assert stepping.limit(bench, wide=True).note.startswith("mujoco.batch, 16 lanes, ")
        probe = stepping.stepping(bench, engine="mujoco")
        assert probe.sample(0.0) > 0 and "8 lanes, " in probe.note
        with pytest.raises(Skip, match="needs 9 devices"):
            stepping.stepping(bench, count=9)
        with pytest.raises(Skip, match="1000 threads need"):
            stepping.batch(bench, threads=1000)


def test_envpool_takes_the_same_number_of_robots(small):
    pytest.importorskip("envpool", reason="EnvPool is not installed")
    with contextlib.ExitStack() as exits:
        probe = others.envpool(Bench(Point(), small, exits))
        assert probe.sample(0.0) > 0 and "8 lanes" in probe.note


def test_products_are_those_of_the_networks(ant):
    for settings in (LR.fit, GE.fit):
        size = ant.action.size
        networks = Architecture(size, settings.idm, settings.lfm, settings.latent_size)
        params = networks.init(jax.random.key(0), ant.observation.size)
        matrices = [x.shape for x in jax.tree.leaves(params) if x.ndim == 2]
        psi, phi = fitting.products(ant, settings)
        assert sorted(psi + phi) == sorted(matrices)


def test_ratio_is_the_median_of_the_pairs(small):
    values = rows_of({"base": [1.0, 10.0, 100.0], "row": [2.0, 30.0, 400.0]})
    base = Row("base", "m/s", values("base"))
    row = Row("row", "m/s", values("row"), ratio_to="base", rounds=3)
    with contextlib.ExitStack() as exits:
        bench = Bench(Point(), Options(seconds=60.0), exits)
        first, second = comparing.measure(bench, [base, row])
    assert (first["value"], second["value"], second["ratio"]) == (10.0, 30.0, 3.0)
    assert (first["ratio_to"], second["ratio_to"]) == (None, "base (as told)")


def test_rounds_go_to_and_fro_until_the_seconds_are_over():
    calls = []

    def probe(name):
        return Probe(lambda seconds: calls.append((name, seconds)) or float(len(calls)), "")

    both = [probe("a"), probe("b")]
    np.testing.assert_array_equal(interleave(both, 60.0, 3), [[1, 2], [4, 3], [5, 6]])
    assert [name for name, _ in calls] == list("abbaab")
    assert {seconds for _, seconds in calls} == {10.0}
    assert interleave(both, 1e-9, 3).shape == (1, 2)


def test_timed_counts_whole_calls():
    calls = []
    sample = timed(lambda: calls.append(0), 5.0)
    assert len(calls) == 1  # compiled before it is timed
    began = time.perf_counter()
    rate, timed_calls = sample(1e-4), len(calls) - 1
    assert timed_calls >= 1 and rate >= 5.0 * timed_calls / (time.perf_counter() - began)


def test_choose_takes_what_a_row_is_compared_with():
    names = [row.name for row in choose(["two devices"], ANT)]
    assert names == ["raw MJX, one device", "raw MJX, two devices"]
    # A whole name is that row alone.
    alone = {row.name for row in choose(["raw MJX"], ANT)}
    assert alone == {"raw mujoco.batch", "MuJoCo in C", "raw MJX"}
    assert choose([], ANT) == list(ANT)
    with pytest.raises(BadInput, match=r"no row is called 'nothing'; there are: raw mujoco.batch;"):
        choose(["nothing"], ANT)


@pytest.mark.parametrize("rows", [*ROWS.values(), OTHERS])
def test_rows_name_each_other(rows):
    names = [row.name for row in rows]
    assert len(set(names)) == len(names)
    assert {row.ratio_to for row in rows} <= {*names, None}
    assert not any(" (" in name for name in names)  # where the table cuts


def test_table():
    rows = [
        ("raw (8 lanes)", 12345.6, "steps/s", None, None),
        ("PPO (8 lanes)", 61.72, "steps/s", "raw (8 lanes)", 0.005),
    ]
    results = [
        dict(zip(KEYS, (*row, "a machine", "a" * 40, "a command"), strict=True)) for row in rows
    ]
    assert comparing.table(results).splitlines() == [
        "row             value  unit     ratio  to",
        "─" * 42,
        "raw (8 lanes)  12,346  steps/s",
        "PPO (8 lanes)    61.7  steps/s  0.005  raw",
    ]


def test_compiling_counts():
    with starting.compiling() as counted:
        jax.jit(lambda x: jnp.sin(x) + 41)(1.0)
    assert 0 < counted["seconds"] < counted["wall"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--rows", "nothing"], "no row is called 'nothing'"),
        (["--num-envs", "7"], "7 lanes cannot be shared among 2 devices"),
        (["--seconds", "-1"], "seconds must be a number above 0"),
        (["--out", "."], "is a directory"),
        (["--run", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_one_sentence(arguments, said, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark", *arguments])
    monkeypatch.setattr(command, "by_name", lambda name, engine: Point())
    monkeypatch.setitem(ROWS, "point", ANT)
    monkeypatch.setattr(command, "measure", None)  # not reached
    with pytest.raises(SystemExit) as stop:
        command.main()
    assert stop.value.code == 2
    assert said in capsys.readouterr().err


def test_a_robot_without_a_model_has_no_rows():
    with pytest.raises(BadInput, match="rows for robots with a MuJoCo model, not for point"):
        command.benchmark(Point(), Options(out=Path("nowhere.json")))


def test_the_baseline_runs_without_jax():
    code = f"import sys, {sb3.__name__}; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_fastest_baseline_is_taken(monkeypatch):
    rates = {1: 500.0, 4: 900.0, 8: 0.0}

    class Fake(contextlib.nullcontext):
        note, steps = "fake", 10

        def __init__(self, environments, vector, threads):
            super().__init__(self)
            self.environments = environments

        def rate(self, limit):
            return rates[self.environments]

    monkeypatch.setattr(sb3, "Baseline", Fake)
    settings, said = sb3.candidates(2), []
    assert {n for n, _, _ in settings} == {1, 4, 8}
    assert sb3.fastest(settings, said.append)[0] == 4
    assert len(said) == len(settings) and said[-1] == "fake: too slow to wait for"
    with pytest.raises(sb3.Ended):
        sb3.fastest([(8, "", 1)], said.append)
