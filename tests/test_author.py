"""The author's code as a preset: its networks, losses and epochs, its test, and its command."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point
from small_cells import LR as SMALL
from tiny import TEST

from experiments import authors
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.scenarios import box_scenarios, scenarios
from genidm.paper.author import author_settings
from genidm.paper.fit import Fit
from genidm.paper.idm import Architecture, loss_siamese
from genidm.paper.methods import GE, LR
from genidm.paper.pairs import Pairs
from genidm.robots import AntV2
from genidm.runs.command import run_cli
from genidm.tasks import WalkForward

A, K = 8, 10
ARCHITECTURE = Architecture(A, (50, 50), (256, 256), K, "author")


# ── settings ────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def robot() -> AntV2:
    return AntV2(engine="mujoco")


def test_the_settings_are_those_of_the_authors_code(robot: AntV2) -> None:
    author = author_settings(LR, robot)
    weight = author.fit.latent_loss_weight
    assert weight == pytest.approx(4 / 19, rel=1e-12)  # 0.25 / 10 : 0.75 / 8
    assert (author.name, author.goal_horizon, author.fraction) == ("LR author", 1, 0.5)
    assert author.generalize and author.generalize.mode == "episodes"
    assert author.task == WalkForward() and not author.mirror and author.input_frame == "world"
    assert author.fit == Fit(
        updates=1000 * 1563,  # ⌈800,000 / 512⌉ minibatches an epoch
        batch_size=512,
        learning_rate=1e-3,
        cosine_decay=False,
        lfm=(256, 256),
        idm=(50, 50),
        network="author",
        latent_size=10,
        latent_loss_weight=weight,
        mean_latent=True,
    )


def test_a_method_without_a_latent_keeps_its_one_loss(robot: AntV2) -> None:
    author = author_settings(GE, robot, epochs=3)
    assert author.fit.latent_loss_weight == 0.25 and author.fit.updates == 3 * 1563
    assert (author.name, author.fit.network) == ("GE author", "author")


def test_no_epoch_is_refused(robot: AntV2) -> None:
    with pytest.raises(BadInput, match="epochs must be at least 1"):
        author_settings(LR, robot, epochs=0)


# ── networks and losses ─────────────────────────────────────────────────────────────────────


@functools.cache
def params() -> dict:
    return jax.jit(functools.partial(ARCHITECTURE.init, state_size=111))(jax.random.key(0))


def test_weights_are_xavier_uniform_and_biases_a_hundredth() -> None:
    for name, sizes in (("lfm", [114, 256, 256, K]), ("idm", [K, 50, 50, A])):
        for i, (ins, outs) in enumerate(itertools.pairwise(sizes)):
            layer = params()[name]["params"][f"Dense_{i}"]
            limit = np.sqrt(6 / (ins + outs))
            kernel = np.asarray(layer["kernel"])
            assert kernel.shape == (ins, outs) and np.abs(kernel).max() <= limit
            assert np.abs(kernel).max() > 0.95 * limit
            assert kernel.std() == pytest.approx(limit / np.sqrt(3), rel=0.08)
            assert (np.asarray(layer["bias"]) == np.float32(0.01)).all()


def forward(layers: dict, x: np.ndarray, end) -> np.ndarray:
    """In float64: ReLU between the layers, `end` at the end."""
    last = len(layers["params"]) - 1
    for i in range(last + 1):
        layer = layers["params"][f"Dense_{i}"]
        x = x @ np.float64(layer["kernel"]) + np.float64(layer["bias"])
        x = end(x) if i == last else np.maximum(x, 0)
    return x


@dataclasses.dataclass(frozen=True)
class Models:
    """ψ and φ on states as they are."""

    params: dict

    def latent(self, s: jax.Array, d: jax.Array) -> jax.Array:
        return ARCHITECTURE.latent(self.params, s, d)

    def action(self, latent: jax.Array) -> jax.Array:
        return ARCHITECTURE.action(self.params, latent)


def batch(size: int = 64) -> Pairs:
    rng = np.random.default_rng(0)
    s, d = rng.normal(size=(2, size, 111)), rng.normal(size=(2, size, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return Pairs(*(jnp.float32(x) for x in (s, d, rng.uniform(-1, 1, (size, A)))))


def latents(layers: dict, samples: Pairs) -> np.ndarray:
    x = np.concatenate([samples.s, samples.d], axis=-1).astype(float)
    return forward(layers, x, lambda x: np.maximum(x, 0))


def test_the_latent_ends_in_relu_and_the_action_in_tanh() -> None:
    models, samples = Models(params()), batch()
    latent = models.latent(samples.s, samples.d)
    expected = latents(params()["lfm"], samples)
    np.testing.assert_allclose(latent, expected, atol=1e-4)
    assert 0.2 < np.mean(expected == 0) < 0.8  # ReLU cuts some and not others
    action = forward(params()["idm"], 3 * expected, np.tanh)
    np.testing.assert_allclose(models.action(3 * latent), action, atol=1e-4)
    assert np.abs(action).max() > 0.76  # tanh is felt


def test_the_gradient_is_that_of_mean_squared_errors() -> None:
    """λ MSE(γ, γ̂) + (1 − λ) MSE(φ(mean), a), up to one factor, which Adam does not see."""
    samples, weight = batch(), author_settings(LR, AntV2(engine="mujoco")).fit.latent_loss_weight

    def means(p: dict) -> jax.Array:
        models = Models(p)
        latent = models.latent(samples.s, samples.d)
        predicted = models.action(latent.mean(0))
        first, second = (
            jnp.mean((latent[0] - latent[1]) ** 2),
            jnp.mean((predicted - samples.a) ** 2),
        )
        return 0.25 * first + 0.75 * second

    def ours(p: dict) -> jax.Array:
        return loss_siamese(Models(p), samples, weight, mean_latent=True)[0]

    theirs = jax.tree.leaves(jax.jit(jax.grad(means))(params()))
    got = jax.tree.leaves(jax.jit(jax.grad(ours))(params()))
    factor = 0.25 / K + 0.75 / A
    for x, y in zip(got, theirs, strict=True):
        assert np.abs(y).max() > 1e-4
        np.testing.assert_allclose(factor * x, y, rtol=1e-3, atol=1e-7)


# ── the test ────────────────────────────────────────────────────────────────────────────────


def test_targets_lie_in_a_box_that_turns_with_the_start() -> None:
    many = box_scenarios(Point(), 4, 250)
    start = Point().reset(many.keys.reshape(-1), many.yaw.reshape(-1)).position
    way = np.asarray(many.target).reshape(-1, 3) - np.asarray(start)
    yaw = np.asarray(many.yaw, float).reshape(-1)
    ahead = np.cos(yaw) * way[:, 0] + np.sin(yaw) * way[:, 1]
    left = np.cos(yaw) * way[:, 1] - np.sin(yaw) * way[:, 0]
    for x, low, high in ((ahead, 2, 4), (left, -2, 2), (yaw, -np.pi, np.pi)):
        assert low - 1e-4 <= x.min() and x.max() <= high + 1e-4
        share = np.histogram(x, bins=5, range=(low - 1e-4, high + 1e-4))[0] / x.size
        assert np.abs(share - 0.2).max() < 0.05
    np.testing.assert_allclose(way[:, 2], 0, atol=1e-6)  # d is level at the start
    assert np.abs(np.corrcoef([ahead, left, yaw]) - np.eye(3)).max() < 0.1


def test_the_box_is_another_test_on_the_same_starts() -> None:
    box, paper = box_scenarios(Point(), 2, 5), scenarios(Point(), 2, 5)
    assert box.digest() != paper.digest() and box_scenarios(Point()).shape == (10, 100)
    np.testing.assert_array_equal(box.yaw, paper.yaw)
    more = box_scenarios(Point(), 3, 9)
    np.testing.assert_array_equal(more.target[:2, :5], box.target)
    assert box_scenarios(Point(), 1, 5, first_seed=1).target.tolist() == box.target[1:].tolist()


# ── the command ─────────────────────────────────────────────────────────────────────────────


def options(out: Path, **changes) -> authors.Authors:
    test = dataclasses.replace(TEST, goal_radius=0.0)
    usual = dict(scale="0.5", run_dir=out, episodes=3, epochs=2, test=test)
    return authors.Authors(**(usual | changes))


def test_the_row_is_made_end_to_end(tmp_path: Path) -> None:
    report = authors.run(Point(), SMALL, options(tmp_path))
    results = json.loads((report / "results.json").read_text())
    assert results["scenarios"] == box_scenarios(Point(), 10, 3).digest()
    (row,) = results["methods"].values()
    assert list(results["methods"]) == ["LR author epochs 2"]
    assert (row["seeds"], row["episodes"], row["reached"]) == (10, 3, 0)
    fit = row["settings"]["fit"]
    # ⌈0.8 · 0.5 · 2048 / 16⌉ = 52 minibatches an epoch; half the scale makes half of them.
    assert (fit["network"], fit["updates"]) == ("author", 52)
    assert fit["latent_loss_weight"] == pytest.approx((0.25 / 2) / (0.25 / 2 + 0.75 / 3))
    assert row["made"] and row["interactions"] > 0 < row["replayed"]


def test_the_name_says_what_is_not_the_authors() -> None:
    names = [
        authors.row(Point(), LR, authors.Authors(**changes)).name
        for changes in ({}, {"epochs": 50}, {"fraction": 0.25}, {"epochs": 1, "fraction": 1.0})
    ]
    assert names == [
        "LR author",
        "LR author epochs 50",
        "LR author fraction 0.25",
        "LR author epochs 1 fraction 1",
    ]


def test_reaching_ends_no_episode_unless_asked() -> None:
    assert authors.Authors().test == EvaluationSettings(goal_radius=0.0)
    assert (authors.Authors().episodes, authors.Authors().epochs) == (100, 1000)


def test_the_papers_number_is_printed() -> None:
    assert "1.105 ± 0.866 m over 10 × 1000 episodes" in authors.beside_the_paper()


@pytest.mark.parametrize("flags", [("--epochs", "0"), ("--fraction", "2"), ("--paper-settings",)])
def test_bad_input_ends_in_a_sentence(tmp_path, monkeypatch, capsys, flags) -> None:
    monkeypatch.setattr(sys, "argv", ["authors", "--run-dir", str(tmp_path), *flags])
    with pytest.raises(SystemExit) as end:
        run_cli(authors.main, "")
    assert end.value.code == 2 and capsys.readouterr().err.startswith("error: ")
    assert not list(tmp_path.iterdir())
