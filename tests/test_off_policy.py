"""SAC and DDPG: their losses, what they learn on a point, and what is kept of it."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from bits import close, flip, leaves, same, truncate
from brax.training.acme import running_statistics
from brax.training.agents.sac.losses import make_losses
from brax.training.agents.sac.networks import make_sac_networks
from brax.training.types import Transition as BraxTransition
from killing import Killed, dies_at
from point import Point
from prepared import Prepared

from genidm import devices, tasks
from genidm.agents import collect as collecting
from genidm.agents import unroll
from genidm.agents.collect import collect
from genidm.agents.ddpg import DDPG
from genidm.agents.her import HER
from genidm.agents.off_policy import OffPolicy, half_mirrored
from genidm.agents.policy import no_statistics, normalize
from genidm.agents.remembering import Remembering
from genidm.agents.sac import SAC
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings, evaluate
from genidm.evaluation.scenarios import scenarios
from genidm.experience import load_chunks
from genidm.files import load_json
from genidm.progress import METRICS, Progress, read_metrics
from genidm.robots import Robot, State
from genidm.store import Stage
from genidm.tasks import EnvState, GoToGoal, Outcome, Sparse, Task, Transition, WalkForward, inputs

# It falls, it diverges, and it runs into the time limit; the ring is full after 3 iterations.
ROBOT = Point(speed=2.0, falls_at=0.25, diverges_at=0.3)
SMALL: dict[str, Any] = dict(
    num_envs=16,
    unroll_length=8,
    grad_updates_per_step=4,
    batch_size=32,
    max_replay_size=400,
    min_replay_size=200,
    policy_hidden_layer_sizes=(16,),
    critic_hidden_layer_sizes=(16,),
)
SIZE = 16 * 8
ITERATIONS = 5

# With goals and hindsight, and without.
LEARNERS: dict[str, tuple[OffPolicy, Task]] = {
    "SAC": (SAC(**SMALL, her=HER()), GoToGoal(reward=Sparse(), episode_steps=9)),
    "DDPG": (DDPG(**SMALL), WalkForward(episode_steps=9)),
}
PREPARED = {name: Prepared(agent) for name, (agent, _) in LEARNERS.items()}
each = pytest.mark.parametrize("name", LEARNERS)


def gather(name: str, **options) -> tuple[Any, Any]:
    options = dict(task=LEARNERS[name][1], quiet=True) | options
    return collect(ROBOT, PREPARED[name], ITERATIONS * SIZE, **options)


@functools.cache
def undisturbed(name: str) -> tuple[Any, Any]:
    return gather(name)


# ── SAC's losses, against Brax's ────────────────────────────────────────────────────────

INPUTS, ACTIONS, BATCH = 13, 3, 64
SETTINGS: dict[str, Any] = dict(
    policy_hidden_layer_sizes=(16, 12),
    critic_hidden_layer_sizes=(16, 12),
    discounting=0.9,
    reward_scaling=0.3,
    tau=0.2,
)


def minibatch(seed: int = 0) -> BraxTransition:
    """Some steps are ends, some are cut off, and some inputs are far out."""
    rng = np.random.default_rng(seed)
    x, x_next = rng.normal(size=(2, BATCH, INPUTS)) * np.where(rng.random(INPUTS) < 0.2, 50, 1)
    terminal, cut = np.arange(BATCH) % 5 == 0, np.arange(BATCH) % 7 == 1
    return BraxTransition(
        observation=jnp.float32(x),
        action=jnp.float32(rng.uniform(-1, 1, size=(BATCH, ACTIONS))),
        reward=jnp.float32(3 * rng.normal(size=BATCH)),
        discount=jnp.float32(~terminal),
        next_observation=jnp.float32(x_next),
        extras={"state_extras": {"truncation": jnp.float32(cut & ~terminal)}},
    )


@functools.cache
def statistics() -> Any:
    rng = np.random.default_rng(1)
    seen = jnp.float32(rng.normal(size=(100, INPUTS)) * rng.uniform(0.1, 2, INPUTS) + 0.3)
    return running_statistics.update(no_statistics(INPUTS), seen)


@functools.cache
def algorithm(agent: OffPolicy) -> Any:
    """Its start and its update, compiled."""
    made = agent.algorithm(ROBOT, INPUTS)
    return made._replace(start=jax.jit(made.start), update=jax.jit(made.update))


def descent(loss: Callable) -> Callable:
    """(params, state of Adam, rest of the loss's arguments) → (loss, params, state)."""
    value_and_grad, adam = jax.value_and_grad(loss), optax.adam(1e-3)

    @jax.jit
    def step(params: Any, state: Any, *rest: Any) -> tuple[Any, Any, Any]:
        value, slope = value_and_grad(params, *rest)
        change, state = adam.update(slope, state)
        return value, optax.apply_updates(params, change), state

    return step


def test_sacs_update_is_made_of_braxs_losses() -> None:
    """In Brax's order, but that the policy climbs the critic as it has just become."""
    agent = SAC(**SETTINGS)
    networks = make_sac_networks(INPUTS, ACTIONS, normalize, agent.policy_hidden_layer_sizes)
    alpha_step, critic_step, policy_step = map(descent, make_losses(networks, 0.3, 0.9, ACTIONS))
    ours = algorithm(agent).start(jax.random.key(0))
    same(ours.critic, ours.target)
    policy, critic, target, log_alpha = ours.policy, ours.critic, ours.target, ours.log_alpha
    states = [optax.adam(1e-3).init(p) for p in (log_alpha, critic, policy)]
    for i in range(3):
        batch, key = minibatch(i), jax.random.key(i)
        ours, info = algorithm(agent).update(ours, statistics(), batch, key)
        keys, alpha, stats = jax.random.split(key, 3), jnp.exp(log_alpha), statistics()
        _, log_alpha, states[0] = alpha_step(log_alpha, states[0], policy, stats, batch, keys[0])
        critic_loss, critic, states[1] = critic_step(
            critic, states[1], policy, stats, target, alpha, batch, keys[1]
        )
        policy_loss, policy, states[2] = policy_step(
            policy, states[2], stats, critic, alpha, batch, keys[2]
        )
        target = jax.tree.map(lambda x, y: 0.8 * x + 0.2 * y, target, critic)
        theirs = (policy, critic, target, log_alpha)
        close((ours.policy, ours.critic, ours.target, ours.log_alpha), theirs, atol=1e-5)
        losses = {"critic_loss": critic_loss, "policy_loss": policy_loss, "alpha": alpha}
        close(info, losses, atol=1e-4)


# ── DDPG's losses, in NumPy and float64, one sample at a time ───────────────────────────


def forward(params: dict, x: np.ndarray) -> np.ndarray:
    layers = [params[f"hidden_{i}"] for i in range(len(params))]
    for i, layer in enumerate(layers):
        x = np.array([x @ column for column in layer["kernel"].T]) + layer["bias"]
        x = x if i == len(layers) - 1 else np.where(x > 0, x, 0)
    return x


def normal(x: np.ndarray) -> np.ndarray:
    mean, std = np.float64(statistics().mean), np.float64(statistics().std)
    return np.clip((np.float64(x) - mean) / std, -10, 10)


def mu(policy: Any, x: np.ndarray) -> np.ndarray:
    return forward(policy["params"], normal(x))


def q(critic: Any, x: np.ndarray, a: np.ndarray) -> float:
    return forward(critic["params"]["MLP_0"], np.concatenate([normal(x), np.float64(a)]))[0]


def critic_oracle(
    critic: Any, policy_target: Any, critic_target: Any, batch: BraxTransition
) -> float:
    total = 0.0
    for i in range(BATCH):
        if batch.extras["state_extras"]["truncation"][i]:
            continue  # nobody knows what would have come
        value = 0.3 * float(batch.reward[i])
        if batch.discount[i]:
            x_next = np.asarray(batch.next_observation[i])
            value += 0.9 * q(critic_target, x_next, np.tanh(mu(policy_target, x_next)))
        here = q(critic, np.asarray(batch.observation[i]), np.asarray(batch.action[i]))
        total += 0.5 * (here - value) ** 2
    return total / BATCH


def policy_oracle(policy: Any, critic: Any, batch: BraxTransition) -> float:
    total = 0.0
    for x in np.asarray(batch.observation):
        raw = mu(policy, x)
        total += 0.05 * np.mean(raw**2) - q(critic, x, np.tanh(raw))
    return total / BATCH


def float64(tree: Any) -> Any:
    return jax.tree.map(np.float64, tree)


AGENT_OF_ORACLE = DDPG(**SETTINGS, action_cost=0.05)


@functools.cache
def updated() -> tuple[Any, Any, dict[str, Any]]:
    """DDPG's networks, all unlike each other, before and after an update."""
    update, start = algorithm(AGENT_OF_ORACLE).update, algorithm(AGENT_OF_ORACLE).start
    n, other = start(jax.random.key(0)), start(jax.random.key(1))
    same((n.policy, n.critic), (n.policy_target, n.critic_target))
    n = n.replace(policy_target=other.policy, critic_target=other.critic)
    after, info = update(n, statistics(), minibatch(), jax.random.key(2))
    return float64(n), float64(after), info


def test_ddpgs_losses_are_the_oracles() -> None:
    before, after, info = updated()
    batch = minibatch()
    expected = critic_oracle(before.critic, before.policy_target, before.critic_target, batch)
    assert info["critic_loss"] == pytest.approx(expected, abs=1e-5, rel=1e-5)
    expected = policy_oracle(before.policy, after.critic, batch)
    assert info["policy_loss"] == pytest.approx(expected, abs=1e-5, rel=1e-5)


def test_ddpgs_slopes_are_the_oracles_and_no_target_is_moved_by_them() -> None:
    """Along directions drawn at random, by differences; a first step of Adam is a sign."""
    before, after, _ = updated()
    batch, rng = minibatch(), np.random.default_rng(3)
    losses = {
        "critic": lambda p: critic_oracle(p, before.policy_target, before.critic_target, batch),
        "policy": lambda p: policy_oracle(p, after.critic, batch),
    }
    for name, loss in losses.items():
        old, new = getattr(before, name), getattr(after, name)
        moved = jax.tree.map(lambda x, y: y - x, old, new)
        sizes = np.concatenate([abs(x).ravel() for x in jax.tree.leaves(moved)])
        assert sizes.max() == pytest.approx(1e-3, rel=1e-3) and np.median(sizes) > 0.9e-3
        state = getattr(after, f"{name}_optimizer")[0]
        slope = jax.tree.map(lambda m: m / 0.1, state.mu)  # Adam's first moment after a step
        way = jax.tree.map(lambda x: rng.normal(size=x.shape), old)
        ahead, behind = (
            loss(jax.tree.map(lambda x, v, h=h: x + h * v, old, way)) for h in (1e-6, -1e-6)
        )
        along = sum(np.sum(g * v) for g, v in zip(*map(jax.tree.leaves, (slope, way)), strict=True))
        assert along == pytest.approx((ahead - behind) / 2e-6, rel=1e-3) and abs(along) > 1e-3
        assert all(
            (np.sign(m) == -np.sign(g))[abs(g) > 1e-6].all()
            for m, g in zip(*map(jax.tree.leaves, (moved, slope)), strict=True)
        )


def test_ddpgs_targets_follow() -> None:
    before, after, _ = updated()
    for name in ("policy", "critic"):
        old, new = getattr(before, f"{name}_target"), getattr(after, name)
        expected = jax.tree.map(lambda x, y: 0.8 * x + 0.2 * y, old, new)
        close(getattr(after, f"{name}_target"), expected, atol=1e-6)


@pytest.mark.parametrize("agent", [SAC(**SETTINGS), AGENT_OF_ORACLE])
def test_what_is_cut_off_teaches_nothing(agent: OffPolicy) -> None:
    batch, other = minibatch(), minibatch(7)
    cut = batch.extras["state_extras"]["truncation"] > 0
    changed = batch._replace(
        reward=jnp.where(cut, other.reward, batch.reward),
        next_observation=jnp.where(cut[:, None], other.next_observation, batch.next_observation),
    )
    n, key = algorithm(agent).start(jax.random.key(0)), jax.random.key(1)
    after, again = (algorithm(agent).update(n, statistics(), b, key) for b in (batch, changed))
    same(after, again)
    whole = changed._replace(extras={"state_extras": {"truncation": 0 * batch.reward}})
    assert (
        algorithm(agent).update(n, statistics(), whole, key)[1]["critic_loss"]
        != after[1]["critic_loss"]
    )


# ── exploring ───────────────────────────────────────────────────────────────────────────


def actions(agent: OffPolicy, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Actions `[count, 3]` in one state, and what the policy says of it before tanh."""
    policy = algorithm(agent).start(jax.random.key(0)).policy
    x = minibatch().observation[0]
    numbers = jax.vmap(algorithm(agent).draw)(jax.random.split(jax.random.key(1), count))
    act = jax.jit(algorithm(agent).act)
    a, intended = act(statistics(), policy, jnp.broadcast_to(x, (count, *x.shape)), numbers)
    raw = mu(float64(policy), np.asarray(x))
    expected = np.broadcast_to(np.tanh(raw[:ACTIONS]), (count, ACTIONS))
    np.testing.assert_allclose(intended, expected, rtol=0, atol=1e-5)
    return np.asarray(a), raw


@pytest.mark.parametrize("kind", [SAC, DDPG])
def test_a_mirrored_policy_acts_as_its_own_mirror_image(kind: Any) -> None:
    agent = kind(**SETTINGS, mirror=True)
    made = agent.algorithm(ROBOT, INPUTS)
    policy = jax.jit(made.start)(jax.random.key(0)).policy
    x = minibatch().observation[:, : ROBOT.observation.size + 3]
    numbers = jax.vmap(made.draw)(jax.random.split(jax.random.key(1), BATCH))
    wide = no_statistics(x.shape[-1])
    intended = [
        np.asarray(made.act(wide, policy, y, numbers)[1])
        for y in (x, tasks.mirror_inputs(ROBOT, x))
    ]
    np.testing.assert_allclose(intended[1], intended[0] * [1, -1, -1], atol=1e-5)
    assert np.abs(intended[0]).min(axis=0).max() > 0


def test_half_of_a_minibatch_is_reflected() -> None:
    rng = np.random.default_rng(2)
    s, goal = rng.normal(size=(2, BATCH, ROBOT.observation.size)), rng.normal(size=(2, BATCH, 3))
    x, x_next = jnp.float32(np.concatenate([s, goal], axis=-1))
    batch = minibatch()._replace(observation=x, next_observation=x_next)
    mixed = half_mirrored(ROBOT, batch, jax.random.key(0))
    reflected = np.asarray(mixed.action[:, 1] != batch.action[:, 1])
    assert 0.3 < reflected.mean() < 0.7

    def mirrored(x: jax.Array) -> np.ndarray:
        s, goal = np.split(np.asarray(x), [ROBOT.observation.size], axis=-1)
        return np.concatenate([ROBOT.observation.mirror(s), goal * [1, -1, 1]], axis=-1)

    expected = batch._replace(
        observation=mirrored(batch.observation),
        next_observation=mirrored(batch.next_observation),
        action=batch.action * jnp.array([1, -1, -1]),
    )
    for ours, plain, mirror in zip(leaves(mixed), leaves(batch), leaves(expected), strict=True):
        close(ours[reflected], mirror[reflected], atol=1e-6)
        close(ours[~reflected], plain[~reflected], atol=1e-6)


def test_ddpg_explores_around_its_policy_and_at_times_anywhere() -> None:
    a, raw = actions(DDPG(**SETTINGS, noise=0.05, random=0.2))
    off = a - np.tanh(raw)
    near = abs(off).max(-1) < 0.3
    assert abs(a).max() <= 1 and abs(near.mean() - 0.8) < 0.03
    inside = abs(np.tanh(raw)) < 0.8
    assert inside.any() and off[near].std(0)[inside] == pytest.approx(0.05, rel=0.3)
    far = a[~near]
    assert abs(far.mean(0)).max() < 0.15 and np.ptp(far, axis=0).min() > 1.9


def test_sac_explores_as_its_policy_says() -> None:
    a, raw = actions(SAC(**SETTINGS))
    mean, scale = raw[:ACTIONS], np.log1p(np.exp(raw[ACTIONS:])) + 1e-3
    drawn = np.arctanh(np.float64(np.clip(a, -1 + 1e-7, 1 - 1e-7)))
    assert abs(np.median(drawn, axis=0) - mean).max() < 0.1 * scale.max()
    low, high = np.quantile(drawn, (0.1587, 0.8413), axis=0)
    np.testing.assert_allclose((high - low) / 2, scale, rtol=0.1)


# ── what is learned ─────────────────────────────────────────────────────────────────────

BONUS, REST, DISCOUNT = 0.5, -0.25, 0.8
LATER = DISCOUNT / (1 - DISCOUNT)


def wanted(way: jax.Array) -> jax.Array:
    far = jnp.linalg.norm(way[..., :2], axis=-1, keepdims=True)
    return 0.5 * way.at[..., 2].set(0.0) / far


@dataclasses.dataclass(frozen=True)
class Pointing(GoToGoal):
    """Actions are to point to the goal; a step is an end where that lies at x > 0.

    Every value is known: the robot stands still, and the best reward of any step is BONUS.
    After an end that is REST; the time limit changes nothing.
    """

    episode_steps: int = 4
    bearing: float = math.pi

    def transition(
        self, robot: Robot, lanes: EnvState, action: jax.Array, after: State
    ) -> Transition:
        reward = BONUS - jnp.sum((action - wanted(lanes.relative_goal)) ** 2, axis=-1)
        outcome = Outcome(reward, lanes.relative_goal[:, 0] > 0, jnp.full_like(reward, REST))
        return tasks.to_transition(lanes, action, after, outcome, self.episode_steps)


def critics(agent: Any, learner: Any, x: jax.Array, a: jax.Array) -> np.ndarray:
    networks = agent.networks(ROBOT, x.shape[-1])
    network = networks.q_network if isinstance(agent, SAC) else networks[1]
    training = learner.training_state
    return np.asarray(network.apply(training.statistics, training.networks.critic, x, a)).min(-1)


def entropy_bonus(agent: Any, learner: Any, x: jax.Array, best: jax.Array) -> np.ndarray:
    """What SAC's own noise costs a step, and its entropy is worth; DDPG has none."""
    if not isinstance(agent, SAC):
        return np.zeros(len(x))
    networks, training = agent.networks(ROBOT, x.shape[-1]), learner.training_state
    distribution = networks.parametric_action_distribution
    logits = networks.policy_network.apply(training.statistics, training.networks.policy, x)
    raw = distribution.sample_no_postprocessing(logits, jax.random.key(5))
    miss = jnp.sum((jnp.tanh(raw) - best) ** 2, axis=-1)
    alpha = jnp.exp(training.networks.log_alpha)
    return np.asarray(-miss - alpha * distribution.log_prob(logits, raw))


@pytest.mark.parametrize("learner", [SAC, DDPG])
def test_values_and_actions_are_the_known_ones(learner: type) -> None:
    agent = learner(
        num_envs=16,
        unroll_length=8,
        grad_updates_per_step=16,
        batch_size=64,
        min_replay_size=500,
        policy_hidden_layer_sizes=(32,),
        critic_hidden_layer_sizes=(32, 32),
        discounting=DISCOUNT,
        learning_rate=3e-3,
        tau=0.02,
    )
    robot, task = Point(speed=0.0), Pointing()
    _, learned = collect(robot, agent, 30_000, task=task, keep=False, quiet=True)
    lanes = jax.jit(functools.partial(task.start, robot))(jax.random.split(jax.random.key(9), 600))
    s, way = lanes.robots.observation, lanes.relative_goal
    best = wanted(way)
    actor_params = jax.jit(agent.policy(robot, task, learned).__call__)(s, way)
    missed = np.sqrt(np.sum((actor_params - best) ** 2, axis=-1))
    assert missed.mean() < 0.25  # of 0.5 that standing still would miss
    x = inputs(s, way)
    noise = entropy_bonus(agent, learned, x, best)
    anything = jax.random.uniform(jax.random.key(3), best.shape, minval=-1.0)
    for side in (way[:, 0] < -0.5, way[:, 0] > 0.5):
        side = np.asarray(side)
        later = LATER * (REST if way[side][0, 0] > 0 else BONUS + noise[side].mean())
        for a in (best, anything):
            known = BONUS - np.sum((a - best) ** 2, axis=-1) + later
            error = (critics(agent, learned, x, a) - known)[side]
            assert abs(error).mean() < 0.3 and abs(error.mean()) < 0.2


def share_reached(agent: OffPolicy) -> float:
    """Of 300 goals in all directions, after 60 000 interactions."""
    robot = Point(speed=4.0)
    task = GoToGoal(reward=Sparse(), episode_steps=60, goal_radius=0.2, bearing=math.pi)
    _, learner = collect(robot, agent, 60_000, task=task, keep=False, quiet=True)
    settings = EvaluationSettings(max_steps=60, goal_radius=0.2, num_envs=300, chunk=60)
    policy = agent.policy(robot, task, learner)
    return evaluate(robot, policy, scenarios(robot, 1, 300), settings, quiet=True).reached.mean()


GOALS: dict[str, Any] = dict(
    num_envs=16,
    unroll_length=8,
    grad_updates_per_step=16,
    batch_size=128,
    min_replay_size=1000,
    critic_hidden_layer_sizes=(64, 64),
    discounting=0.95,
)


def test_with_hindsight_sac_goes_where_it_never_was_rewarded_for_going() -> None:
    assert share_reached(SAC(**GOALS, her=HER())) > 0.95
    assert share_reached(SAC(**GOALS)) < 0.5


def test_with_hindsight_ddpg_goes_there_too() -> None:
    assert share_reached(DDPG(**GOALS, her=HER())) > 0.95


# ── the loop ────────────────────────────────────────────────────────────────────────────


@each
def test_recording_changes_no_parameter_by_a_bit(name: str, monkeypatch) -> None:
    agent, task = LEARNERS[name]
    recording = undisturbed(name)[1]
    monkeypatch.setattr(unroll, "record", lambda step, intended: None)
    blind = agent.learning(ROBOT, task, devices.mesh())
    learner = blind.place(jax.jit(blind.start)(jax.random.key(0)))
    iterate = blind.prepare(learner)
    for _ in range(ITERATIONS):
        learner, nothing, _ = iterate(learner)
    assert nothing is None
    same(learner, recording)


@each
def test_what_is_learned_does_not_depend_on_the_number_of_devices(name: str) -> None:
    record, learner = gather(name, mesh=devices.mesh(jax.devices()[:1]))
    close(record, undisturbed(name)[0], atol=1e-4)
    close(learner, undisturbed(name)[1], atol=1e-3)


@each
def test_seeds_matter_and_nothing_else_does(name: str) -> None:
    again, other = gather(name), gather(name, seed=1)
    same(again, undisturbed(name))
    assert not np.isin(other[0].o_next[..., 0], again[0].o_next[..., 0]).any()


@each
def test_learning_waits_until_it_is_warm_and_then_moves_everything(name: str) -> None:
    """200 steps are there after two iterations."""
    task = LEARNERS[name][1]
    learning = PREPARED[name].learning(ROBOT, task, devices.mesh())
    learner = learning.place(jax.jit(learning.start)(jax.random.key(0)))
    begun = jax.tree.map(jnp.copy, learner.training_state.networks)
    iterate = learning.prepare(learner)
    learner, _, info = iterate(learner)
    same(learner.training_state.networks, begun)
    assert info["critic_loss"] == info["policy_loss"] == 0
    learner, _, info = iterate(learner)
    moved = [
        abs(x - y).max()
        for x, y in zip(*map(leaves, (learner.training_state.networks, begun)), strict=True)
    ]
    assert min(moved) > 0 and info["critic_loss"] > 0
    assert (
        learner.training_state.statistics.count.lo
        == learner.training_state.buffer.written * 16
        == 2 * SIZE
    )


@each
def test_the_buffer_holds_what_was_recorded_and_nothing_that_diverged(name: str) -> None:
    record, learner = undisturbed(name)
    rows, newest = learner.training_state.buffer.rows, 3 * 8
    assert learner.training_state.buffer.written == 5 * 8 and rows.last.shape == (newest, 16)
    row = np.arange(5 * 8 - newest, 5 * 8) % newest
    for ours, theirs in ((rows.s, record.s), (rows.a, record.a), (rows.o_next, record.o_next)):
        np.testing.assert_array_equal(np.asarray(ours)[row], theirs[-newest:])
    assert all(np.isfinite(x).all() for x in leaves((rows, learner)))
    lost = ~record.valid[-newest:]
    assert lost.any() and np.asarray(rows.terminal)[row][lost].all()
    assert np.asarray(rows.fallen)[row][lost].all()


@each
def test_the_statistics_are_those_of_the_inputs(name: str) -> None:
    record, learner = undisturbed(name)
    size = record.s.shape[-1]
    seen = np.float64(record.s).reshape(-1, size)
    found = learner.training_state.statistics
    np.testing.assert_allclose(found.mean[:size], seen.mean(0), rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.std[:size], np.maximum(seen.std(0), 1e-6), rtol=0, atol=1e-3)


# ── stopping and going on ───────────────────────────────────────────────────────────────


@pytest.fixture
def killed(tmp_path: Path, monkeypatch) -> Callable[..., Stage]:
    """A collection with a checkpoint every 2 iterations, killed in a later one."""
    monkeypatch.setattr(collecting, "CHUNK", 2 * SIZE)

    def at(iteration: int, name: str, keep: bool) -> Stage:
        stage = Stage.open(tmp_path, "collect", {})
        with monkeypatch.context() as m:
            m.setattr(Progress, "advance", dies_at(iteration))
            with pytest.raises(Killed):
                gather(name, stage=stage, keep=keep)
        return stage

    return at


@each
@pytest.mark.parametrize(("iteration", "keep"), [(1, True), (3, True), (4, False), (5, False)])
def test_killed_it_goes_on_to_the_same_bits(killed, name: str, iteration: int, keep: bool) -> None:
    stage = killed(iteration, name, keep)
    record, learner = gather(name, stage=stage, keep=keep)
    same(learner, undisturbed(name)[1])
    if keep:
        same(record, undisturbed(name)[0])
        same(load_chunks(stage.path("experience"), ROBOT), record)
    else:
        assert record is None and not stage.path("experience").exists()
    lines = read_metrics(stage.path(METRICS))
    assert [line["step"] for line in lines] == [SIZE * (i + 1) for i in range(ITERATIONS)]
    assert {"critic_loss", "policy_loss", "reward", "speed", "falls", "diverged"} <= lines[0].keys()
    assert all(x is not None for line in lines for x in line.values())  # null is not finite
    assert lines[-1]["critic_loss"] > 0


def test_a_collection_that_is_done_is_not_made_again(killed, monkeypatch) -> None:
    stage = killed(2, "SAC", keep=False)
    gather("SAC", stage=stage, keep=False)
    monkeypatch.setattr(Progress, "advance", dies_at(1))
    same(gather("SAC", stage=stage, keep=False), (None, undisturbed("SAC")[1]))


@each
@pytest.mark.parametrize("harm", [flip, truncate, Path.unlink])
def test_with_a_corrupt_part_of_the_buffer_it_ends_in_the_same_bits(
    killed, name: str, harm
) -> None:
    """The newest part: the checkpoint before is gone on from. The oldest: all is done anew."""
    for which, goes_on_from in ((-1, 2), (0, None)):
        stage = killed(5, name, keep=True)
        parts = sorted(stage.path("checkpoints").glob("part_*"))
        assert stage.checkpoints().steps() == [2, 4] and len(parts) == 2
        harm(parts[which] / "s.npy")
        like = {"learner": undisturbed(name)[1], "chunks": 0}
        found = Remembering(stage.checkpoints()).latest(like)
        assert (found and found[0]) == goes_on_from
        same(gather(name, stage=stage), undisturbed(name))
        stage.clear_checkpoints()


@each
def test_a_checkpoint_writes_the_new_rows_alone(killed, name: str) -> None:
    stage = killed(5, name, keep=False)
    directory = stage.path("checkpoints")
    spans = sorted(part.name.split("_")[1:] for part in directory.glob("part_*"))
    assert [(int(first), int(end)) for first, end in spans] == [(0, 16), (16, 32)]
    rows = (
        sum(x.nbytes for x in jax.tree.leaves(undisturbed(name)[1].training_state.buffer.rows)) / 24
    )
    for part in directory.glob("part_*"):
        size = sum(np.load(file).nbytes for file in part.glob("*.npy"))
        assert size == 16 * rows
    kinds = load_json(directory / "step_000000004" / "leaves.json")["kinds"]
    rows = {kind for leaf, kind in kinds.items() if "/buffer/rows/" in leaf}
    assert rows and all("[0, 24, 16" in kind for kind in rows)


@each
def test_what_has_learned_nan_is_not_done(tmp_path: Path, name: str) -> None:
    agent, task = LEARNERS[name]
    agent = dataclasses.replace(agent, learning_rate=1e30)
    stage = Stage.open(tmp_path, "collect", {})

    def work() -> dict:
        collect(ROBOT, agent, ITERATIONS * SIZE, task=task, stage=stage, quiet=True)
        return {}

    with pytest.raises(
        BadInput, match=r"training_state/networks/\S+ holds NaN or infinity after 640 int"
    ):
        stage.run_once(work)
    assert not stage.done and not stage.checkpoints().steps()


# ── bad input ───────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("learner", [SAC, DDPG])
@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        *(
            ({name: 0}, "at least 1")
            for name in ("num_envs", "unroll_length", "grad_updates_per_step", "batch_size")
        ),
        *(({"discounting": x}, "discounting") for x in (0.0, 1.0, -1.0)),
    ],
)
def test_settings_that_cannot_be_are_refused(learner: type, wrong: dict, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        learner(**wrong)


def test_a_buffer_that_is_too_small_is_refused() -> None:
    with pytest.raises(BadInput, match="never holds min_replay_size = 200"):
        SAC(**SMALL | {"max_replay_size": 2 * SIZE - 1})
    agent = SAC(**SMALL | {"max_replay_size": 2 * SIZE - 1, "min_replay_size": 0})
    learning = agent.learning(ROBOT, WalkForward(), devices.mesh())
    with pytest.raises(BadInput, match="is less than two iterations"):
        jax.eval_shape(learning.start, jax.random.key(0))
