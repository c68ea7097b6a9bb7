"""The training loop of the offline learners: one jitted loop for all; the losses are theirs."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax

from genidm import devices, trees
from genidm.errors import BadInput
from genidm.offline.data import Dataset, longest_way, measured
from genidm.offline.learner import Learner
from genidm.offline.policy import GoalPolicy
from genidm.progress import Progress, compile_ahead
from genidm.store import Stage


class TrainingState(flax.struct.PyTreeNode):
    """Everything that training carries from one update to the next.

    Attributes:
      params: parameters of all networks.
      target: the targets.
      optimizer: state of Adam.
      key: key of the minibatches.
      update: number of updates done.
    """

    params: Any
    target: Any
    optimizer: Any
    key: jax.Array
    update: jax.Array


def train(
    data: Dataset,
    key: jax.Array,
    learner: Learner,
    *,
    stage: Stage | None = None,
    chunk: int = 100,
    quiet: bool = False,
) -> GoalPolicy:
    """Train an offline learner on a dataset.

    Args:
      data: a record, with its rotated copies or without. It is copied to one device: an
        accelerator if it has enough memory, else the CPU.
      key: random key of the parameters and the minibatches.
      learner: networks, losses, goals.
      stage: where to write checkpoints and metrics; None writes nothing.
      chunk: updates per program call.
      quiet: do not show a progress bar.

    Raises:
      BadInput: a parameter is not finite any more.
    """
    init_key, stream, statistics = jax.random.split(key, 3)
    device = devices.pick_device(sum(x.nbytes for x in jax.tree.leaves(data)))
    data = measured(jax.device_put(data, device), statistics)
    state = jax.device_put(_start(data, init_key, stream, learner), device)
    checkpoints = stage.checkpoints() if stage else None
    found = checkpoints.latest(state) if checkpoints else None
    done, state = (found[0], jax.device_put(found[1], device)) if found else (0, state)
    program = compile_ahead("train", updates(learner), state, data, jnp.int32(0))
    directory = stage.directory if stage else None
    with Progress("train", learner.updates, "updates", directory, done, quiet) as bar:
        while done < learner.updates:
            count = min(chunk, learner.updates - done)
            state, info = program(state, data, jnp.int32(count))
            done += count
            bar.advance(count, **{name: float(x) for name, x in info.items()})
            _check_finite(state.params, done)
            if checkpoints and checkpoints.due():
                checkpoints.save(done, state)
    return _policy(data, state.params, learner)


def _check_finite(params: Any, count: int) -> None:
    if name := trees.not_finite(params):
        raise BadInput(
            f"{name} holds NaN or infinity after {count} updates: the training has failed. "
            "A smaller learning rate may help"
        )


def _start(
    data: Dataset, init_key: jax.Array, stream: jax.Array, learner: Learner
) -> TrainingState:
    robot = data.robot
    params = learner.init(init_key, robot.observation.size, robot.action.size)
    # A copy, because the loop donates both.
    target = jax.tree.map(jnp.copy, learner.targets(params))
    optimizer = optax.adam(learner.learning_rate).init(params)
    return TrainingState(params, target, optimizer, stream, jnp.zeros((), jnp.int32))


def _policy(data: Dataset, params: Any, learner: Learner) -> GoalPolicy:
    """The controller of the trained actors; the values are left out."""
    architecture = learner.architecture(data.robot.action.size)
    actors = {name: params[name] for name in architecture.names}
    return GoalPolicy(actors, data.mean, data.std, longest_way(data), architecture, data.robot)


def updates(learner: Learner) -> Any:
    """Make the jitted (TrainingState, dataset, count) → (TrainingState, mean reports).

    It makes `count` updates, and donates the TrainingState.
    """
    optimizer = optax.adam(learner.learning_rate)

    def update(state: TrainingState, data: Dataset) -> tuple[TrainingState, dict[str, jax.Array]]:
        # The key depends on the update's number alone, so that `chunk` does not change the result.
        batch = learner.draw(data, jax.random.fold_in(state.key, state.update))
        grads, info = jax.grad(learner.loss, has_aux=True)(state.params, state.target, batch)
        step, optimizer_state = optimizer.update(grads, state.optimizer)
        params = optax.apply_updates(state.params, step)
        target = learner.moved(state.target, state.params)
        return TrainingState(params, target, optimizer_state, state.key, state.update + 1), info

    def run(state: TrainingState, data: Dataset, count: jax.Array) -> tuple[TrainingState, dict]:
        def body(_: int, carry: tuple[TrainingState, dict]) -> tuple[TrainingState, dict]:
            state, info = update(carry[0], data)
            return state, jax.tree.map(jnp.add, carry[1], info)

        _, shapes = jax.eval_shape(update, state, data)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        state, info = jax.lax.fori_loop(0, count, body, (state, zeros))
        return state, jax.tree.map(lambda x: x / count, info)

    return jax.jit(run, donate_argnums=0)
