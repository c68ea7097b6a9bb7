"""Every number of a table, against an answer known beforehand or worked out another way."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from genidm.evaluation import stats
from genidm.evaluation.episodes import Episodes


def outcome(closest, *, start=None, fell=False, diverged=False, reached=False) -> Episodes:
    closest = np.asarray(closest, np.float32)
    return Episodes(
        closest=closest,
        start=np.full(closest.shape, 3.0) if start is None else np.asarray(start),
        reached=np.broadcast_to(reached, closest.shape),
        fell=np.broadcast_to(fell, closest.shape),
        diverged=np.broadcast_to(diverged, closest.shape),
        steps=np.arange(closest.size).reshape(closest.shape),
        path_length=2 * closest,
    )


def random(seeds=10, episodes=200, shift=0.0, rng=0) -> Episodes:
    generator = np.random.default_rng(rng)
    level = generator.normal(1.0, 0.2, (seeds, 1))
    return outcome(level + shift + generator.gamma(2.0, 0.5, (seeds, episodes)))


def test_summary_of_known_episodes():
    s = stats.summary(outcome([[0.1, 0.25], [0.5, 3.15]], fell=[[0, 0], [0, 1]], reached=[[1, 0]]))
    assert s["mean"] == pytest.approx(1.0)
    assert s["std"] == pytest.approx(np.std([0.1, 0.25, 0.5, 3.15]))
    assert s["success"] == {"0.25": 0.5, "0.5": 0.75, "1.0": 0.75}
    assert (s["fell"], s["reached"], s["diverged"]) == (0.25, 0.5, 0.0)
    assert s["steps"] == pytest.approx(1.5)
    assert (s["seeds"], s["episodes"]) == (2, 2)


def every_mean(values) -> np.ndarray:
    """The means of all resamples that there can be, each as likely as any other."""
    return np.array(
        [np.mean(resample) for resample in itertools.product(values, repeat=len(values))]
    )


def assert_percentiles_of(means, interval) -> None:
    """Ends of a 95 % interval, as exactly as ten thousand resamples have them."""
    below = [np.mean(every_mean(means) <= end) for end in interval]
    assert below == pytest.approx([0.025, 0.975], abs=0.01)


def test_interval_holds_the_middle_of_every_resample_of_the_seeds_means():
    episodes = random(seeds=5)
    assert_percentiles_of(episodes.closest.astype(float).mean(1), stats.summary(episodes)["ci95"])


def test_interval_takes_a_seed_as_one_unit():
    """Episodes of a seed that are all alike tell no more than one of them."""
    means = np.array([[0.0], [1.0], [2.0], [4.0]])
    assert stats.interval(means) == pytest.approx(stats.interval(np.repeat(means, 100, axis=1)))


def test_interval_of_one_seed_resamples_its_episodes():
    values = np.random.default_rng(0).gamma(2.0, 0.5, (1, 400))
    low, high = stats.interval(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(400), rel=0.1)
    assert low < values.mean() < high


def test_interval_is_the_same_every_time():
    assert stats.interval(random().closest) == stats.interval(random().closest)


@pytest.mark.parametrize(
    ("values", "middle"),
    [
        ([7.0], 7.0),
        ([9.0, 1.0, 2.0], 4.0),  # a quarter of three is none
        ([100.0, 2.0, 4.0, 0.0], 3.0),
        ([9, 1, 2, 3, 4], 3.0),
        ([1, 8, 2, 7, 3, 6, 4, 50], 5.0),
        ([[5.0, np.nan], [1.0, 2.0], [3.0, np.nan]], 2.5),
    ],
)
def test_iqm_is_the_mean_of_the_middle_half(values, middle):
    assert stats.interquartile_mean(np.array(values, float)) == pytest.approx(middle)


def test_iqm_is_of_all_episodes_together():
    episodes = random()
    ordered = np.sort(episodes.closest.astype(float).ravel())
    assert stats.summary(episodes)["iqm"] == pytest.approx(ordered[500:1500].mean())


@pytest.mark.parametrize("values", [[[3.0]], [[np.nan, 3.0], [np.nan, np.nan]]])
def test_the_interval_of_one_number_is_that_number(values):
    assert stats.interval(np.array(values)) == (3.0, 3.0)


def committed() -> list[tuple[str, dict]]:
    """What the committed results say of several training seeds: their means, and the interval."""
    found = []

    def look(name: str, part: object) -> None:
        if isinstance(part, dict):
            if "means" in part:
                found.append((name, part))
            for key, inner in part.items():
                look(f"{name} {key}", inner)

    for path in (Path(__file__).parents[1] / "experiments" / "results").glob("*.json"):
        look(path.stem, json.loads(path.read_text(encoding="utf-8")))
    return found


def test_the_same_seed_gives_the_interval_that_was_committed():
    assert len(committed()) > 10
    for name, part in committed():
        interval = stats.interval(np.array(part["means"])[:, None])
        if part["ci95"][0] is not None:  # of fewer than three there is none
            assert interval == pytest.approx(part["ci95"], abs=1.5e-6), name


def test_diverged_episodes_are_counted_and_in_no_mean():
    diverged = [[False, True], [False, False]]
    s = stats.summary(outcome([[1.0, 0.01], [2.0, 3.0]], diverged=diverged))
    assert s["diverged"] == 0.25
    assert s["mean"] == pytest.approx(2.0)
    assert s["iqm"] == pytest.approx(2.0)
    assert s["steps"] == pytest.approx((0 + 2 + 3) / 3)
    assert s["success"]["0.25"] == 0.0, "breaking the physics is no success"
    nan = stats.summary(outcome([[1.0, np.nan], [2.0, 3.0]], diverged=diverged))
    assert nan == s, "what a diverged episode holds must not matter"


def test_a_seed_that_diverged_throughout_is_left_out_of_the_interval():
    diverged = [[True, True], [False, False], [False, False]]
    episodes = outcome([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], diverged=diverged)
    assert stats.summary(episodes)["ci95"] == pytest.approx([1.0, 2.0])


def test_where_all_diverged_there_is_no_mean():
    s = stats.summary(outcome([[1.0, 2.0]], diverged=True))
    assert np.isnan([s["mean"], s["std"], s["iqm"], s["steps"], *s["ci95"]]).all()
    assert s["diverged"] == 1.0


@pytest.mark.parametrize("closest", [[1.0, 2.0], [[]], [[1.0, np.nan]], [[1.0, np.inf]]])
def test_what_are_no_episodes_is_said(closest):
    with pytest.raises(ValueError, match=r"episodes must be|no finite closest"):
        stats.summary(outcome(closest))


def test_paired_of_known_episodes():
    a = outcome([[1.0, 2.0], [1.0, 4.0]])
    b = outcome([[2.0, 2.0], [2.0, 3.0]])
    p = stats.paired(a, b)
    assert p["difference"] == pytest.approx(-0.25)
    assert p["improvement"] == pytest.approx((2 + 0.5) / 4)
    assert p["ci95"] == pytest.approx([-0.5, 0.0])


def test_paired_sees_through_the_scenarios():
    """A gain of 0.1 m everywhere is certain, however much scenarios differ."""
    a, b = random(shift=0.0), random(shift=0.1)
    p = stats.paired(a, b)
    assert p["ci95"] == pytest.approx([-0.1, -0.1], abs=1e-5)
    assert p["improvement"] == 1.0
    assert stats.summary(a)["ci95"][1] > stats.summary(b)["ci95"][0], "unpaired, they overlap"


def test_paired_leaves_out_what_either_lost():
    a = outcome([[1.0, 9.0], [1.0, 1.0]], diverged=[[0, 1], [0, 0]])
    b = outcome([[2.0, 2.0], [2.0, np.nan]], diverged=[[0, 0], [0, 1]])
    assert stats.paired(a, b)["difference"] == pytest.approx(-1.0)
    assert stats.paired(a, b)["improvement"] == 1.0


def test_paired_refuses_other_scenarios():
    a = outcome([[1.0, 2.0]])
    with pytest.raises(ValueError, match="same scenarios"):
        stats.paired(a, outcome([[1.0, 2.0, 3.0]]))
    with pytest.raises(ValueError, match="same scenarios"):
        stats.paired(a, outcome([[1.0, 2.0]], start=[[3.0, 3.1]]))


def test_improvement_is_scipys_percentile_of_no_difference():
    rng = np.random.default_rng(0)
    for n in (1, 2, 7, 500):
        difference = rng.integers(-2, 3, n).astype(float)
        theirs = scipy.stats.percentileofscore(difference, 0, kind="mean") / 100
        assert stats.improvement(difference) == pytest.approx(theirs)
    assert stats.improvement(np.array([-1.0, np.nan, np.nan, 2.0])) == 0.5
    assert np.isnan(stats.improvement(np.array([np.nan])))


def test_the_common_part_of_two_banks_is_the_beginning_of_both():
    a, b = random(seeds=4, episodes=50), random(seeds=6, episodes=20, rng=1)
    for cut, whole in zip(stats.common(a, b), (a, b), strict=True):
        assert cut.closest.shape == cut.steps.shape == (4, 20)
        assert np.array_equal(cut.closest, whole.closest[:4, :20])
        assert np.array_equal(cut.path_length, whole.path_length[:4, :20])


def test_spread_over_training_seeds():
    runs = [outcome([[1.0, 3.0]]), outcome([[3.0, 3.0]]), outcome([[4.0, 9.0]], diverged=[[0, 1]])]
    s = stats.spread(runs)
    assert s["means"] == [2.0, 3.0, 4.0]
    assert (s["mean"], s["std"]) == (3.0, 1.0)
    assert np.isnan(stats.spread(runs[:1])["std"])


def test_a_training_seeds_episodes_are_averaged_first():
    """Ten thousand episodes of one training seed weigh no more than ten of another."""
    runs = [outcome(np.full((1, 10_000), 1.0)), outcome([[3.0, 3.0]]), outcome([[5.0]])]
    assert stats.spread(runs)["mean"] == 3.0
    assert stats.spread(runs)["ci95"] == [1.0, 5.0]


def test_the_interval_over_training_seeds_holds_the_middle_of_every_resample():
    runs = [random(seeds=3, episodes=20, rng=n, shift=0.3 * n) for n in range(6)]
    means = [run.closest.astype(float).mean() for run in runs]
    assert_percentiles_of(means, stats.spread(runs)["ci95"])


def test_an_interval_over_training_seeds_takes_three_of_them():
    runs = [outcome([[x]]) for x in (1.0, 2.0, 4.0)]
    assert np.isnan(stats.spread(runs[:2])["ci95"]).all()
    assert stats.spread(runs)["ci95"] == [1.0, 4.0], "the least and the greatest"
    lost = [*runs[:2], outcome([[4.0]], diverged=True)]
    assert np.isnan(stats.spread(lost)["ci95"]).all(), "one that has no mean does not count"


def test_paired_spread_sees_through_what_the_training_seeds_share():
    level = [3.0, 1.0, 2.0, 5.0]
    a = [outcome([[x - 0.1, x - 0.3]]) for x in level]
    b = [outcome([[x, x]]) for x in level]
    over = stats.paired_spread(a, b)
    assert over["means"] == pytest.approx([-0.2] * 4)
    assert over["ci95"] == pytest.approx([-0.2, -0.2])
    assert over["improvement"] == 1.0
    assert stats.spread(a)["ci95"][1] > stats.spread(b)["ci95"][0], "unpaired, they overlap"


def test_paired_spread_counts_the_training_seeds_in_which_the_first_is_nearer():
    a = [outcome([[x]]) for x in (1.0, 3.0, 2.0, 1.0)]
    b = [outcome([[x]]) for x in (2.0, 2.0, 2.0, 9.0)]
    assert stats.paired_spread(a, b)["improvement"] == (2 + 0.5) / 4


def test_paired_spread_compares_the_scenarios_that_both_saw():
    long, short = outcome([[1.0, 9.0, 9.0]]), outcome([[2.0]])
    assert stats.paired_spread([long, short], [short, long])["means"] == [-1.0, 1.0]
    other = outcome([[2.0]], start=[[4.0]])
    with pytest.raises(ValueError, match="same scenarios"):
        stats.paired_spread([long], [other])


def test_paired_spread_pairs_the_runs_in_order():
    a, b = [outcome([[1.0]]), outcome([[2.0]])], [outcome([[2.0]]), outcome([[5.0]])]
    assert stats.paired_spread(a, b)["means"] == [-1.0, -3.0]
    with pytest.raises(ValueError, match="shorter"):
        stats.paired_spread(a, b[:1])
