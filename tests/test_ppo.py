"""Collecting: what PPO learns on a point, and what is kept of it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import close, leaves
from brax.training.acme import running_statistics
from brax.training.agents.ppo.losses import compute_ppo_loss
from brax.training.types import Transition as BraxTransition
from killing import Killed, dies_at
from point import Point
from prepared import Prepared

from genidm import devices
from genidm.agents import collect as collecting
from genidm.agents import ppo, unroll
from genidm.agents.collect import collect
from genidm.agents.policy import no_statistics
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.unroll import generate_unroll
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings, evaluate
from genidm.evaluation.scenarios import scenarios
from genidm.experience import Experience, load_chunks
from genidm.files import Corrupt
from genidm.progress import METRICS, Progress, read_metrics
from genidm.store import Stage
from genidm.tasks import GoToGoal, Transition, WalkForward

# It falls, and it runs into the time limit, so that episodes end in both ways.
ROBOT = Point(speed=2.0, falls_at=0.25)
TASK = WalkForward(episode_steps=9)
AGENT = PPO(
    num_envs=16,
    unroll_length=8,
    num_updates_per_batch=2,
    num_minibatches=4,
    policy_hidden_layer_sizes=(16,),
    value_hidden_layer_sizes=(16,),
)
NETWORKS = AGENT.networks(ROBOT, TASK)
SIZE = AGENT.num_envs * AGENT.unroll_length
ITERATIONS = 5
PREPARED = Prepared(AGENT)
MIRRORED = Prepared(dataclasses.replace(AGENT, mirror=True))


def gather(agent=PREPARED, iterations: int = ITERATIONS, **options) -> tuple[Experience, Any]:
    options = dict(task=TASK, quiet=True) | options
    size = agent.num_envs * agent.unroll_length
    return collect(options.pop("robot", ROBOT), agent, iterations * size, **options)


@functools.cache
def undisturbed() -> tuple[Experience, Any]:
    return gather()


def same(a: Any, b: Any) -> bool:
    pairs = zip(leaves(a), leaves(b), strict=True)
    return all(x.dtype == y.dtype and x.tobytes() == y.tobytes() for x, y in pairs)


# ── learning ────────────────────────────────────────────────────────────────────────────


def test_ppo_learns_the_way_that_is_rewarded() -> None:
    """Forward is +x, and a point at full speed makes 1 m/s."""
    passes = dict(num_updates_per_batch=7, num_minibatches=8, learning_rate=3e-3)
    agent = PPO(
        num_envs=64,
        unroll_length=16,
        policy_hidden_layer_sizes=(32,),
        value_hidden_layer_sizes=(32,),
        **passes,
    )
    record, _ = gather(agent, 30, robot=Point(), task=WalkForward(64))
    speed = (record.o_next - record.o)[..., 0] / Point.dt
    assert speed[:16].mean() < 0.4 and 0.9 < speed[-80:].mean() <= speed.max() < 1.0001


def test_ppo_learns_the_way_to_goals() -> None:
    agent = PPO(
        num_envs=64,
        unroll_length=16,
        num_updates_per_batch=7,
        num_minibatches=8,
        learning_rate=3e-3,
        discounting=0.95,
        policy_hidden_layer_sizes=(32,),
        value_hidden_layer_sizes=(32,),
    )
    robot, task = Point(speed=4.0), GoToGoal(episode_steps=60, goal_radius=0.2)
    _, learner = gather(agent, 130, robot=robot, task=task, keep=False)
    test, policy = (
        EvaluationSettings(max_steps=60, goal_radius=0.2, num_envs=300, chunk=60),
        agent.policy(robot, task, learner),
    )
    assert evaluate(robot, policy, scenarios(robot, 1, 300), test, quiet=True).reached.mean() > 0.9


def test_recording_changes_no_parameter_by_a_bit(monkeypatch) -> None:
    recording = undisturbed()[1]
    of_step = unroll.record  # PPO learns from the states and actions of its own record

    def least(step: Transition, intended: Any) -> Any:
        return of_step(step, intended).replace(
            o_next=None, first=None, last=None, valid=None, physics=None
        )

    monkeypatch.setattr(unroll, "record", least)
    blind = AGENT.learning(ROBOT, TASK, devices.mesh())
    learner = blind.place(jax.jit(blind.start)(jax.random.key(0)))
    iterate = blind.prepare(learner)
    for _ in range(ITERATIONS):
        learner, part, _ = iterate(learner)
    assert part.physics is None and same(learner, recording)


def test_what_is_learned_does_not_depend_on_the_number_of_devices() -> None:
    record, learner = gather(mesh=devices.mesh(jax.devices()[:1]))
    close(record, undisturbed()[0], atol=1e-4)
    close(learner, undisturbed()[1], atol=1e-3)


def test_seeds_matter_and_nothing_else_does() -> None:
    again, other = gather(seed=0), gather(seed=1)
    assert same(again, undisturbed())
    assert not np.isin(other[0].a, again[0].a).any()


def test_what_learns_is_moved_by_every_iteration() -> None:
    learning = PREPARED.learning(ROBOT, TASK, devices.mesh())
    begun = jax.jit(learning.start)(jax.random.key(0)).training_state.params
    ended = undisturbed()[1].training_state
    moved = [np.abs(x - y).max() for x, y in zip(leaves(begun), leaves(ended.params), strict=True)]
    assert min(moved) > 1e-4 and ended.statistics.count.lo == ITERATIONS * SIZE


# ── the loss ────────────────────────────────────────────────────────────────────────────


@functools.cache
def walked() -> tuple[Any, BraxTransition, Transition, Any]:
    """8 steps of 16 lanes: what PPO packs of them, and the steps themselves, one by one."""
    distribution = NETWORKS.parametric_action_distribution
    policy = jax.jit(NETWORKS.policy_network.init)(jax.random.key(0))
    statistics = running_statistics.init_state(jnp.zeros(ROBOT.observation.size))
    task = WalkForward(episode_steps=5)
    lanes = jax.jit(functools.partial(task.start, ROBOT))(jax.random.split(jax.random.key(1), 16))
    packed = functools.partial(
        ppo._rollout, ROBOT, task, NETWORKS, AGENT.unroll_length, AGENT.discounting
    )
    _, _, batch, _ = jax.jit(packed)(statistics, policy, lanes)

    def draw(key: jax.Array) -> jax.Array:
        return jax.random.normal(key, (ROBOT.action.size,))

    def choose(x: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        logits = NETWORKS.policy_network.apply(statistics, policy, x)
        mean, scale = jnp.split(logits, 2, axis=-1)
        raw = mean + (jax.nn.softplus(scale) + 0.001) * noise  # as Brax's distribution has it
        return distribution.postprocess(raw), jnp.tanh(mean), (logits, raw)

    whole = functools.partial(
        generate_unroll,
        ROBOT,
        task,
        AGENT.unroll_length,
        draw,
        choose,
        lambda step, notes: (step, notes),
    )
    steps, choices = jax.tree.map(np.asarray, jax.jit(whole)(lanes)[2])
    return policy, batch, steps, choices


def loss_of(batch: BraxTransition) -> tuple[Any, dict[str, Any]]:
    """Brax's loss `[B, T, ...]` of a policy a little off the one that walked."""
    params = target_params()
    statistics = running_statistics.init_state(jnp.zeros(ROBOT.observation.size))
    return jax.jit(functools.partial(compute_ppo_loss, ppo_network=NETWORKS, **LOSS))(
        params, statistics, batch, jax.random.key(2)
    )


LOSS = dict(discounting=0.9, gae_lambda=0.8, reward_scaling=0.5, clipping_epsilon=0.05)


def target_params() -> Any:
    value = jax.jit(NETWORKS.value_network.init)(jax.random.key(3))
    return ppo.PPONetworkParams(jax.tree.map(lambda x: 1.3 * x, walked()[0]), value)


def by_lane(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), tree)


def test_our_transitions_give_the_loss_of_braxs_own_layout() -> None:
    """Brax's has the next state of every step, and log π from the very arrays."""
    _, batch, steps, (logits, raw) = walked()
    log_prob = jax.jit(NETWORKS.parametric_action_distribution.log_prob)(logits, raw)
    policy_extras = {"log_prob": log_prob, "raw_action": raw, "distribution_params": logits}
    truncated = np.float32(steps.last & ~steps.terminal)
    whole = BraxTransition(
        observation=steps.before.observation,
        action=steps.action,
        reward=steps.reward,
        discount=1 - np.float32(steps.terminal),
        next_observation=steps.after.observation,
        extras={"policy_extras": policy_extras, "state_extras": {"truncation": truncated}},
    )
    ours, braxs = loss_of(by_lane(batch)), loss_of(by_lane(whole))
    assert batch.next_observation.shape[0] == 1
    close(ours, braxs, atol=1e-5)
    assert abs(ours[0]) > 1e-2


@pytest.mark.parametrize("mirror", [False, True])
def test_the_record_holds_the_action_before_exploration(mirror: bool) -> None:
    """It is the policy's answer, also of a policy that is its own mirror image."""
    agent = dataclasses.replace(AGENT, mirror=mirror)
    prepared = MIRRORED if mirror else PREPARED
    record, _ = gather(prepared, iterations=1)
    begun = jax.jit(prepared.learning(ROBOT, TASK, devices.mesh()).start)(jax.random.key(0))
    policy = agent.policy(ROBOT, TASK, begun)
    close(record.intended, policy(record.s, np.zeros_like(record.o)), atol=1e-5)
    assert np.abs(record.a - record.intended).mean() > 0.1


def test_a_mirrored_policy_is_its_own_mirror_image_whatever_it_has_learned() -> None:
    def asymmetry(agent: PPO, prepared: Prepared) -> float:
        record, learner = gather(prepared)
        policy = agent.policy(ROBOT, TASK, learner)
        s, nowhere = jnp.asarray(record.s), jnp.zeros_like(record.o)
        reflected = policy(ROBOT.observation.mirror(s), nowhere)
        return float(jnp.abs(reflected - ROBOT.action.mirror(policy(s, nowhere))).max())

    assert asymmetry(dataclasses.replace(AGENT, mirror=True), MIRRORED) < 1e-5
    assert asymmetry(AGENT, PREPARED) > 0.1


def test_mirrored_networks_mirror_means_and_keep_deviations_and_values() -> None:
    networks = dataclasses.replace(AGENT, mirror=True).networks(ROBOT, TASK)
    statistics = no_statistics(ROBOT.observation.size)
    x = ROBOT.reset(jax.random.split(jax.random.key(5), 9), jnp.linspace(-3, 3, 9)).observation
    image = ROBOT.observation.mirror(x)
    value, policy = (
        jax.jit(n.init)(jax.random.key(1))
        for n in (networks.value_network, networks.policy_network)
    )
    values = [networks.value_network.apply(statistics, value, y) for y in (x, image)]
    close(values[0], values[1], atol=1e-5)
    assert np.ptp(values[0]) > 1e-3
    (mean, scale), (mean_image, scale_image) = (
        np.split(networks.policy_network.apply(statistics, policy, y), 2, axis=-1)
        for y in (x, image)
    )
    close(mean_image, mean * np.array([1, -1, -1]), atol=1e-5)
    close(scale_image, scale, atol=1e-5)  # no joint of a point moves to another
    assert np.abs(mean).min() > 1e-4


def test_truncation_and_termination_count_as_in_a_slow_gae() -> None:
    _, batch, steps, _ = walked()
    truncated = steps.last & ~steps.terminal
    assert truncated[:-1].any() and steps.terminal[:-1].any()
    params = target_params()
    statistics = running_statistics.init_state(jnp.zeros(ROBOT.observation.size))
    value = jax.jit(functools.partial(NETWORKS.value_network.apply, statistics, params.value))
    values = np.float64(value(jnp.asarray(steps.before.observation)))
    final = np.float64(value(jnp.asarray(steps.after.observation[-1])))
    error, advantage = slow_gae(steps, truncated, values, final)
    _, info = loss_of(by_lane(batch))
    assert info["v_loss"] == pytest.approx(np.mean(error**2) / 4, abs=1e-5)
    ratio = np.exp(new_log_prob(params) - np.float64(batch.extras["policy_extras"]["log_prob"]))
    advantage = (advantage - advantage.mean()) / advantage.std()
    clipped = np.minimum(ratio * advantage, np.clip(ratio, 0.95, 1.05) * advantage)
    assert info["policy_loss"] == pytest.approx(-clipped.mean(), abs=1e-5)
    assert (np.abs(ratio - 1) > 0.05).any() and abs(clipped.mean()) > 1e-3


def slow_gae(steps: Transition, truncated, values, final) -> tuple[np.ndarray, np.ndarray]:
    """λ-returns less values, and one-step advantages towards them, lane by lane.

    A fall ends the return. At the time limit nobody knows what would have come, so that
    step teaches nothing, and the return starts anew before it.
    """
    error, advantage = np.zeros(values.shape), np.zeros(values.shape)
    for lane in range(values.shape[1]):
        v_next, return_next, error_next = final[lane], final[lane], 0.0
        for t in reversed(range(values.shape[0])):
            v, r = values[t, lane], 0.5 * steps.reward[t, lane]
            if truncated[t, lane]:
                error[t, lane] = advantage[t, lane] = 0.0
            elif steps.terminal[t, lane]:
                error[t, lane] = advantage[t, lane] = r - v
            else:
                error[t, lane] = r + 0.9 * v_next - v + 0.9 * 0.8 * error_next
                advantage[t, lane] = r + 0.9 * return_next - v
            v_next, error_next = v, error[t, lane]
            return_next = v + error_next
    return error, advantage


def new_log_prob(params: Any) -> np.ndarray:
    _, _, steps, (_, raw) = walked()
    statistics = running_statistics.init_state(jnp.zeros(ROBOT.observation.size))
    observation = jnp.asarray(steps.before.observation)
    logits = NETWORKS.policy_network.apply(statistics, params.policy, observation)
    log_prob = jax.jit(NETWORKS.parametric_action_distribution.log_prob)(logits, raw)
    return np.float64(log_prob)


# ── the record ──────────────────────────────────────────────────────────────────────────


def test_the_record_is_continuous_but_for_fresh_starts() -> None:
    r, _ = undisturbed()
    assert r.first.shape == (ITERATIONS * AGENT.unroll_length, AGENT.num_envs)
    goes_on = ~r.last[:-1]
    np.testing.assert_array_equal(r.o_next[:-1][goes_on], r.o[1:][goes_on])
    np.testing.assert_array_equal(r.first[1:], r.last[:-1])
    assert r.first[0].all() and (r.o_next[:-1] != r.o[1:]).any(axis=-1)[r.last[:-1]].all()
    starts = r.o[r.first]
    assert np.abs(starts[:, :2]).max() < 0.1 and len(np.unique(starts, axis=0)) == len(starts)


def test_episodes_end_by_a_fall_or_at_the_time_limit() -> None:
    r, _ = undisturbed()
    age = np.zeros(r.first.shape, int)
    for t, lane in np.ndindex(age.shape):
        age[t, lane] = 1 if r.first[t, lane] else age[t - 1, lane] + 1
    fell = np.hypot(r.o_next[..., 0], r.o_next[..., 1]) > ROBOT.falls_at
    np.testing.assert_array_equal(r.last, fell | (age == TASK.episode_steps))
    assert fell.any() and (r.last & ~fell).any()


def test_the_recorded_action_leads_from_the_recorded_physics_to_the_next() -> None:
    r, _ = undisturbed()
    flat = jax.tree.map(lambda x: jnp.asarray(x).reshape(-1, *x.shape[2:]), r)
    placed = jax.jit(ROBOT.set_state)(flat.physics, jnp.zeros(r.interactions))
    after = jax.jit(ROBOT.step)(placed, flat.a)
    np.testing.assert_allclose(after.position, flat.o_next, rtol=0, atol=1e-5)
    onward = np.flatnonzero(~r.last[:-1].ravel())
    s_next = np.asarray(r.s[1:]).reshape(-1, r.s.shape[-1])
    np.testing.assert_allclose(after.observation[onward], s_next[onward], rtol=0, atol=1e-5)


def test_diverged_physics_never_reaches_the_record(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "collect", {})
    robot = Point(speed=2.0, diverges_at=0.3)
    r, learner = gather(RandomActions(num_envs=16, unroll_length=8), robot=robot, stage=stage)
    assert all(np.isfinite(x).all() for x in leaves((r, learner)))
    assert (~r.valid).any() and r.last[~r.valid].all()
    counted = [line["diverged"] for line in read_metrics(stage.path(METRICS))]
    assert sum(counted) * SIZE == pytest.approx((~r.valid).sum())


def test_random_actions_cover_what_there_is() -> None:
    r, _ = gather(RandomActions(num_envs=16, unroll_length=8))
    assert -1 <= r.a.min() < -0.99 and 0.99 < r.a.max() <= 1
    assert abs(r.a.mean()) < 0.05 and r.a.std() == pytest.approx(3**-0.5, abs=0.02)
    other, _ = gather(RandomActions(num_envs=16, unroll_length=8), seed=1)
    both = np.concatenate([r.a, other.a]).reshape(-1, ROBOT.action.size)
    assert len(np.unique(both, axis=0)) == len(both)  # no action twice, nor with another seed


# ── stopping and going on ───────────────────────────────────────────────────────────────


@pytest.fixture
def killed(tmp_path: Path, monkeypatch) -> Callable[[int], Stage]:
    """A collection with a checkpoint every 2 iterations, killed in a later one."""
    monkeypatch.setattr(collecting, "CHUNK", 2 * SIZE)

    def at(iteration: int) -> Stage:
        stage = Stage.open(tmp_path, "collect", {})
        with monkeypatch.context() as m:
            m.setattr(Progress, "advance", dies_at(iteration))
            with pytest.raises(Killed):
                gather(stage=stage)
        return stage

    return at


def tear(stage: Stage) -> None:
    newest = stage.checkpoints().steps()[-1]
    (stage.path("checkpoints") / f"step_{newest:09d}" / "leaves.json").write_text("{")


@pytest.mark.parametrize(("iteration", "corrupt"), [(1, False), (3, False), (5, True)])
def test_a_killed_collection_goes_on_to_the_same_bits(
    killed, iteration: int, corrupt: bool
) -> None:
    stage = killed(iteration)
    assert stage.checkpoints().steps() == [s for s in (2, 4) if s < iteration]
    if corrupt:
        tear(stage)
    record, learner = gather(stage=stage)
    assert same((record, learner), undisturbed())
    assert same(load_chunks(stage.path("experience"), ROBOT), undisturbed()[0])
    lines = read_metrics(stage.path(METRICS))
    assert [line["step"] for line in lines] == [SIZE * (i + 1) for i in range(ITERATIONS)]


def test_a_collection_that_is_done_is_read_and_not_made_again(killed, monkeypatch) -> None:
    stage = killed(2)
    gather(stage=stage)
    monkeypatch.setattr(Progress, "advance", dies_at(1))
    assert same(gather(stage=stage), undisturbed())


def test_a_collection_goes_on_with_another_number_of_devices(killed) -> None:
    record, learner = gather(stage=killed(3), mesh=devices.mesh(jax.devices()[:1]))
    close(record, undisturbed()[0], atol=1e-4)
    close(learner, undisturbed()[1], atol=1e-3)


def test_a_corrupt_record_is_not_gone_on_from(killed) -> None:
    stage = killed(3)
    file = stage.path("experience") / "chunk_00000" / "a.npy"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(Corrupt, match="cut short"):
        gather(stage=stage)


# ── what is not finite ──────────────────────────────────────────────────────────────────


def test_a_learner_of_nan_is_refused_and_nothing_is_marked_done(tmp_path: Path) -> None:
    agent = Prepared(dataclasses.replace(AGENT, learning_rate=1e30))
    stage = Stage.open(tmp_path, "collect", {})

    def work() -> dict:
        gather(agent, iterations=3, stage=stage)
        return {}

    for _ in range(2):  # the same command again says the same
        with pytest.raises(
            BadInput, match=r"training_state/params/\S+ holds NaN or infinity after 384 "
        ):
            stage.run_once(work)
        assert not stage.done and not stage.checkpoints().steps()
        assert not stage.path("experience").exists()
    with pytest.raises(BadInput, match="smaller learning rate"):
        gather(agent, iterations=3)  # in memory alone, too


class Breaking:
    """An agent that works as another does, and whose state breaks in its nth iteration."""

    def __init__(self, agent: Any, at: int, broken: Callable[[Any], Any]):
        self.agent, self.num_envs, self.unroll_length = agent, agent.num_envs, agent.unroll_length
        self.at, self.broken = at, broken

    def learning(self, *args) -> Any:
        learning, calls = self.agent.learning(*args), iter(range(1, 100))

        def prepare(learner: Any) -> Any:
            iterate = learning.prepare(learner)

            def breaking(learner: Any) -> Any:
                learner, *rest = iterate(learner)
                return (self.broken(learner) if next(calls) == self.at else learner, *rest)

            return breaking

        return learning._replace(prepare=prepare)


def with_infinity(learner: Any) -> Any:
    mean = learner.training_state.statistics.mean.at[2].set(jnp.inf)
    statistics = learner.training_state.statistics.replace(mean=mean)
    return learner.replace(training_state=learner.training_state.replace(statistics=statistics))


def test_what_was_whole_before_is_kept_and_gone_on_from(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(collecting, "CHUNK", 2 * SIZE)
    stage = Stage.open(tmp_path, "collect", {})
    with pytest.raises(
        BadInput, match=r"training_state/statistics/mean holds NaN or inf\w+ after 512"
    ):
        gather(Breaking(PREPARED, 4, with_infinity), stage=stage)
    assert stage.checkpoints().steps() == [2]
    assert same(gather(stage=stage), undisturbed())


def test_interactions_are_counted_once_and_rounded_up(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "collect", {})
    agent = RandomActions(num_envs=16, unroll_length=8)
    record, _ = collect(ROBOT, agent, 3 * SIZE + 1, task=TASK, stage=stage, quiet=True)
    assert record.interactions == record.s.shape[0] * record.s.shape[1] == 4 * SIZE
    assert read_metrics(stage.path(METRICS))[-1]["step"] == 4 * SIZE
    assert record.first_half().interactions == 2 * SIZE


# ── bad input ───────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "agent", [PPO(num_envs=9, num_minibatches=3, unroll_length=4), RandomActions(num_envs=9)]
)
def test_as_many_devices_share_the_lanes_as_can(agent) -> None:
    one = devices.mesh(jax.devices()[:1])
    assert same(collect(ROBOT, agent, 36)[0], collect(ROBOT, agent, 36, mesh=one)[0])
    with pytest.raises(BadInput, match="9 lanes cannot be shared among 2 devices"):
        collect(ROBOT, agent, 36, mesh=devices.mesh())  # unless the user says so


@pytest.mark.parametrize(("lanes", "count"), [(128, 2), (9, 1), (1, 1)])
def test_devices_that_divide_the_lanes(lanes: int, count: int) -> None:
    assert devices.dividing(devices.mesh(), lanes).size == count


def test_no_interactions_are_refused() -> None:
    with pytest.raises(BadInput, match="at least 1"):
        collect(ROBOT, AGENT, 0)


@pytest.mark.parametrize(
    "wrong",
    [{"num_envs": 10, "num_minibatches": 4}, {"num_updates_per_batch": 0}, {"unroll_length": 0}],
)
def test_settings_that_make_no_ppo_are_refused(wrong: dict) -> None:
    with pytest.raises(BadInput, match=r"minibatches|at least 1"):
        PPO(**wrong)


def test_settings_that_make_no_sampling_are_refused() -> None:
    with pytest.raises(BadInput, match="at least 1"):
        RandomActions(num_envs=0)
