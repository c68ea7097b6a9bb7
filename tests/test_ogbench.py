"""The four offline learners against OGBench's own code, whose numbers `ogbench_reference` keeps."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import ogbench_reference as reference
import optax
import pytest

from genidm.offline import crl, gcivl, hiql
from genidm.offline.learner import ActorBatch, Learner

FILE = np.load(reference.FILE)
LEARNERS = pytest.mark.parametrize("name", reference.LEARNERS)

# OGBench's losses → ours; GCBC has one loss only.
PARTS = {
    "value/value_loss": "value_loss",
    "actor/actor_loss": "actor_loss",
    "low_actor/actor_loss": "low_loss",
    "high_actor/actor_loss": "high_loss",
    "critic/contrastive_loss": "critic_loss",
}


def batch(name: str) -> Any:
    """OGBench's minibatch as one of ours: its goals stand for goals relative to the robot."""
    x = reference.numbers()
    s, after, a = x["observations"], x["next_observations"], x["actions"]

    def seen(s: np.ndarray, goal: str) -> np.ndarray:
        return np.concatenate([s, x[goal]], axis=-1)

    value = seen(s, "value_goals")
    actor = seen(s, "actor_goals")
    outcome = dict(value_next=seen(after, "value_goals"), reward=x["rewards"], mask=x["masks"])
    made = {
        "gcbc": lambda: ActorBatch(actor, a),
        "gcivl": lambda: gcivl.Batch(
            value=value, actor=actor, actor_next=seen(after, "actor_goals"), a=a, **outcome
        ),
        "hiql": lambda: hiql.Batch(
            value=value,
            low=seen(s, "low_actor_goals"),
            low_next=seen(after, "low_actor_goals"),
            high=seen(s, "high_actor_goals"),
            subgoal=seen(s, "high_actor_targets"),
            high_next=seen(x["high_actor_targets"], "high_actor_goals"),
            a=a,
            **outcome,
        ),
        "crl": lambda: crl.Batch(value, actor, a),
    }
    return made[name]()


@functools.cache
def theirs(name: str) -> dict[str, np.ndarray]:
    return {key[len(name) + 1 :]: FILE[key] for key in FILE.files if key.startswith(f"{name}.")}


def learned(name: str) -> tuple[Learner, dict, dict]:
    learner = reference.LEARNERS[name]
    return learner, *reference.fixed(learner)


def close(here: Any, there: np.ndarray, rtol: float = 1e-4) -> None:
    """Equal but for float32's rounding, against the largest number.

    In float64, losses and gradients of all four agree with OGBench's to 2e-14.
    """
    here = np.asarray(here)
    assert here.shape == there.shape
    np.testing.assert_allclose(here, there, rtol=0, atol=rtol * np.abs(there).max())


@LEARNERS
def test_loss_and_gradient_are_those_of_ogbench(name: str) -> None:
    learner, params, target = learned(name)
    value = jax.jit(jax.value_and_grad(learner.loss, has_aux=True))
    (loss, info), grads = value(params, target, batch(name))
    close(loss, theirs(name)["loss"])
    for there, here in PARTS.items():
        if there in theirs(name):
            close(info[here if here in info else "loss"], theirs(name)[there])
    close(reference.flat(grads), theirs(name)["grads"])
    assert np.abs(theirs(name)["grads"]).max() > 0.01


@LEARNERS
def test_updates_move_parameters_and_targets_as_those_of_ogbench(name: str) -> None:
    learner, params, target = learned(name)
    optimizer = optax.adam(learner.learning_rate)
    state, one = optimizer.init(params), batch(name)
    gradient = jax.jit(jax.grad(learner.loss, has_aux=True))
    for _ in range(reference.UPDATES):
        grads, _ = gradient(params, target, one)
        step, state = optimizer.update(grads, state)
        params, target = optax.apply_updates(params, step), learner.moved(target, params)
    start, start_target = reference.fixed(learner)
    moved = theirs(name)["params"] - reference.flat(start)
    # Adam divides by the size of the gradient, which also magnifies its rounding.
    close(reference.flat(params) - reference.flat(start), moved, 2e-2)
    assert np.abs(moved).max() > 2 * learner.learning_rate
    if target:
        slowly = theirs(name)["target"] - reference.flat(start_target)
        close(reference.flat(target) - reference.flat(start_target), slowly, 5e-5)


@LEARNERS
def test_the_action_is_that_of_ogbench(name: str) -> None:
    learner, params, _ = learned(name)
    x = reference.numbers()
    seen = jnp.concatenate([x["observations"], x["actor_goals"]], axis=-1)
    action = learner.architecture(reference.A).action(params, seen)
    close(jnp.clip(action, -1, 1), theirs(name)["action"])
