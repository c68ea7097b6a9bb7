"""Makes `ogbench_reference.npz`: losses, gradients and updates of OGBench's own agents.

The values are those of github.com/seohongpark/ogbench at commit
1d4140997f60c52c6fb0702ec100dc988b18c548 (MIT), on small networks with fixed parameters and one
fixed minibatch. `test_ogbench.py` compares ours with them. To make the file again:

    pip install --no-deps --target LIBS distrax tfp-nightly ml_collections chex dm-tree \\
        cloudpickle gast decorator six toolz
    PYTHONPATH=OGBENCH/impls:LIBS:tests python -m ogbench_reference

OGBENCH is a checkout of the repository; an empty `impls/agents/__init__.py` saves its other
requirements.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from genidm import trees
from genidm.offline.crl import CRL
from genidm.offline.gcbc import GCBC
from genidm.offline.gcivl import GCIVL
from genidm.offline.hiql import HIQL
from genidm.offline.learner import Learner

FILE = Path(__file__).with_suffix(".npz")
# OGBench's goals are states: here both have three numbers, as our goals do.
S, A, K, N = 3, 2, 4, 16
UPDATES = 3

SIZES: dict[str, Any] = dict(policy_hidden_layer_sizes=(4, 3))
VALUES: dict[str, Any] = SIZES | dict(value_hidden_layer_sizes=(4, 3))
LEARNERS: dict[str, Learner] = {
    "gcbc": GCBC(**SIZES),
    "gcivl": GCIVL(**VALUES),
    "hiql": HIQL(**VALUES, representation_size=K),
    "crl": CRL(**VALUES, latent_size=K),
}


# OGBench's setting → ours, for the sizes of networks; every other setting keeps its default.
NAMES = {
    "actor_hidden_dims": "policy_hidden_layer_sizes",
    "value_hidden_dims": "value_hidden_layer_sizes",
    "latent_dim": "latent_size",
    "rep_dim": "representation_size",
}


def normal(tree: Any, seed: int) -> Any:
    """A tree of the same shapes with fixed random numbers of size 0.5."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: np.float32(0.5 * rng.normal(size=x.shape)), tree)


def numbers() -> dict[str, np.ndarray]:
    """A minibatch in OGBench's names; every tenth value goal or so is reached."""
    rng = np.random.default_rng(1)
    names = (
        *("observations", "next_observations", "value_goals", "actor_goals"),
        *("low_actor_goals", "high_actor_goals", "high_actor_targets"),
    )
    batch = {name: np.float32(rng.normal(size=(N, S))) for name in names}
    batch["actions"] = np.float32(rng.uniform(-1, 1, size=(N, A)))
    batch["masks"] = np.float32(rng.uniform(size=N) > 0.3)
    batch["rewards"] = -batch["masks"]
    return batch


def flat(tree: Any) -> np.ndarray:
    """All leaves in one row."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


# ── our parameters in OGBench's places ──────────────────────────────────────────────────


def _mlp(params: dict) -> dict:
    return {name.replace("hidden_", "Dense_"): x for name, x in params.items()}


def _actor(params: dict) -> dict:
    params = params["params"]
    return {"actor_net": _mlp(params["MLP_0"]), "mean_net": params["Dense_0"]}


def _first(params: dict) -> dict:
    (one,) = params["params"].values()
    return _mlp(one)


PLACES = {
    "actor": ("modules_actor", _actor),
    "low_actor": ("modules_low_actor", _actor),
    "high_actor": ("modules_high_actor", _actor),
    "value": ("modules_value", lambda p: {"value_net": _first(p)}),
    "representation": ("modules_goal_rep", lambda p: {"layers_0": _first(p)}),
}


def theirs(params: dict, target: dict) -> dict:
    """Our parameters and targets as OGBench's tree."""
    made = {PLACES[n][0]: PLACES[n][1](p) for n, p in params.items() if n in PLACES}
    if "phi" in params:
        made["modules_critic"] = {n: _first(params[n]) for n in ("phi", "psi")}
    if target:
        made["modules_target_value"] = {"value_net": _first(target["value"])}
    return made


def ours(tree: dict, like: dict, target: bool) -> dict:
    """The leaves of OGBench's tree in our tree: the inverse of `theirs`."""
    # Each leaf of `like` becomes its own number, which `theirs` carries to its place.
    names = trees.named(like)
    index = jax.tree.unflatten(jax.tree.structure(like), range(len(names)))
    places = theirs({} if target else index, index if target else {})
    there = trees.named(tree)
    leaves = {i: there[name] for name, i in trees.named(places).items()}
    return jax.tree.unflatten(jax.tree.structure(like), [leaves[i] for i in range(len(names))])


def fixed(learner: Learner) -> tuple[dict, dict]:
    """Parameters and targets, in our trees."""
    shapes = jax.eval_shape(lambda: learner.init(jax.random.key(0), S, A))
    params = normal(shapes, 2)
    return params, normal(learner.targets(params), 3)


def reference(name: str, learner: Learner) -> dict[str, np.ndarray]:
    """OGBench's loss, gradients, parameters after some updates, and action."""
    module = importlib.import_module(f"agents.{name}")
    config = module.get_config()
    for there, here in NAMES.items():
        if there in config:
            config[there] = getattr(learner, here)
    params, target, batch = jax.tree.map(np.float64, (*fixed(learner), numbers()))
    agent = getattr(module, f"{name.upper()}Agent")
    agent = agent.create(0, batch["observations"], batch["actions"], config)
    start = jax.tree.map(jax.numpy.asarray, theirs(params, target))
    assert jax.tree.map(np.shape, start) == jax.tree.map(np.shape, agent.network.params)
    agent = agent.replace(network=agent.network.replace(params=start))
    grads, info = jax.grad(lambda p: agent.total_loss(batch, p), has_aux=True)(start)
    loss, _ = agent.total_loss(batch, start)
    action = agent.sample_actions(
        batch["observations"], batch["actor_goals"], jax.random.key(0), temperature=0.0
    )
    for _ in range(UPDATES):
        agent, _ = agent.update(batch)
    after = agent.network.params
    found = {"loss": loss, "grads": flat(ours(grads, params, target=False))}
    found |= {"params": flat(ours(after, params, target=False)), "action": action}
    found |= {"target": flat(ours(after, target, target=True))} if target else {}
    return found | {key: x for key, x in info.items() if key.endswith("loss")}


def main() -> None:
    """Writes the file, computed in float64."""
    jax.config.update("jax_enable_x64", True)
    found = {
        f"{name}.{key}": np.asarray(x, np.float32)
        for name, learner in LEARNERS.items()
        for key, x in reference(name, learner).items()
    }
    np.savez_compressed(FILE, **found)


if __name__ == "__main__":
    main()
