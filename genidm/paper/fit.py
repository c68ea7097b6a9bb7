"""Fitting IDM and LFM/IDM (A.1.2): one jitted loop for every method, over the losses of `idm`."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax

from genidm import devices, trees
from genidm.checks import WIDEST, check, count, layers, number, optional, positive
from genidm.controller import Controller, Frame, in_frame
from genidm.errors import BadInput
from genidm.paper import protocol
from genidm.paper.idm import Architecture, loss_plain, loss_siamese
from genidm.paper.pairs import Pairs
from genidm.progress import Progress, compile_ahead
from genidm.robots.base import Robot
from genidm.store import Stage

STD_FLOOR = 1e-2
# A minibatch of the Ant, in two views through two layers of 256, then takes 3 GB.
MOST_IN_BATCH = 1 << 20


@dataclasses.dataclass(frozen=True)
class Fit:
    """Settings of a fit.

    States are normalised by the mean and standard deviation of the samples; the deviation
    counts as 0.01 at least, so that numbers that hardly ever move are not blown up.

    Attributes:
      updates: minibatches learned from.
      batch_size: samples a minibatch (A.1.2: 512).
      learning_rate: of Adam (A.1.2: 1e-3), at the start.
      cosine_decay: the learning rate falls to 0 along a cosine; off, it stays (the paper's).
      idm: hidden layers of φ (Table 2).
      lfm: hidden layers of ψ (Table 2).
      latent_size: k; None fits an IDM alone.
      latent_loss_weight: λ, weight of the latent loss (Eq. 7), in (0, 1).
      mean_latent: φ is fitted to the mean of a pair's latents (Eq. 6); off, to each of them. The
        mean hides what the two differ by, and in the test there is one latent alone.
    """

    updates: int = 20_000
    batch_size: int = protocol.BATCH_SIZE
    learning_rate: float = protocol.LEARNING_RATE
    cosine_decay: bool = True
    idm: tuple[int, ...] = (256, 256)
    lfm: tuple[int, ...] = (256, 256)
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
            latent_size=optional(count(1, WIDEST)),
            latent_loss_weight=number(0, 1, above=True, below=True),
        )

    def optimizer(self) -> optax.GradientTransformation:
        """Adam, with the schedule."""
        rate = self.learning_rate
        return optax.adam(
            optax.cosine_decay_schedule(rate, self.updates) if self.cosine_decay else rate
        )


def draw_plain(samples: Pairs, key: jax.Array, size: int) -> Pairs:
    """A minibatch from all views alike: G as a set (GE), `s [1, size, S]`."""
    which, seen = jax.random.split(key)
    n = jax.random.randint(which, (size,), 0, samples.a.shape[0])
    v = jax.random.randint(seen, (size,), 0, samples.s.shape[0])
    return Pairs(samples.s[v, n][None], samples.d[v, n][None], samples.a[n])


def draw_siamese(samples: Pairs, key: jax.Array, size: int) -> Pairs:
    """A minibatch of e.m.o. pairs: the record and one of its copies, `s [2, size, S]`."""
    which, seen = jax.random.split(key)
    n = jax.random.randint(which, (size,), 0, samples.a.shape[0])
    v = jax.random.randint(seen, (size,), 1, samples.s.shape[0])
    both = jnp.stack([jnp.zeros_like(v), v])
    return Pairs(samples.s[both, n], samples.d[both, n], samples.a[n])


class FitState(flax.struct.PyTreeNode):
    """All that a fit carries from one update to the next."""

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
    """Fits a controller to samples.

    Args:
      robot: whose states and actions the samples hold.
      samples: E, or G = E ∪ 𝒢(E); with a latent they need two views at least. They lie on
        one device while they are learned from: an accelerator if it has the room, else the CPU.
      key: of the parameters and the minibatches.
      settings: networks, losses, schedule.
      input_frame: the frame that the models see s and d in.
      stage: where checkpoints and metrics go; nowhere, unless given.
      chunk: updates a program call.
      quiet: no progress bar.

    Raises:
      BadInput: a latent was asked for, and there is only one view; or the parameters are not
        finite any more.
    """
    settings = settings or Fit()
    if settings.latent_size is not None and samples.s.shape[0] < 2:
        raise BadInput("an LFM is fitted to pairs, and these samples have one view only")
    samples = jax.device_put(
        samples, devices.pick_device(sum(x.nbytes for x in jax.tree.leaves(samples)))
    )
    samples = jax.jit(functools.partial(_framed, robot, input_frame))(samples)
    learner, updates = training(robot, samples, key, settings, input_frame)
    checkpoints = stage.checkpoints() if stage else None
    found = checkpoints.latest(learner) if checkpoints else None
    done, learner = (found[0], _beside(samples, found[1])) if found else (0, learner)
    program = compile_ahead("fit", updates, learner, samples, jnp.int32(0))
    directory = stage.directory if stage else None
    with Progress("fit", settings.updates, "updates", directory, done, quiet) as bar:
        while done < settings.updates:
            count = min(chunk, settings.updates - done)
            learner, info = program(learner, samples, jnp.int32(count))
            done += count
            bar.advance(count, **{name: float(x) for name, x in info.items()})
            _check_fitted(learner.model, done)
            if checkpoints and checkpoints.due():
                checkpoints.save(done, learner)
    return learner.model


def _check_fitted(model: Controller, updates: int) -> None:
    if name := trees.not_finite(model):
        raise BadInput(
            f"{name} holds NaN or infinity after {updates} updates: what was fitted is of no use. "
            "A smaller learning rate may help"
        )


def training(
    robot: Robot, samples: Pairs, key: jax.Array, settings: Fit, input_frame: Frame = "world"
) -> tuple[FitState, Any]:
    """A fit before its first update, and the program of its updates.

    Args:
      robot: whose states and actions the samples hold.
      samples: `[V, N, ...]`, with s and d in `input_frame` already, on one device.
      key: of the parameters and the minibatches.
      settings: networks, losses, schedule.
      input_frame: the frame that the controller turns what it is given into.

    Returns:
      the learner, and the jitted (learner, samples, count) → (learner, mean losses) of
      `count` updates, which donates the learner.
    """
    learner = _start(robot, samples, key, settings, input_frame)
    return learner, jax.jit(_updates(settings), donate_argnums=0)


def _beside(samples: Pairs, tree: Any) -> Any:
    # One device: a fit is matrix products, which XLA spreads over the cores by itself.
    return jax.device_put(tree, jnp.asarray(samples.a).device)


def _framed(robot: Robot, input_frame: Frame, samples: Pairs) -> Pairs:
    s, d = in_frame(robot, input_frame, samples.s, samples.d)
    return Pairs(s, d, samples.a)


def _start(
    robot: Robot, samples: Pairs, key: jax.Array, settings: Fit, input_frame: Frame
) -> FitState:
    params, stream = jax.random.split(key)
    architecture = Architecture(robot.action.size, settings.idm, settings.lfm, settings.latent_size)
    mean, std = jax.jit(lambda s: (s.mean((0, 1)), s.std((0, 1))))(samples.s)
    model = Controller(
        params=architecture.init(params, robot.observation.size),
        mean=mean,
        std=jnp.maximum(std, STD_FLOOR),
        architecture=architecture,
        input_frame=input_frame,
        robot=robot,
    )
    state = settings.optimizer().init(model.params)
    return _beside(samples, FitState(model, state, stream, jnp.zeros((), jnp.int32)))


def _updates(settings: Fit) -> Any:
    """The function (learner, samples, count) → (learner, mean losses) of `count` updates."""
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

    def update(learner: FitState, samples: Pairs) -> tuple[FitState, dict[str, jax.Array]]:
        # The key of an update depends on its number alone, not on the call it is in.
        batch = draw(samples, jax.random.fold_in(learner.key, learner.update), settings.batch_size)

        def of_params(params: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
            return loss(learner.model.replace(params=params), batch)

        grads, info = jax.grad(of_params, has_aux=True)(learner.model.params)
        step, state = optimizer.update(grads, learner.optimizer)
        model = learner.model.replace(params=optax.apply_updates(learner.model.params, step))
        return FitState(model, state, learner.key, learner.update + 1), info

    def run(learner: FitState, samples: Pairs, count: jax.Array) -> tuple[FitState, dict]:
        def body(_: int, carry: tuple[FitState, dict]) -> tuple[FitState, dict]:
            learner, info = update(carry[0], samples)
            return learner, jax.tree.map(jnp.add, carry[1], info)

        _, shapes = jax.eval_shape(update, learner, samples)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        learner, info = jax.lax.fori_loop(0, count, body, (learner, zeros))
        return learner, jax.tree.map(lambda x: x / count, info)

    return run
