"""Rows of fitting: updates of a fit, and their matrix products alone."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.bench import Bench
from experiments.benchmark.measuring import Probe, carried, timed
from genidm.paper.fit import Fit, training
from genidm.paper.pairs import Pairs
from genidm.robots import Robot

Shape = tuple[int, int]

# Updates per call.
UPDATES = 100
# Number of samples: more than a CPU cache holds, as in a real fit.
SAMPLES = 200_000


def samples(bench: Bench) -> Pairs:
    """Random noise in the shape of e.m.o. pairs, on the device of the fit."""
    draw, sizes = np.random.default_rng(0), (bench.robot.observation.size, 3)
    s, d = (draw.standard_normal((2, SAMPLES, n), np.float32) for n in sizes)
    a = draw.standard_normal((SAMPLES, bench.robot.action.size), np.float32)
    return jax.device_put(Pairs(s, d, a), jax.devices()[0])


def fitting(bench: Bench, *, settings: Fit) -> Probe:
    """Updates of a fit with these settings."""
    noise = bench.once(samples)
    learner, program = training(bench.robot, noise, jax.random.key(0), settings)
    call = carried(lambda x: program(x, noise, jnp.int32(UPDATES))[0], learner)
    return Probe(timed(call, UPDATES), _networks(settings))


def multiplying(bench: Bench, *, settings: Fit) -> Probe:
    """Only the matrix products of an update, forward and backward.

    These are the products of the gradient of a network of the same shape without biases and
    nonlinearities. The weights change a little: else XLA would move the products out of the loop.
    """
    psi, phi = products(bench.robot, settings)
    keys = jax.random.split(jax.random.key(0), 3)
    weights = _weights(keys[0], psi), _weights(keys[1], phi)
    views = 2 if psi else 1
    x = jax.random.normal(keys[2], (views, settings.batch_size, (psi or phi)[0][0]))

    def loss(weights: tuple[list[jax.Array], list[jax.Array]], x: jax.Array) -> jax.Array:
        gamma = functools.reduce(jnp.matmul, weights[0], x).mean(0)
        return jnp.sum(functools.reduce(jnp.matmul, weights[1], gamma) ** 2)

    def update(_: int, weights: Any) -> Any:
        return jax.tree.map(lambda w, g: w - 1e-9 * g, weights, jax.grad(loss)(weights, x))

    program = jax.jit(lambda w: jax.lax.fori_loop(0, UPDATES, update, w), donate_argnums=0)
    return Probe(timed(carried(program, weights), UPDATES), _networks(settings))


def products(robot: Robot, settings: Fit) -> tuple[list[Shape], list[Shape]]:
    """Shapes of the matrices of ψ (empty if there is none) and of φ."""
    state, latent = robot.observation.size + 3, settings.latent_size
    psi = (state, *settings.lfm, latent) if latent else ()
    phi = (latent or state, *settings.idm, robot.action.size)
    return list(itertools.pairwise(psi)), list(itertools.pairwise(phi))


def _weights(key: jax.Array, shapes: Sequence[Shape]) -> list[jax.Array]:
    keys = jax.random.split(key, len(shapes)) if shapes else ()
    return [
        jax.random.normal(k, shape) / math.sqrt(shape[0])
        for k, shape in zip(keys, shapes, strict=True)
    ]


def _networks(settings: Fit) -> str:
    shown = {"LFM": settings.lfm if settings.latent_size else (), "IDM": settings.idm}
    networks = [f"{k} {'×'.join(map(str, widths))}" for k, widths in shown.items() if widths]
    return f"batch {settings.batch_size}, {', '.join(networks)}"
