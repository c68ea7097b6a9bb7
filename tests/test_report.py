"""The table's schema and text, and that figures show what they are given."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from genidm import report, stats
from genidm.episodes import Episodes
from genidm.report import figures, table

METHODS = {"RS": 3.0, "RL": 2.0, "GE": 1.0, "LR": 0.6, "HF": 0.3}
EXTRA = {"reached", "diverged", "steps"}
KEYS = {
    *("interactions", "replayed", "seeds", "episodes", "mean", "std", "ci95", "iqm"),
    *("success", "fell", "settings"),
}
ENVIRONMENT = {"versions": {"numpy": np.__version__}, "hardware": "four cores"}


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


def row(method: str, collections: int = 0) -> report.Row:
    runs = tuple(outcome(METHODS.get(method, 1.5), rng) for rng in range(max(collections, 1)))
    replayed = 1_000_000 if method in ("GE", "LR") else 0
    settings = {"latent_weight": np.float32(0.25), "hidden": (50, 50), "k": np.int64(10)}
    return report.Row(method, runs[0], 2_000_000, replayed, settings, runs[:collections])


@pytest.fixture
def rows() -> list[report.Row]:
    return [row(name, 3 if name in ("GE", "LR") else 0) for name in METHODS]


def document(rows, robot="ant"):
    written = report.results(
        rows, robot=robot, scale="paper", scenarios="ab" * 32, environment=ENVIRONMENT
    )
    return json.loads(json.dumps(written, allow_nan=False))


def test_results_have_the_schema(rows):
    r = document(rows)
    assert {"robot", "scale", "scenarios", "versions", "hardware", "methods", "paired"} == set(r)
    assert (r["robot"], r["scale"], r["hardware"]) == ("ant", "paper", "four cores")
    for name, method in r["methods"].items():
        several = {"collecting_seeds"} if name in ("GE", "LR") else set()
        assert set(method) == KEYS | EXTRA | several
        assert set(method["success"]) == {"0.25", "0.5", "1.0"}
        low, high = method["ci95"]
        assert low < method["mean"] < high
    assert r["methods"]["LR"]["settings"] == {"latent_weight": 0.25, "hidden": [50, 50], "k": 10}
    assert r["methods"]["LR"]["replayed"] == 1_000_000


def test_results_are_the_episodes_numbers(rows):
    method, episodes = document(rows)["methods"]["GE"], rows[2].episodes
    assert method["mean"] == pytest.approx(episodes.closest.mean(), abs=1e-6)
    assert method["std"] == pytest.approx(episodes.closest.std(), abs=1e-6)
    means = [e.closest.mean() for e in rows[2].collecting_seeds]
    assert method["collecting_seeds"]["means"] == pytest.approx(means, abs=1e-6)
    assert method["collecting_seeds"]["std"] == pytest.approx(np.std(means, ddof=1), abs=1e-6)


def test_neighbours_are_paired(rows):
    paired = document(rows)["paired"]
    assert list(paired) == ["RL-RS", "GE-RL", "LR-GE", "HF-LR"]
    expected = stats.paired(rows[3].episodes, rows[2].episodes)
    assert paired["LR-GE"]["difference"] == pytest.approx(expected["difference"], abs=1e-6)
    assert paired["LR-GE"]["difference"] < 0
    assert len(paired["LR-GE"]["collecting_seeds"]["means"]) == 3
    assert "collecting_seeds" not in paired["HF-LR"]
    assert document(rows[:1])["paired"] == {}


def test_the_order_of_the_rows_is_kept(rows):
    for order in (rows, rows[::-1]):
        names = [r.method for r in order]
        r = document(order)
        assert list(r["methods"]) == names
        lines = [line.split()[0] for line in report.text(r).splitlines() if line]
        assert [word for word in lines if word in METHODS] == names
        cells = [line.split("|")[1] for line in report.markdown(r).splitlines() if "|" in line]
        assert [cell.strip() for cell in cells[2:]] == names


def test_a_method_stands_once(rows):
    with pytest.raises(ValueError, match="two rows"):
        document([*rows, rows[0]])


@pytest.mark.parametrize("robot", ["ant", "humanoid", "minitaur"])
def test_the_papers_numbers_stand_beside_ours(rows, robot):
    r = document(rows, robot)
    for shown in (report.text(r), report.markdown(r)):
        for name in ("RS", "RL", "GE", "LR"):
            (line,) = [x for x in shown.splitlines() if x.strip("| ").split()[0:1] == [name]]
            mean, std = report.TABLE1[robot][name]
            assert f"{mean:.3f} ± {std:.3f}" in line
            assert f"{r['methods'][name]['mean']:.3f} ± {r['methods'][name]['std']:.3f}" in line


def test_the_paper_has_no_heading_frame(rows):
    r = document(rows)
    (line,) = [x for x in report.markdown(r).splitlines() if x.startswith("| HF")]
    assert line.endswith("|  |")
    assert len(report.text(document(rows, "another robot"))) > 0


def test_the_text_fits_a_terminal_and_is_aligned(rows):
    lines = report.text(document([*rows, row("LR literal")])).splitlines()
    assert max(map(len, lines)) <= 120
    body = lines[4 : 4 + len(METHODS)]
    assert [line.split()[0] for line in body] == list(METHODS)
    assert len({line.index(" ± ") for line in body}) == 1
    lr = body[list(METHODS).index("LR")]
    assert "2 M + 1 M" in lr


def test_markdown_rows_have_one_cell_a_column(rows):
    lines = [x for x in report.markdown(document(rows)).splitlines() if x.startswith("|")]
    assert {line.count("|") for line in lines} == {len(table.HEADER) + 1}


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
    assert table._count(n) == shown


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
    for colour in (figures.STYLES["GE"].colour, figures.STYLES["LR"].colour, figures.TARGET_RED):
        assert holds(pixels, colour)


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
    colour = figures.STYLES["LR"].colour
    behind = next(line for line in right.lines if line.get_color() == colour)
    assert behind.get_ydata() == pytest.approx([1.0] * 3 + [0.25] * 6 + [1.0] * 3)


def test_styles_are_one_a_method_and_told_apart_without_colour():
    known = figures.styles(figures.STYLES)
    assert known == figures.STYLES
    assert figures.styles(["mine", "LR"])["LR"] == figures.STYLES["LR"]
    mixed = figures.styles(["LR", "mine", "GE", "yours"])
    for several in (known, mixed):
        for a, b in itertools.combinations(several.values(), 2):
            assert a.colour != b.colour
            assert (a.marker, str(a.line)) != (b.marker, str(b.line))


def test_the_same_data_makes_the_same_file(rows, tmp_path):
    for name in ("a.png", "b.png"):
        report.violins(rows, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
