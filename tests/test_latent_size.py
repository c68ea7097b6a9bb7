"""Fig. 9: the fits that it is made from, and that they stay apart from Table 1."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from point import Point
from small_cells import STAGES
from tiny import AGENTS, TEST, tiny

from experiments import latent_size
from experiments.latent_size import KIND, Sweep, cells, run, sized, text
from genidm import files, robots
from genidm.agents.random import RandomActions
from genidm.errors import BadInput
from genidm.paper import methods
from genidm.report.runs import find
from genidm.runs.cell import make_run, scenarios_of
from genidm.runs.command import run_cli

LR = tiny(methods.LR, agent=AGENTS[RandomActions])


def options(out: Path, **changes) -> Sweep:
    this = Sweep(
        scale="0.25", run_dir=out / "runs", episodes=2, sizes=(10, 3), repeats=2, test=TEST
    )
    return dataclasses.replace(this, **changes)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("sizes")
    assert run(Point(), LR, options(out)) == out / "runs" / "point" / "latent_size-0.25"
    return out


def document(out: Path) -> dict:
    path = out / "runs" / "point" / "latent_size-0.25" / "point_latent_size.json"
    return json.loads(path.read_text())


def test_another_k_is_another_method_and_the_own_is_the_same() -> None:
    assert sized(methods.LR, 10) is methods.LR
    assert sized(methods.LR, 5).name == "LR k=5"
    assert sized(methods.LR, 5).fit.latent_size == 5


def test_all_fits_learn_from_one_experience_and_one_replay(finished: Path) -> None:
    found = Counter(
        path.parent.name.rsplit("-", 2)[0]
        for path in (finished / "runs" / "point").glob("*/done.json")
    )
    both = {"experience-RandomActions": 1, "replay-segments": 1}
    tests = {f"{KIND}-LR": 2, f"{KIND}-LR-k=3": 2}
    fits = {"LR": 1, "LR-0": 1, "LR-k=3": 1, "LR-k=3-0": 1}
    assert found == both | fits | tests


def test_the_first_fit_of_the_own_k_is_that_of_table_1(finished: Path) -> None:
    own = make_run(Point(), LR, options(finished)).controller_stage
    assert own.done
    config = files.load_json(own.path("config.json"))["config"]
    assert config.keys() == {
        *("robot", "seed", "source", "repeat"),
        *(f.name for f in dataclasses.fields(LR) if f.name not in ("agent", "task")),
    }
    first, second = cells(Point(), LR, options(finished))[10]
    assert first.controller_stage.directory == own.directory != second.controller_stage.directory
    again = files.load_json(second.controller_stage.path("config.json"))["config"]
    assert config["repeat"] == 0 and again == config | {"repeat": 1}


def test_repeats_are_independent_fits(finished: Path) -> None:
    """Other parameters from the first on, not the same ones fitted on."""
    for these in cells(Point(), LR, options(finished)).values():
        a, b = (files.load_arrays(c.controller_stage.path("controller"))[0] for c in these)
        kernel = a["params"]["lfm"]["params"]["Dense_0"]["kernel"]
        other = b["params"]["lfm"]["params"]["Dense_0"]["kernel"]
        assert kernel.shape == other.shape
        assert abs(np.corrcoef(kernel.ravel(), other.ravel())[0, 1]) < 0.5
        assert np.array_equal(a["mean"], b["mean"]), "the pairs are the same"


def test_the_document_holds_what_was_tested(finished: Path) -> None:
    written = document(finished)
    made = written["sizes"]["3"]["fits"][1]["made"]
    assert [name.partition("-")[0] for name in made] == ["experience", "replay", "LR", KIND]
    assert (written["robot"], written["training_seed"]) == ("point", 0)
    assert list(written["sizes"]) == ["3", "10"]
    assert written["settings"]["fit"]["latent_size"] == 10
    for k, these in cells(Point(), LR, options(finished)).items():
        point, closest = written["sizes"][str(k)], []
        for this in these:
            stage = this.run_test(scenarios_of(this, options(finished)), KIND)
            tree, _ = files.load_arrays(stage.path("episodes"))
            closest.append(tree["episodes"]["closest"].astype(float))
        assert point["means"] == pytest.approx([c.mean() for c in closest], abs=1e-6)
        assert point["mean"] == pytest.approx(np.mean(closest), abs=1e-6)
        assert point["std"] == pytest.approx(np.std(point["means"], ddof=1), abs=1e-5)
        assert [fit["episodes"] for fit in point["fits"]] == [2, 2]


def test_the_text_tells_what_is_over_fits_and_what_over_seeds(finished: Path) -> None:
    written = document(finished)
    lines = text(written).splitlines()[1:]
    assert [line.split()[2] for line in lines] == ["3", "10"]
    assert all("over fits" in line for line in lines)
    for point in written["sizes"].values():
        point["means"], point["std"] = point["means"][:1], None
    assert all("over test seeds" in line for line in text(written).splitlines()[1:])


def test_no_fit_of_the_figure_is_a_row_of_the_table(finished: Path) -> None:
    this = make_run(Point(), LR, options(finished))
    scenarios = scenarios_of(this, options(finished))
    assert not find(Point(), this.root, scenarios, this.scale.name, TEST).found


def test_a_second_run_only_draws_and_writes_where_it_is_told(finished: Path, monkeypatch) -> None:
    def never(*args, **kwargs):
        raise AssertionError("there is nothing to make")

    for name, module in STAGES.items():
        monkeypatch.setattr(module, name, never)
    run(Point(), LR, options(finished, report_dir=finished / "results"))
    names = {path.name for path in (finished / "results").iterdir()}
    assert names == {"point_latent_size.json", "point_latent_size.png"}
    written = (finished / "results" / "point_latent_size.json").read_text()
    assert json.loads(written) == document(finished)


@pytest.mark.parametrize("flags", [("--sizes", "0", "3"), ("--repeats", "0"), ("--robot", "cow")])
def test_bad_input_ends_in_a_sentence(tmp_path, monkeypatch, capsys, flags) -> None:
    monkeypatch.setitem(robots.ROBOTS, "point", Point)
    line = ["latent_size", "--robot", "point", "--run-dir", str(tmp_path), *flags]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(SystemExit) as end:
        run_cli(latent_size.latent_size, "")
    assert end.value.code == 2 and capsys.readouterr().err.startswith("error: ")
    assert not list(tmp_path.iterdir())


def test_sizes_must_be_given() -> None:
    with pytest.raises(BadInput, match="at least 1"):
        Sweep(sizes=())
