"""The fit of an IDM, or of an LFM and an IDM (A.1.2): one jitted loop; the losses are in `idm`."""

from __future__ import annotations

import dataclasses
import functools
import sys
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm.auto import tqdm

from genidm import devices, symmetry, trees
from genidm.checks import WIDEST, check, count, layers, number, optional, positive
from genidm.controller import Controller, Frame, in_frame, relative_bearing
from genidm.errors import BadInput
from genidm.paper import protocol
from genidm.paper.idm import Architecture, Network, loss_plain, loss_siamese
from genidm.paper.pairs import Pairs
from genidm.progress import Progress, compile_ahead
from genidm.robots.base import Robot
from genidm.store import Stage

STD_FLOOR = 1e-2
# The quantiles of the bearing of d that a controller keeps.
QUANTILES = (0.01, 0.99)
# A minibatch of this size takes 3 GB for the Ant: two views through two layers of 256.
MOST_IN_BATCH = 1 << 20


@dataclasses.dataclass(frozen=True)
class Fit:
    """Settings of a fit (A.1.2).

    States are normalised by the mean and standard deviation of the samples. The standard
    deviation is at least 0.01, so that nearly constant numbers are not amplified.

    Attributes:
      updates: number of minibatches.
      batch_size: samples per minibatch (A.1.2: 512).
      learning_rate: initial learning rate of Adam (A.1.2: 1e-3).
      cosine_decay: reduce the learning rate to 0 along a cosine; False keeps it constant (A.1.2).
      idm: hidden layers of φ (Table 2).
      lfm: hidden layers of ψ (Table 2).
      network: "mlp": fully connected layers (Table 2); "residual": a block with layer
        normalisation in place of each layer.
      weight_decay: of AdamW; 0 is the paper's Adam.
      latent_size: k (Eq. 3); None fits an IDM without an LFM.
      latent_loss_weight: λ, weight of the latent loss (Eq. 7), in (0, 1).
      mean_latent: fit φ to the mean of a pair's latents (Eq. 6); False fits it to each latent.
        The mean hides the difference of the two, and the test has one latent only (Remark 1).
    """

    updates: int = 20_000
    batch_size: int = protocol.BATCH_SIZE
    learning_rate: float = protocol.LEARNING_RATE
    cosine_decay: bool = True
    idm: tuple[int, ...] = (256, 256)
    lfm: tuple[int, ...] = (256, 256)
    network: Network = "mlp"
    weight_decay: float = 0.0
    latent_size: int | None = None
    latent_loss_weight: float = protocol.LATENT_WEIGHT
    mean_latent: bool = True

    def __post_init__(self) -> None:
        check(
            self,
            {"latent_loss_weight": "λ (latent_loss_weight)", "latent_size": "k (latent_size)"},
            updates=count(),
            batch_size=count(1, MOST_IN_BATCH),
            learning_rate=positive(),
            idm=layers,
            lfm=layers,
            weight_decay=number(0),
            latent_size=optional(count(1, WIDEST)),
            latent_loss_weight=number(0, 1, above=True, below=True),
        )
        for name in ("idm", "lfm") if self.network == "residual" else ():
            if len(set(sizes := getattr(self, name))) != 1:
                raise BadInput(f"{name}: residual blocks are all of one width, not {sizes}")

    def optimizer(self) -> optax.GradientTransformation:
        """Make Adam, or AdamW, with the learning rate schedule."""
        rate: optax.ScalarOrSchedule = self.learning_rate
        if self.cosine_decay:
            rate = optax.cosine_decay_schedule(self.learning_rate, self.updates)
        if self.weight_decay:
            return optax.adamw(rate, weight_decay=self.weight_decay)
        return optax.adam(rate)


def draw_plain(samples: Pairs, key: jax.Array, size: int) -> Pairs:
    """Draw a minibatch from all views alike (G as a set, GE), with `s [1, size, S]`."""
    sample_key, view_key = jax.random.split(key)
    n = jax.random.randint(sample_key, (size,), 0, samples.a.shape[0])
    v = jax.random.randint(view_key, (size,), 0, samples.s.shape[0])
    return Pairs(samples.s[v, n][None], samples.d[v, n][None], samples.a[n])


def draw_siamese(samples: Pairs, key: jax.Array, size: int) -> Pairs:
    """Draw a minibatch of e.m.o. pairs, the record and one of its copies, with `s [2, size, S]`."""
    sample_key, view_key = jax.random.split(key)
    n = jax.random.randint(sample_key, (size,), 0, samples.a.shape[0])
    v = jax.random.randint(view_key, (size,), 1, samples.s.shape[0])
    both = jnp.stack([jnp.zeros_like(v), v])
    return Pairs(samples.s[both, n], samples.d[both, n], samples.a[n])


class FitState(flax.struct.PyTreeNode):
    """Everything that a fit carries from one update to the next."""

    model: Controller
    optimizer: Any
    key: jax.Array
    update: jax.Array


def fit(
    robot: Robot,
    samples: Pairs,
    key: jax.Array,
    settings: Fit | None = None,
    *,
    input_frame: Frame = "world",
    stage: Stage | None = None,
    chunk: int = 1000,
    quiet: bool = False,
) -> Controller:
    """Fit a controller to samples (A.1.2).

    Args:
      robot: robot whose states and actions the samples hold.
      samples: E, or G = E ∪ 𝒢(E); an LFM needs at least two views. The fit copies them to one
        device: an accelerator if it has enough memory, else the CPU.
      key: random key of the parameters and the minibatches.
      settings: networks, losses, schedule.
      input_frame: frame of the s and d that the models see.
      stage: where to write checkpoints and metrics; None writes nothing.
      chunk: updates per program call.
      quiet: do not show a progress bar.

    Raises:
      BadInput: the settings have a latent, but the samples have one view; or a parameter is
        not finite any more.
    """
    settings = settings or Fit()
    if settings.latent_size is not None and samples.s.shape[0] < 2:
        raise BadInput("an LFM needs pairs, but these samples have one view only")
    samples = jax.device_put(
        samples, devices.pick_device(sum(x.nbytes for x in jax.tree.leaves(samples)))
    )
    samples = jax.jit(functools.partial(_in_input_frame, robot, input_frame))(samples)
    state, updates = training(robot, samples, key, settings, input_frame)
    if not quiet:
        low, high = np.degrees(state.model.bearings).round()
        said = f"98 % of d lie between {low:.0f}° and {high:.0f}° of the heading"
        tqdm.write(f"fit: {said}".replace("-", "−"), file=sys.stderr)
    checkpoints = stage.checkpoints() if stage else None
    found = checkpoints.latest(state) if checkpoints else None
    done, state = (found[0], _on_device_of(samples, found[1])) if found else (0, state)
    program = compile_ahead("fit", updates, state, samples, jnp.int32(0))
    directory = stage.directory if stage else None
    with Progress("fit", settings.updates, "updates", directory, done, quiet) as bar:
        while done < settings.updates:
            count = min(chunk, settings.updates - done)
            state, info = program(state, samples, jnp.int32(count))
            done += count
            bar.advance(count, **{name: float(x) for name, x in info.items()})
            _check_fitted(state.model, done)
            if checkpoints and checkpoints.due():
                checkpoints.save(done, state)
    return state.model


def _check_fitted(model: Controller, updates: int) -> None:
    if name := trees.not_finite(model):
        raise BadInput(
            f"{name} holds NaN or infinity after {updates} updates: the fit has failed. "
            "A smaller learning rate may help"
        )


def training(
    robot: Robot, samples: Pairs, key: jax.Array, settings: Fit, input_frame: Frame = "world"
) -> tuple[FitState, Any]:
    """Make the state of a fit before its first update, and the function of its updates.

    Args:
      robot: robot whose states and actions the samples hold.
      samples: `[V, N, ...]`, with s and d in `input_frame` already, on one device.
      key: random key of the parameters and the minibatches.
      settings: networks, losses, schedule.
      input_frame: frame into which the controller rotates its inputs.

    Returns:
      the FitState, and the jitted (FitState, samples, count) → (FitState, mean losses) of
      `count` updates, which donates the FitState.
    """
    state = _start(robot, samples, key, settings, input_frame)
    return state, jax.jit(_updates(settings), donate_argnums=0)


def _on_device_of(samples: Pairs, tree: Any) -> Any:
    # One device is enough: XLA itself spreads the matrix products of a fit over the cores.
    return jax.device_put(tree, jnp.asarray(samples.a).device)


def _in_input_frame(robot: Robot, input_frame: Frame, samples: Pairs) -> Pairs:
    s, d = in_frame(robot, input_frame, samples.s, samples.d)
    return Pairs(s, d, samples.a)


def _start(
    robot: Robot, samples: Pairs, key: jax.Array, settings: Fit, input_frame: Frame
) -> FitState:
    params, stream = jax.random.split(key)
    architecture = Architecture(
        robot.action.size, settings.idm, settings.lfm, settings.latent_size, settings.network
    )
    mean, std = jax.jit(lambda s: (s.mean((0, 1)), s.std((0, 1))))(samples.s)
    model = Controller(
        params=architecture.init(params, robot.observation.size),
        mean=mean,
        std=jnp.maximum(std, STD_FLOOR),
        architecture=architecture,
        input_frame=input_frame,
        robot=robot,
        bearings=_bearings(robot, samples),
    )
    optimizer = settings.optimizer().init(model.params)
    return _on_device_of(samples, FitState(model, optimizer, stream, jnp.zeros((), jnp.int32)))


def _bearings(robot: Robot, samples: Pairs) -> np.ndarray:
    """Measure `Controller.bearings`; the views of a sample have one bearing, so one view counts.

    The quantiles are taken of the angle to the mean direction, so that they do not depend on
    where the circle is cut. A range that crosses ±π becomes the full circle.
    """
    angle = np.asarray(
        jax.jit(lambda x: relative_bearing(robot, x.s[0], x.d[0]))(samples), np.float64
    )
    centre = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
    low, high = centre + np.quantile(np.asarray(symmetry.wrap(angle - centre)), QUANTILES)
    known = -np.pi <= low and high <= np.pi
    return np.array([low, high] if known else [-np.pi, np.pi], np.float32)


def _updates(settings: Fit) -> Any:
    """Make the function (FitState, samples, count) → (FitState, mean losses) of `count` updates."""
    siamese = settings.latent_size is not None
    draw = draw_siamese if siamese else draw_plain
    loss = (
        functools.partial(
            loss_siamese,
            latent_loss_weight=settings.latent_loss_weight,
            mean_latent=settings.mean_latent,
        )
        if siamese
        else loss_plain
    )
    optimizer = settings.optimizer()

    def update(state: FitState, samples: Pairs) -> tuple[FitState, dict[str, jax.Array]]:
        # The key depends on the update's number alone, so that `chunk` does not change the result.
        batch = draw(samples, jax.random.fold_in(state.key, state.update), settings.batch_size)

        def of_params(params: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
            return loss(state.model.replace(params=params), batch)

        grads, info = jax.grad(of_params, has_aux=True)(state.model.params)
        step, optimizer_state = optimizer.update(grads, state.optimizer)
        model = state.model.replace(params=optax.apply_updates(state.model.params, step))
        return FitState(model, optimizer_state, state.key, state.update + 1), info

    def run(state: FitState, samples: Pairs, count: jax.Array) -> tuple[FitState, dict]:
        def body(_: int, carry: tuple[FitState, dict]) -> tuple[FitState, dict]:
            state, info = update(carry[0], samples)
            return state, jax.tree.map(jnp.add, carry[1], info)

        _, shapes = jax.eval_shape(update, state, samples)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        state, info = jax.lax.fori_loop(0, count, body, (state, zeros))
        return state, jax.tree.map(lambda x: x / count, info)

    return run
