"""Losses against a slow oracle, minibatches, the loop, and the controller that comes out."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point import Point

from genidm import checkpoints, controller, files, symmetry
from genidm.controller import Controller, in_frame
from genidm.errors import BadInput
from genidm.paper.fit import Fit, draw_plain, draw_siamese, fit
from genidm.paper.idm import Architecture, loss_plain, loss_siamese
from genidm.paper.methods import LR
from genidm.paper.pairs import Pairs
from genidm.progress import METRICS, Progress, read_metrics
from genidm.robots import Ant
from genidm.store import Stage

ROBOT = Point()
S, A, K = 10, 3, 4
WEIGHT = 0.3


def model(latent_size: int | None) -> Controller:
    """Models with biases, and with statistics that some inputs exceed by far."""
    architecture = Architecture(A, (7, 6), (9, 8), latent_size)
    params = jax.jit(functools.partial(architecture.init, state_size=S))(jax.random.key(0))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: x + np.float32(0.1) * rng.normal(size=x.shape), params)
    return Controller(
        params=jax.tree.map(jnp.float32, params),
        mean=jnp.float32(rng.normal(size=S)),
        std=jnp.float32(10.0 ** rng.uniform(-2, 1, size=S)),
        architecture=architecture, input_frame="world", robot=ROBOT,
    )  # fmt: skip


act = jax.jit(Controller.__call__)


def samples(views: int, count: int = 32, seed: int = 2) -> Pairs:
    rng = np.random.default_rng(seed)
    s, d = rng.normal(size=(views, count, S)), rng.normal(size=(views, count, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return Pairs(*(jnp.float32(x) for x in (s, d, rng.uniform(-1, 1, size=(count, A)))))


# ── the oracle: NumPy, float64, one sample at a time ────────────────────────────────────


def forward(params: dict, x: np.ndarray) -> np.ndarray:
    layers = [params["params"][f"Dense_{i}"] for i in range(len(params["params"]))]
    for i, layer in enumerate(layers):
        x = np.array([x @ column for column in layer["kernel"].T]) + layer["bias"]
        x = x if i == len(layers) - 1 else np.where(x > 0, x, 0)
    return x


def oracle(
    model: Controller, params: dict, batch: Pairs, mean_latent: bool = True
) -> tuple[float, ...]:
    """L, L1 and L2 (Eq. 5-7); φ sees the mean of two latents, or each of them."""
    s, d, a, mean, std = (np.float64(x) for x in (batch.s, batch.d, batch.a, model.mean, model.std))
    x = np.concatenate([np.clip((s - mean) / std, -10, 10), d], axis=-1)
    first, second = [], []
    for n in range(len(a)):
        if "lfm" not in params:
            second.append(np.sum((forward(params["idm"], x[0, n]) - a[n]) ** 2))
            continue
        gamma, gamma_hat = (forward(params["lfm"], x[view, n]) for view in (0, 1))
        first.append(np.sum((gamma - gamma_hat) ** 2))
        for seen in [(gamma + gamma_hat) / 2] if mean_latent else [gamma, gamma_hat]:
            second.append(np.sum((forward(params["idm"], seen) - a[n]) ** 2))
    latent, action = np.mean(first or [0.0]), np.mean(second)
    return (WEIGHT * latent + (1 - WEIGHT) * action if first else action), latent, action


def losses(latent_size: int | None, mean_latent: bool = True):
    if latent_size is None:
        return loss_plain
    return functools.partial(loss_siamese, latent_loss_weight=WEIGHT, mean_latent=mean_latent)


KINDS = pytest.mark.parametrize(
    ("latent_size", "mean_latent"),
    [(None, True), (K, True), (K, False)],
    ids=["IDM", "mean", "each"],
)


def doubled(params: dict) -> dict:
    return jax.tree.map(np.float64, params)


@KINDS
def test_the_losses_are_those_of_the_paper(latent_size: int | None, mean_latent: bool) -> None:
    one, batch = model(latent_size), samples(views=2)
    loss, info = jax.jit(losses(latent_size, mean_latent))(one, batch)
    expected, latent, action = oracle(one, doubled(one.params), batch, mean_latent)
    assert np.abs((batch.s - one.mean) / one.std).max() > 10  # the clip at 10 is in play
    assert loss == pytest.approx(expected, rel=1e-5) and info["loss"] == loss
    assert info["loss_action"] == pytest.approx(action, rel=1e-5)
    if latent_size:
        assert info["loss_latent"] == pytest.approx(latent, rel=1e-5)
        assert latent > 0.1 and action > 0.1


@KINDS
def test_the_gradient_is_that_of_the_oracle(latent_size: int | None, mean_latent: bool) -> None:
    """Along random directions, by central differences of the oracle in float64."""
    one, batch = model(latent_size), samples(views=2)
    loss = losses(latent_size, mean_latent)
    grads = jax.jit(jax.grad(lambda p: loss(one.replace(params=p), batch)[0]))(one.params)
    rng = np.random.default_rng(3)
    for _ in range(5):
        way = jax.tree.map(lambda x: rng.normal(size=x.shape), one.params)
        at = [
            oracle(one, jax.tree.map(lambda p, w, e=e: p + e * w, doubled(one.params), way), batch,
                   mean_latent)[0]
            for e in (-1e-6, 1e-6)
        ]  # fmt: skip
        slope = sum(np.sum(g * w) for g, w in zip(*map(jax.tree.leaves, (grads, way)), strict=True))
        assert slope == pytest.approx((at[1] - at[0]) / 2e-6, rel=1e-3, abs=1e-3)


def test_the_latent_loss_vanishes_where_two_views_are_one() -> None:
    one, batch = model(K), samples(views=2)
    batch = batch.replace(s=batch.s[jnp.array([0, 0])], d=batch.d[jnp.array([0, 0])])
    _, info = losses(K)(one, batch)
    assert info["loss_latent"] == 0
    assert float(info["loss"]) == pytest.approx(0.7 * float(info["loss_action"]), rel=1e-6)


# ── minibatches ─────────────────────────────────────────────────────────────────────────


def labelled(views: int, count: int) -> Pairs:
    """Samples that say which they are: s is (view, number), a is the number."""
    v, n = jnp.meshgrid(jnp.arange(views), jnp.arange(count), indexing="ij")
    return Pairs(jnp.stack([v, n], axis=-1), jnp.stack([n, v], axis=-1), jnp.arange(count)[:, None])


def test_a_siamese_batch_holds_the_record_and_one_of_its_copies() -> None:
    batch = draw_siamese(labelled(4, 50), jax.random.key(0), 2000)
    view, number = batch.s[..., 0], batch.s[..., 1]
    assert batch.s.shape == (2, 2000, 2)
    np.testing.assert_array_equal(number, np.stack([batch.a[:, 0]] * 2))
    np.testing.assert_array_equal(batch.d[..., ::-1], batch.s)
    assert (view[0] == 0).all()
    assert np.bincount(view[1])[1:].min() > 2000 / 3 * 0.8 and (view[1] > 0).all()
    assert np.bincount(number[0]).min() > 15 and number.max() == 49


def test_a_plain_batch_holds_all_views_alike() -> None:
    batch = draw_plain(labelled(4, 50), jax.random.key(0), 2000)
    view, number = batch.s[..., 0], batch.s[..., 1]
    assert batch.s.shape == (1, 2000, 2)
    np.testing.assert_array_equal(number[0], batch.a[:, 0])
    np.testing.assert_array_equal(batch.d[..., ::-1], batch.s)
    assert np.bincount(view[0]).min() > 400 and np.bincount(number[0]).min() > 15
    assert np.unique(batch.s[0], axis=0).shape[0] == 200  # view and number are drawn apart


# ── fitting ─────────────────────────────────────────────────────────────────────────────

SMALL = Fit(updates=40, batch_size=32, idm=(8,), lfm=(8,), latent_size=2)


def linear(count: int = 4096) -> Pairs:
    """Actions that are a linear map of s and d; view 1 is another look at the same."""
    one = samples(views=1, count=count)
    weights = np.random.default_rng(4).normal(size=(S + 3, A)) / 5
    a = jnp.concatenate([one.s[0], one.d[0]], axis=-1) @ jnp.float32(weights)
    return Pairs(one.s.repeat(2, 0), one.d.repeat(2, 0), a)


def unclipped(model: Controller, s: jax.Array, d: jax.Array) -> jax.Array:
    return model.action(model.latent(s, d))


@pytest.mark.parametrize("latent_size", [None, 6])
def test_a_fit_learns_a_linear_map(latent_size: int | None) -> None:
    settings = Fit(1500, 128, 3e-3, idm=(32,), lfm=(32,), latent_size=latent_size)
    model = fit(ROBOT, linear(), jax.random.key(0), settings, quiet=True)
    unseen = samples(views=1, count=500, seed=7)
    weights = np.random.default_rng(4).normal(size=(S + 3, A)) / 5
    expected = np.concatenate([unseen.s[0], unseen.d[0]], axis=-1) @ weights
    raw = jax.jit(unclipped)(model, unseen.s[0], unseen.d[0])
    error = np.mean((raw - expected) ** 2)
    assert error < 0.01 * expected.var()


@pytest.mark.parametrize("decay", [True, False])
def test_the_learning_rate_falls_along_a_cosine_unless_it_stays(decay: bool) -> None:
    """Adam's step under a gradient that stays is the learning rate, whatever its length."""
    optimizer = Fit(updates=40, learning_rate=3e-3, cosine_decay=decay).optimizer()
    state, steps = optimizer.init(jnp.zeros(1)), []
    for _ in range(40):
        step, state = optimizer.update(jnp.full(1, 7.0), state)
        steps.append(-step[0])
    expected = 3e-3 * (1 + np.cos(np.pi * np.arange(40) / 40)) / 2 if decay else 3e-3
    np.testing.assert_allclose(steps, expected, rtol=1e-4, atol=1e-8)


def test_what_a_fit_reports_falls(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    settings = Fit(300, 64, 3e-3, idm=(16,), lfm=(16,), latent_size=4)
    fit(ROBOT, linear(), jax.random.key(0), settings, stage=stage, chunk=50, quiet=True)
    lines = read_metrics(stage.path(METRICS))
    assert [line["step"] for line in lines] == [50, 100, 150, 200, 250, 300]
    assert lines[-1]["loss_action"] < 0.5 * lines[0]["loss_action"]
    for line in lines:
        mixed = 0.25 * line["loss_latent"] + 0.75 * line["loss_action"]
        assert line["loss"] == pytest.approx(mixed, rel=1e-5)


def test_states_are_normalised_by_their_own_statistics() -> None:
    data = samples(views=2, count=500)
    data = data.replace(s=(data.s * 3 + 5).at[..., 0].set(7.0))
    model = fit(ROBOT, data, jax.random.key(0), SMALL, quiet=True)
    s = np.float64(data.s).reshape(-1, S)
    np.testing.assert_allclose(model.mean, s.mean(0), rtol=1e-5)
    np.testing.assert_allclose(model.std[1:], s.std(0)[1:], rtol=1e-5)
    assert model.std[0] == np.float32(0.01)  # a number that never moves


def test_a_heading_frame_is_fitted_to_what_it_will_see() -> None:
    data = samples(views=1, count=500)
    data = data.replace(s=data.s.at[..., 1:5].set(jnp.array([0.0, 0, 0, 1])))  # turned by 180°
    model = fit(ROBOT, data, jax.random.key(0), GE_SMALL, input_frame="heading", quiet=True)
    np.testing.assert_allclose(model.mean[1:5], [1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(model.mean[5:7], -data.s[0].mean(0)[5:7], atol=1e-5)


GE_SMALL = dataclasses.replace(SMALL, latent_size=None)


def test_keys_matter_and_chunks_do_not() -> None:
    one = fit(ROBOT, linear(64), jax.random.key(0), SMALL, quiet=True)
    again = fit(ROBOT, linear(64), jax.random.key(0), SMALL, chunk=7, quiet=True)
    other = fit(ROBOT, linear(64), jax.random.key(1), SMALL, quiet=True)
    assert same(one, again) and not same(one, other)


def same(a: Controller, b: Controller) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


class Killed(BaseException):
    """Stands for kill -9."""


def test_a_killed_fit_goes_on_to_the_same_bits(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(checkpoints, "CHECKPOINT_SECONDS", 0)
    run = functools.partial(fit, ROBOT, linear(64), jax.random.key(0), SMALL, chunk=10, quiet=True)
    whole, stage = run(), Stage.open(tmp_path, "fit", {})
    advance, calls = Progress.advance, []

    def dying(self, *args, **kwargs):
        calls.append(args)
        if len(calls) == 3:
            raise Killed
        advance(self, *args, **kwargs)

    with monkeypatch.context() as m:
        m.setattr(Progress, "advance", dying)
        with pytest.raises(Killed):
            run(stage=stage)
    assert stage.checkpoints().steps() == [10, 20]
    assert same(run(stage=stage), whole)
    assert [line["step"] for line in read_metrics(stage.path(METRICS))] == [10, 20, 30, 40]
    assert same(run(stage=stage), whole)  # and of one that was done nothing is lost


# ── the controller ──────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("latent_size", [None, K])
def test_a_controller_comes_back_from_the_disk_as_it_was(
    tmp_path: Path, latent_size: int | None
) -> None:
    one = model(latent_size).replace(input_frame="heading")
    one.save(tmp_path / "controller")
    back = controller.load(tmp_path / "controller", ROBOT)
    assert same(one, back) and jax.tree.structure(one) == jax.tree.structure(back)
    assert (back.input_frame, back.architecture) == ("heading", one.architecture)
    s = samples(views=1).s[0]
    np.testing.assert_array_equal(act(one, s, s[:, :3]), act(back, s, s[:, :3]))


def test_a_controller_of_another_robot_is_refused(tmp_path: Path) -> None:
    class Other(Point):
        name = "other"

    model(K).save(tmp_path / "controller")
    with pytest.raises(BadInput, match="controller for point, not for other"):
        controller.load(tmp_path / "controller", Other())


def test_a_corrupt_controller_is_refused(tmp_path: Path) -> None:
    model(K).save(tmp_path / "controller")
    file = next((tmp_path / "controller").glob("params.idm.*.npy"))
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(BadInput, match="cut short"):
        controller.load(tmp_path / "controller", ROBOT)


def test_what_is_no_controller_is_refused(tmp_path: Path) -> None:
    files.save_arrays(tmp_path / "arrays", {"s": np.zeros(3)}, {})
    with pytest.raises(BadInput, match="holds no controller"):
        controller.load(tmp_path / "arrays", ROBOT)
    with pytest.raises(BadInput, match="METHOD-SEED"):
        controller.load(tmp_path)  # as the directory of a test, or of a run under way


def test_a_controller_is_not_saved_over_another_unless_asked(tmp_path: Path) -> None:
    model(K).save(tmp_path / "controller")
    with pytest.raises(BadInput, match="not overwritten"):
        model(None).save(tmp_path / "controller")
    assert controller.load(tmp_path / "controller", ROBOT).architecture.latent_size == K
    model(None).save(tmp_path / "controller", overwrite=True)
    assert controller.load(tmp_path / "controller", ROBOT).architecture.latent_size is None


def test_actions_are_clipped_and_see_only_the_direction() -> None:
    one, data = model(K), samples(views=1)
    s, d = ROBOT.observation.canonical(data.s[0]), data.d[0]
    a, raw = act(one, s, 3.7 * d), jax.jit(unclipped)(one, s, d)
    np.testing.assert_allclose(a, act(one, s, d), atol=1e-5)
    np.testing.assert_allclose(a, np.clip(raw, -1, 1), atol=1e-5)
    assert np.abs(raw).max() > 1 and np.abs(a).max() == 1
    assert np.isfinite(act(one, s, 0 * d)).all()  # standing on the target


def turned(robot, seed: int = 5) -> tuple[tuple, tuple]:
    """States and directions, and the same after the world is turned."""
    rng = np.random.default_rng(seed)
    s = []
    for f in robot.observation.fields:
        x = rng.normal(size=(64, f.size))
        s.append(x / np.linalg.norm(x, axis=-1, keepdims=True) if f.kind == "quaternion" else x)
    s = jnp.float32(np.concatenate(s, axis=-1))
    d, yaw = jnp.float32(rng.normal(size=(64, 3))), jnp.linspace(-3.1, 3.1, 64)
    # To turn by nothing makes the quaternions' w positive.
    s = robot.observation.rotate(s, 0 * yaw)
    return (s, d), (robot.observation.rotate(s, yaw), symmetry.rotate_vector(d, yaw))


def test_the_heading_frame_does_not_see_a_turn(ant: Ant) -> None:
    for robot in (ROBOT, ant):
        here, there = turned(robot)
        seen = [in_frame(robot, "heading", *x) for x in (here, there)]
        for x, y in zip(*seen, strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=2e-5)
        np.testing.assert_allclose(robot.observation.yaw(seen[1][0]), 0, atol=1e-5)
        assert np.abs(here[1] - there[1]).max() > 1
        for x, y in zip(in_frame(robot, "world", *there), there, strict=True):
            np.testing.assert_array_equal(x, y)


def test_a_controller_in_the_heading_frame_steers_alike_after_a_turn() -> None:
    here, there = turned(ROBOT)
    one = model(K).replace(std=jnp.ones(S))
    heading = one.replace(input_frame="heading")
    np.testing.assert_allclose(act(heading, *here), act(heading, *there), atol=1e-4)
    assert np.abs(act(one, *here) - act(one, *there)).max() > 0.1


# ── bad settings ────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("weight", [0.0, 1.0, -0.1, 1.5, float("nan")])
def test_a_latent_weight_outside_0_and_1_is_refused(weight: float) -> None:
    with pytest.raises(BadInput, match="λ"):
        Fit(latent_loss_weight=weight)


@pytest.mark.parametrize("latent_size", [0, -3])
def test_a_latent_of_less_than_one_number_is_refused(latent_size: int) -> None:
    with pytest.raises(BadInput, match="k "):
        Fit(latent_size=latent_size)


@pytest.mark.parametrize("wrong", [{"updates": 0}, {"batch_size": 0}])
def test_a_fit_of_nothing_is_refused(wrong: dict) -> None:
    with pytest.raises(BadInput, match="at least 1"):
        Fit(**wrong)


@pytest.mark.parametrize(
    "wrong",
    [{"goal_horizon": 0}, {"fraction": 0.0}, {"fraction": 1.5}, {"name": "a/b"}, {"name": ".."}],
)
def test_methods_refuse_what_they_cannot_do(wrong: dict) -> None:
    """A name begins those of directories."""
    with pytest.raises(BadInput, match=next(iter(wrong))):
        dataclasses.replace(LR, **wrong)


def test_a_latent_needs_pairs() -> None:
    with pytest.raises(BadInput, match="one view only"):
        fit(ROBOT, samples(views=1), jax.random.key(0), SMALL)


@pytest.mark.parametrize("latent_size", [None, K])
def test_a_fit_that_ends_in_nan_is_refused(tmp_path: Path, latent_size: int | None) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    settings = dataclasses.replace(SMALL, learning_rate=1e30, latent_size=latent_size)

    def work() -> dict:
        fit(ROBOT, linear(64), jax.random.key(0), settings, chunk=10, stage=stage, quiet=True)
        return {}

    with pytest.raises(BadInput, match=r"params/\S+ holds NaN or infinity after \d+ updates"):
        stage.run_once(work)
    assert not stage.done
