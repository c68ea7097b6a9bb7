"""The table's schema and text, and that figures show what they are given."""

import dataclasses
import itertools
import json
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from genidm import report
from genidm.evaluation import stats
from genidm.evaluation.episodes import Episodes
from genidm.report import drawing, figures, table

METHODS = {"RS": 3.0, "RL": 2.0, "GE": 1.0, "LR": 0.6, "HF": 0.3}
EXTRA = {"reached", "diverged", "steps", "training_seed"}
KEYS = {
    *("interactions", "replayed", "seeds", "episodes", "mean", "std", "ci95", "iqm"),
    *("success", "fell", "settings"),
}
HERE = {"commit": "a" * 40, "clean": True, "versions": {"numpy": "2.0"}, "hardware": "four cores"}
CODE = {"genidm.paper.fit": "1111", "genidm.tasks": "2222"}


def made(code: dict[str, str] = CODE, **here) -> dict[str, dict]:
    """What made a row's stages: its fit in two sittings, and its test."""
    session = HERE | {"command": "python -m experiments.table1"} | here
    first, last = session | {"seconds": None}, session | {"seconds": 60.0}
    return {
        "LR-0-ab": report.origin(code, [first, last]),
        "test-LR-0-cd": report.origin({}, [last]),
    }


def outcome(mean: float, rng: int = 0, seeds: int = 4, episodes: int = 50) -> Episodes:
    generator = np.random.default_rng(rng)
    closest = generator.gamma(4.0, mean / 4, (seeds, episodes))
    no = np.zeros(closest.shape, bool)
    steps = np.full(closest.shape, 300)
    return Episodes(
        closest=closest,
        start=np.full(closest.shape, 3.5),
        reached=closest < 0.1,
        fell=no,
        diverged=no,
        steps=steps,
        path_length=closest,
    )


def row(method: str, seeds: int = 1, **changes) -> report.Row:
    runs = {seed: outcome(METHODS.get(method, 1.5), seed) for seed in range(seeds)}
    replayed = 1_000_000 if method in ("GE", "LR") else 0
    settings = {"latent_loss_weight": np.float32(0.25), "hidden": (50, 50), "k": np.int64(10)}
    this = report.Row(method, runs[0], 2_000_000, replayed, settings, runs)
    return dataclasses.replace(this, **changes)


@pytest.fixture
def rows() -> list[report.Row]:
    return [row(name, 3 if name in ("GE", "LR") else 1) for name in METHODS]


def document(rows, robot="ant"):
    written = report.results(rows, robot=robot, scale="paper", scenarios="ab" * 32)
    return json.loads(json.dumps(written, allow_nan=False))


def test_results_have_the_schema(rows):
    r = document(rows)
    made = {"robot", "engine", "scale", "scenarios", "other_code"}
    assert made | {"methods", "paired"} == set(r)
    assert (r["robot"], r["scale"], r["other_code"]) == ("ant", "paper", {})
    for name, method in r["methods"].items():
        several = {"training_seeds"} if name in ("GE", "LR") else set()
        assert set(method) == KEYS | EXTRA | several
        assert set(method["success"]) == {"0.25", "0.5", "1.0"}
        low, high = method["ci95"]
        assert low < method["mean"] < high
    assert r["methods"]["LR"]["settings"] == {
        "latent_loss_weight": 0.25,
        "hidden": [50, 50],
        "k": 10,
    }
    assert r["methods"]["LR"]["replayed"] == 1_000_000


def test_results_are_the_episodes_numbers(rows):
    method, episodes = document(rows)["methods"]["GE"], rows[2].episodes
    assert method["mean"] == pytest.approx(episodes.closest.mean(), abs=1e-6)
    assert method["std"] == pytest.approx(episodes.closest.std(), abs=1e-6)
    means = [e.closest.mean() for e in rows[2].training_seeds.values()]
    over = method["training_seeds"]
    assert (over["seeds"], over["episodes"]) == ([0, 1, 2], [[4, 50]] * 3)
    assert over["means"] == pytest.approx(means, abs=1e-6)
    assert over["std"] == pytest.approx(np.std(means, ddof=1), abs=1e-6)
    assert over["ci95"] == pytest.approx([min(means), max(means)], abs=1e-6)


def test_what_is_not_known_of_a_row_is_not_in_its_results():
    known = document([row("LR", invariance=0.123456)])["methods"]["LR"]
    assert (known["training_seed"], known["invariance"]) == (0, 0.123)
    assert "training_seeds" not in known
    unknown = document([row("LR", training_seeds={})])["methods"]["LR"]
    assert not unknown.keys() & {"training_seed", "training_seeds", "invariance"}


def test_neighbours_are_paired_and_the_papers_method_with_the_rest(rows):
    paired = document(rows)["paired"]
    assert list(paired) == ["RL-RS", "GE-RL", "LR-GE", "HF-LR", "LR-RS", "LR-RL"]
    expected = stats.paired(rows[3].episodes, rows[0].episodes)
    assert paired["LR-RS"]["difference"] == pytest.approx(expected["difference"], abs=1e-6)
    assert paired["LR-RS"]["ci95"] == pytest.approx(expected["ci95"], abs=1e-6)
    assert list(document(rows[::-1])["paired"]) == [
        *("LR-HF", "GE-LR", "RL-GE", "RS-RL"),
        *("LR-RL", "LR-RS"),
    ]
    assert list(document(rows[:3])["paired"]) == ["RL-RS", "GE-RL"]
    expected = stats.paired(rows[3].episodes, rows[2].episodes)
    assert paired["LR-GE"]["difference"] == pytest.approx(expected["difference"], abs=1e-6)
    assert paired["LR-GE"]["difference"] < 0
    assert len(paired["LR-GE"]["training_seeds"]["means"]) == 3
    assert paired["LR-GE"]["training_seeds"]["seeds"] == [0, 1, 2]
    assert paired["LR-GE"]["training_seeds"]["improvement"] == 1.0
    assert "training_seeds" not in paired["HF-LR"]
    assert document(rows[:1])["paired"] == {}


def test_runs_are_paired_by_their_training_seed_on_what_both_saw():
    lr, ge = {n: outcome(1.0, n) for n in (0, 1, 2)}, {n: outcome(1.5, n) for n in (0, 2, 3)}
    ge[2] = outcome(1.5, 2, seeds=4, episodes=30)
    lr[2] = dataclasses.replace(lr[2], closest=lr[2].closest + 1)
    these = [row("GE", episodes=ge[0], training_seeds=ge)]
    these.append(row("LR", episodes=lr[0], training_seeds=lr))
    over = document(these)["paired"]["LR-GE"]["training_seeds"]
    expected = [
        (lr[0].closest - ge[0].closest).mean(),
        (lr[2].closest[:, :30] - ge[2].closest).mean(),
    ]
    assert over["seeds"] == [0, 2]
    assert over["means"] == pytest.approx(expected, abs=1e-6)
    assert over["improvement"] == 0.5


def compared(shown: str) -> list[str]:
    """The pairs of methods that a table names, line by line."""
    words = (line.strip("| ").split() for line in shown.splitlines())
    names = [line[0] for line in words if line]
    return [name for name in names if set(name.split("-")) <= METHODS.keys() and "-" in name]


def test_each_pair_is_printed_once(rows):
    r = document(rows)
    for shown in (report.text(r), report.markdown(r)):
        assert compared(shown) == list(r["paired"])
    (line,) = [x for x in report.text(r).splitlines() if x.startswith("LR-GE")]
    pair = r["paired"]["LR-GE"]
    assert f"{pair['difference']:+.3f}" in line and line.endswith("3 of 3")
    assert compared(report.text(document(rows[:1]))) == []


def test_comparisons_have_no_columns_for_training_seeds_that_are_not_there():
    r = document([row("RL"), row("LR")])
    (line,) = [x for x in report.markdown(r).splitlines() if x.startswith("| LR-RL")]
    assert line.count("|") == table.BRIEF + 1
    assert "last three: all training seeds" not in report.text(r)


def test_half_a_training_seed_is_not_lost_in_rounding():
    a = row("LR", 3, training_seeds={n: outcome(1.0, n) for n in range(3)})
    means = {0: outcome(1.5, 0), 1: outcome(0.5, 1), 2: outcome(1.0, 2)}
    r = document([row("GE", episodes=means[0], training_seeds=means), a])
    (line,) = [x for x in report.text(r).splitlines() if x.startswith("LR-GE")]
    assert line.endswith("1.5 of 3")


def test_the_notes_tell_which_numbers_are_over_which_seeds(rows):
    notes = report.text(document(rows)).replace("\n", " ")
    assert "Every column except “over seeds” uses training seed 0" in notes
    assert "“Over seeds” uses 3 training seeds" in notes
    assert "seeds after the first: 4 × 50 test episodes" in notes and "GE 0." in notes
    only = report.text(document([row("LR")])).replace("\n", " ")
    assert "“Over seeds” uses" not in only
    other = row("GE", training_seeds={5: outcome(1.0)})
    assert "one training seed (GE 5, LR 0)" in report.text(document([other, row("LR")]))


def test_the_notes_hold_the_invariance():
    r = document([row("LR", invariance=0.1234), row("HF", invariance=2.3e-6), row("x")])
    assert "LR 0.12, HF 2.3e-06." in report.text(r).replace("\n", " ")
    assert "rotated together" not in report.text(document([row("LR")]))


def test_the_order_of_the_rows_is_kept(rows):
    for order in (rows, rows[::-1]):
        names = [r.method for r in order]
        r = document(order)
        assert list(r["methods"]) == names
        lines = [line.split()[0] for line in report.text(r).splitlines() if "±" in line]
        assert [word for word in lines if word in METHODS] == names
        cells = [line.split("|")[1] for line in report.markdown(r).splitlines() if "|" in line]
        assert [cell.strip() for cell in cells[2 : 2 + len(names)]] == names


def test_a_method_stands_once(rows):
    with pytest.raises(ValueError, match="two rows"):
        document([*rows, rows[0]])


@pytest.mark.parametrize("robot", ["ant", "humanoid", "minitaur"])
def test_the_papers_numbers_stand_beside_ours(rows, robot):
    r = document(rows, robot)
    for shown in (report.text(r), report.markdown(r)):
        for name in ("RS", "RL", "GE", "LR"):
            lines = [x for x in shown.splitlines() if "±" in x]
            (line,) = [x for x in lines if x.strip("| ").split()[0] == name]
            mean, std = report.TABLE1[robot][name]
            assert f"{mean:.3f} ± {std:.3f}" in line
            assert f"{r['methods'][name]['mean']:.3f} ± {r['methods'][name]['std']:.3f}" in line


def test_the_paper_has_no_heading_frame(rows):
    r = document(rows)
    (line,) = [x for x in report.markdown(r).splitlines() if x.startswith("| HF ")]
    assert line.endswith("|  |")


def test_the_paper_has_no_other_robots(rows):
    r = document(rows, "another robot")
    papers = {f"{m:.3f} ± {s:.3f}" for column in report.TABLE1.values() for m, s in column.values()}
    for shown in (report.text(r), report.markdown(r)):
        for name, row in r["methods"].items():
            assert f"{row['mean']:.3f} ± {row['std']:.3f}" in shown, name
        assert not [number for number in papers if number in shown]


def test_the_text_fits_a_terminal_and_is_aligned(rows):
    lines = report.text(document([*rows, row("LR paper", 3)])).splitlines()
    assert max(map(len, lines)) <= 120
    body = lines[4 : 4 + len(METHODS)]
    assert [line.split()[0] for line in body] == list(METHODS)
    assert len({line.index(" ± ") for line in body}) == 1
    lr = body[list(METHODS).index("LR")]
    assert "2 M + 1 M" in lr


def test_markdown_rows_have_one_cell_a_column(rows):
    lines = [x for x in report.markdown(document(rows)).splitlines() if x.startswith("|")]
    first, second = lines[: 2 + len(rows)], lines[2 + len(rows) :]
    assert {line.count("|") for line in first} == {len(table.HEADER) + 1}
    assert {line.count("|") for line in second} == {len(table.COMPARED) + 1}


def test_a_number_that_does_not_exist_is_null_and_a_dash():
    whole = outcome(1.0)
    lost = dataclasses.replace(whole, diverged=np.ones(whole.closest.shape, bool))
    r = document([row("GE"), report.Row("LR", lost, 0, 0, {"x": float("nan")})])
    lr = r["methods"]["LR"]
    assert (lr["mean"], lr["ci95"], lr["diverged"]) == (None, [None, None], 1.0)
    assert lr["settings"] == {"x": None}
    assert "– ± –" in report.text(r)
    assert "LR 100.00 %" in report.text(r)


@pytest.mark.parametrize(
    ("n", "shown"),
    [(640, "640"), (50_000, "50 k"), (999_900, "1 M"), (1_048_576, "1.05 M"), (15_000_000, "15 M")],
)
def test_counts_are_short(n, shown):
    made = report.markdown(document([row("RS", interactions=n)]))
    (line,) = [x for x in made.splitlines() if x.startswith("| RS |")]
    columns = dict(zip(table.HEADER, line.strip("| ").split(" | "), strict=False))
    assert columns["interactions"] == shown


def test_table1_is_the_papers():
    assert report.TABLE1["ant"]["LR"] == (1.105, 0.866)
    for robot in report.TABLE1.values():
        assert set(robot) == {"RS", "RL", "VGCP", "HER_SP", "HER_DE", "GE", "LR"}
        assert min(robot.values()) == robot["LR"], "LR is the paper's best on every robot"


def drawn(fig: Figure, path) -> np.ndarray:
    """Pixels of a written figure `[y, x, 3]`, once it is seen to be one."""
    assert isinstance(fig, Figure)
    pixels = imread(path)[..., :3]
    assert min(pixels.shape[:2]) > 300
    assert pixels.std() > 0.05, "a blank picture"
    assert not list(path.parent.glob(".*")), "a half-written file was left"
    for key in fig.legends:
        box, page = key.get_window_extent(), fig.bbox
        assert page.x0 <= box.x0 < box.x1 <= page.x1, "the key runs off the page"
    return pixels


def holds(pixels: np.ndarray, colour: str) -> bool:
    """Whether at least 20 pixels are of the colour, "#RRGGBB"."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return int((np.abs(pixels - rgb).max(-1) < 0.02).sum()) >= 20


def test_violins(rows, tmp_path):
    path = tmp_path / "new folder" / "violins.png"
    fig = report.violins(rows, path, paper=report.TABLE1["ant"])
    drawn(fig, path)
    (ax,) = fig.axes
    assert [t.get_text() for t in ax.get_xticklabels()] == list(METHODS)
    marks = {float(y) for line in ax.lines for y in np.asarray(line.get_ydata())}
    assert marks >= {report.TABLE1["ant"][name][0] for name in ("RS", "RL", "GE", "LR")}
    for r in rows:
        assert {r.episodes.closest.mean(), np.median(r.episodes.closest)} <= marks


def test_violins_of_what_is_hard_to_draw(tmp_path):
    same = outcome(1.0)
    constant = dataclasses.replace(same, closest=np.ones(same.closest.shape))
    lost = dataclasses.replace(same, diverged=np.ones(same.closest.shape, bool))
    some = [report.Row(n, e, 0, 0, {}) for n, e in (("a", constant), ("b", lost), ("c", same))]
    drawn(report.violins(some, tmp_path / "v.png"), tmp_path / "v.png")


def test_paths(tmp_path):
    angle = np.linspace(-0.5, 0.5, 10)
    targets = 3 * np.stack([np.cos(angle), np.sin(angle)], -1)
    ways = {m: [np.linspace(0, 1, 50)[:, None] * t for t in targets] for m in ("GE", "LR")}
    ways["GE"][0] = np.vstack([ways["GE"][0], [[np.nan, np.inf]]])
    panels = [("seen targets", ways, targets, 0.0), ("unseen targets", ways, -targets, np.pi)]
    fig = report.paths(panels, tmp_path / "paths.png")
    pixels = drawn(fig, tmp_path / "paths.png")
    assert len(fig.axes) == 4
    for ax in fig.axes:
        assert ax.get_aspect() == 1.0
        assert len(ax.patches) >= 10
    for colour in (drawing.STYLES["GE"].colour, drawing.STYLES["LR"].colour, figures.TARGET_RED):
        assert holds(pixels, colour)


def test_who_walks_on_for_long_does_not_make_the_others_small(tmp_path):
    target, line = np.array([[3.0, 0.0]]), np.linspace(0, 1, 99)[:, None]
    ways = {"GE": [line * target], "LR": [30 * line * target]}
    fig = report.paths([("seen", ways, target, 0.0)], tmp_path / "paths.png")
    for ax in fig.axes:
        assert 3 < ax.get_xlim()[1] < 6


def test_many_methods_stand_in_bands(tmp_path):
    names = [*METHODS, "VGCP", "HER_SP"]
    target = np.array([[3.0, 0.0]])
    ways = {name: [np.linspace(0, 0.3 * i, 9)[:, None] * target] for i, name in enumerate(names)}
    panels = [("seen", ways, target, 0.0), ("unseen", ways, -target, np.pi)]
    fig = report.paths(panels, tmp_path / "paths.png")
    drawn(fig, tmp_path / "paths.png")
    assert [ax.get_title() for ax in fig.axes] == [
        *(*names[:4], *[""] * 4),
        *(*names[4:], *[""] * 3),
    ]
    for ax, name in zip(fig.axes[8:11], names[4:], strict=True):
        assert ax.lines[0].get_color() == drawing.styles(names)[name].colour
        assert ax.lines[0].get_xdata()[-1] == pytest.approx(0.9 * names.index(name))


def test_learning_curves(tmp_path):
    curve = [{"step": s, "episode_reward": 0.01 * s, "stage": "collect"} for s in range(0, 500, 10)]
    curve += [{"step": 500, "loss": 0.5}, {"step": 600, "loss": 0.1}]
    path = tmp_path / "curves.png"
    fig = report.learning_curves({"RL": curve, "LR": curve[::2]}, path, steps="interactions")
    drawn(fig, path)
    reward, loss = (ax for ax in fig.axes if ax.get_visible())
    assert (reward.get_ylabel(), reward.get_xlabel()) == ("episode reward", "interactions")
    assert (reward.get_yscale(), loss.get_yscale()) == ("linear", "log")
    drawn(report.learning_curves({"RL": curve}, path, keys=["loss"]), path)


def test_a_long_curve_is_drawn_as_means(tmp_path):
    noise = np.random.default_rng(0).normal(size=10_000)
    curve = [{"step": s, "reward": 1.0 + x} for s, x in enumerate(noise)]
    (ax,) = report.learning_curves({"SAC": curve}, tmp_path / "curves.png").axes
    x, y = ax.lines[0].get_data()
    np.testing.assert_allclose(y, 1.0 + noise.reshape(100, 100).mean(1))
    np.testing.assert_allclose(x, np.arange(10_000).reshape(100, 100).mean(1))


def test_runs_of_one_agent_are_drawn_alike(tmp_path):
    curve = [{"step": s, "reward": 0.01 * s} for s in range(0, 100, 10)]
    curves = {"PPO, seed 0": curve, "PPO, seed 1": curve[1:], "SAC, seed 0": curve}
    fig = report.learning_curves(curves, tmp_path / "curves.png")
    (ax,) = fig.axes
    first, second, other = (line.get_color() for line in ax.lines)
    assert first == second != other
    assert [t.get_text() for t in fig.legends[0].get_texts()] == ["PPO", "SAC"]


ANGLES = np.radians(np.arange(0, 181, 15))


def changes(level: float) -> np.ndarray:
    noise = np.random.default_rng(0).lognormal(0, 0.5, (13, 400))
    return level * np.sin(ANGLES / 2)[:, None] * noise


def test_invariance(tmp_path):
    path = tmp_path / "invariance.png"
    given = {"RL": changes(1.5), "LR": changes(0.2), "HF": changes(3e-6)}
    fig = report.invariance(given, ANGLES, path)
    pixels = drawn(fig, path)
    (ax,) = fig.axes
    assert ax.get_yscale() == "symlog" and ax.get_ylim()[0] < 0 < ax.get_ylim()[1]
    for name, values in given.items():
        assert holds(pixels, drawing.STYLES[name].colour)
        container = next(
            c for c in ax.containers if c[0].get_color() == drawing.STYLES[name].colour
        )
        line, _, (bars,) = container
        assert line.get_ydata() == pytest.approx(np.median(values, axis=1))
        assert line.get_xdata() == pytest.approx(np.degrees(ANGLES), abs=7)
        ends = np.array([segment[:, 1] for segment in bars.get_segments()])
        assert ends == pytest.approx(np.percentile(values, [25, 75], axis=1).T)


def test_only_float_noise_is_called_so(tmp_path):
    given = {"LR": changes(0.2), "HF": changes(3e-6), "exact": np.zeros((13, 5))}
    fig = report.invariance(given, ANGLES, tmp_path / "invariance.png")
    most = f"{given['HF'].max():.0e}".replace("e-0", "e-")
    said = [text.get_text() for text in fig.axes[0].texts]
    assert said == [f"HF: at most {most}, float noise", "exact: exactly 0"]


@pytest.mark.parametrize("fits", [1, 3])
def test_latent_sizes(tmp_path, fits):
    rng = np.random.default_rng(0)
    closest = {k: [rng.gamma(4, 0.2, (5, 40)) for _ in range(fits)] for k in (111, 2, 10)}
    closest[2][0][0, 0] = np.nan
    path = tmp_path / "sizes.png"
    fig = report.latent_sizes(closest, path, chosen=10)
    drawn(fig, path)
    (ax,) = fig.axes
    assert [t.get_text() for t in ax.get_xticklabels()] == ["2", "10", "111"]
    ((line, _, (bars,)),) = ax.containers
    means = {k: [np.nanmean(fit) for fit in closest[k]] for k in (2, 10, 111)}
    assert line.get_xdata() == pytest.approx([2, 10, 111])
    assert line.get_ydata() == pytest.approx([np.mean(m) for m in means.values()])
    ends = np.array([segment[:, 1] for segment in bars.get_segments()])
    spread = [
        np.mean(m) + np.std(m, ddof=1) * np.array([-1, 1]) for m in means.values() if fits > 1
    ]
    interval = [stats.interval(closest[k][0]) for k in means]
    assert ends == pytest.approx(np.array(spread if fits > 1 else interval))
    single = [each for each in ax.lines if each.get_markerfacecolor() == "white"]
    assert len(single) == (fits > 1)
    for each in single:
        assert each.get_ydata() == pytest.approx(np.concatenate(list(means.values())))
    assert [10, 10] in [list(each.get_xdata()) for each in ax.lines], "the k of Table 1"
    named = "fits" if fits > 1 else "test seeds"
    assert named in fig.legends[0].get_texts()[0].get_text()


def test_a_light_colour_has_an_edge():
    edged = [name for name, s in drawing.STYLES.items() if "path_effects" in drawing.strokes(s)]
    assert edged == ["HER_SP"], "yellow"


def test_residuals(tmp_path):
    grown = 1e-7 * np.exp(0.3 * np.arange(60))
    curves = {
        "segments of 20 steps": {"median": grown[:20], "p90": 10 * grown[:20]},
        "whole episodes": {"median": grown, "p90": 10 * grown},
        "exact rotation": {"median": np.zeros(60), "p90": np.zeros(60)},
    }
    fig = report.residuals(curves, tmp_path / "residuals.png")
    drawn(fig, tmp_path / "residuals.png")
    (ax,) = fig.axes
    assert ax.get_yscale() == "log"
    assert np.asarray(ax.lines[0].get_ydata()) == pytest.approx(grown[:20].clip(figures.FLOOR))


def test_bearings_show_the_mean_of_each_bin(tmp_path):
    rng = np.random.default_rng(0)
    bearing = rng.uniform(-np.pi / 4, np.pi / 4, (10, 500))
    heading = rng.uniform(0, 2 * np.pi, (10, 500))
    bad_left = np.where(bearing > 0, 2.0, 0.5)
    bad_behind = np.where(np.cos(heading) < 0, 1.0, 0.25)
    bad_behind[0, 0] = np.nan
    path = tmp_path / "bearings.png"
    fig = report.bearings({"GE": bad_left, "LR": bad_behind}, bearing, heading, path)
    drawn(fig, path)
    left, right = fig.axes
    assert left.lines[0].get_ydata() == pytest.approx([0.5] * 3 + [2.0] * 3)
    colour = drawing.STYLES["LR"].colour
    behind = next(line for line in right.lines if line.get_color() == colour)
    assert behind.get_ydata() == pytest.approx([1.0] * 3 + [0.25] * 6 + [1.0] * 3)


def test_held_out_errors_stand_in_their_bins_above_the_ranges(tmp_path):
    bins = {"edges": [-180, -60, 60, 180], "error": [None, 0.25, 0.5], "shuffled": [None, 0.5, 2.0]}
    turned = bins | {"edges": [-180, 0, 90, 180]}
    path = tmp_path / "held_out.png"
    fig = report.draw_held_out(
        {"LR": {"bearing": bins, "heading": turned}}, {"LR": np.radians([-30, 60])}, path
    )
    drawn(fig, path)
    for ax, middle in zip(fig.axes, ([-120, 0, 120], [-90, 45, 135]), strict=True):
        error, shuffled, mean = ax.lines
        for line, values in ((error, [0.25, 0.5]), (shuffled, [0.5, 2.0])):
            assert list(line.get_xdata()) == middle
            assert np.isnan(line.get_ydata()[0]) and list(line.get_ydata()[1:]) == values
        assert (shuffled.get_linestyle(), list(mean.get_ydata())) == (":", [1, 1])
    left, right = fig.axes
    (seen,) = left.collections[0].get_segments()
    assert seen[:, 0] == pytest.approx([-30, 60]) and (seen[:, 1] < 0).all()
    assert left.get_ylim()[0] < seen[0, 1] and left.get_yticks()[0] == 0
    assert not right.collections


def test_notes_say_how_a_row_was_fitted(rows):
    held_out = {"samples": 900, "error": 0.3333333, "shuffled": 0.5, "nearest": None}
    rows[1] = dataclasses.replace(rows[1], held_out=held_out, bearings=(-0.5235988, np.pi))
    results = document(rows)
    assert results["methods"]["RL"]["held_out"] == held_out | {"error": 0.333333}
    notes = " ".join(table.text(results).split())
    assert "(in brackets: with d shuffled): RL 0.33 (0.50)." in notes
    assert "from the heading: RL −30° to 180°." in notes


def test_styles_are_one_a_method_and_told_apart_without_colour():
    known = drawing.styles(drawing.STYLES)
    assert known == drawing.STYLES
    assert drawing.styles(["mine", "LR"])["LR"] == drawing.STYLES["LR"]
    mixed = drawing.styles(["LR", "mine", "GE", "yours"])
    for several in (known, mixed):
        for a, b in itertools.combinations(several.values(), 2):
            assert a.colour != b.colour
            assert (a.marker, str(a.line)) != (b.marker, str(b.line))


def test_the_same_data_makes_the_same_file(rows, tmp_path):
    for name in ("a.png", "b.png"):
        report.violins(rows, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_every_row_says_what_made_it(rows):
    rows[-1] = dataclasses.replace(rows[-1], made=made())
    found = document(rows)["methods"]
    assert not any("made" in found[name] for name in ("RS", "RL", "GE", "LR"))
    fit, test = found["HF"]["made"].values()
    assert (fit["commands"], fit["seconds"], test["commands"]) == (2, 60.0, 1)
    assert {name: fit[name] for name in HERE} == HERE
    assert re.fullmatch("[0-9a-f]{10}", fit["code"]) and fit["code"] != test["code"]


def test_rows_of_one_make_say_it_in_one_sentence(rows):
    made_alike = [dataclasses.replace(row, made=made()) for row in rows]
    text = table.markdown(document(made_alike))
    assert "- Commit: aaaaaaaaaa." in text and "- Versions: numpy 2.0." in text
    assert "- Hardware: four cores." in text and "code differs" not in text


def test_rows_of_other_code_and_another_machine_are_named(rows):
    other = made(CODE | {"genidm.paper.fit": "3333"}, hardware="a GPU", clean=False)
    mixed = [dataclasses.replace(row, made=other if row.method == "LR" else made()) for row in rows]
    r = document(mixed)
    assert r["other_code"] == {
        "genidm.paper.fit": {"1111": ["RS", "RL", "GE", "HF"], "3333": ["LR"]}
    }
    text = table.markdown(r)
    assert "genidm.paper.fit is 1111 in RS RL GE HF, 3333 in LR." in text
    assert "Hardware: RS, RL, GE, HF: four cores. LR: a GPU." in text
    assert "LR: aaaaaaaaaa (changed)" in text
