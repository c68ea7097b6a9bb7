"""Hindsight: which goals a step is given anew, and what it is then worth."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_step import advance, split
from point import Point, Straight

from genidm import devices
from genidm.agents.buffer import (
    Buffer,
    Index,
    add,
    empty,
    sample_index,
    steps_left,
    to_replay_transition,
)
from genidm.agents.ddpg import DDPG
from genidm.agents.her import HER, Strategy
from genidm.agents.sac import SAC
from genidm.errors import BadInput
from genidm.tasks import (
    Dense,
    EnvState,
    GoToGoal,
    ProgressReward,
    Sparse,
    Transition,
    WalkForward,
    bootstrapped_reward,
    inputs,
)

# It arrives, it falls, and it runs into the time limit.
ROBOT = Point(speed=4.0, falls_at=3.0)
TASK = GoToGoal(reward=Dense(), episode_steps=25, goal_radius=0.3)
LANES, UNROLL, ROWS, STEPS = 12, 10, 40, 110
DRAWN = 6000
AGENT = SAC(
    num_envs=LANES,
    unroll_length=UNROLL,
    batch_size=DRAWN,
    max_replay_size=ROWS * LANES,
    min_replay_size=0,
    her=HER("episode"),
)


@functools.cache
def walked() -> tuple[Transition, Buffer]:
    """Steps `[STEPS, LANES]`, in NumPy, and a buffer that remembers the newest ROWS of them."""

    def step(lanes: EnvState, _: None) -> tuple[EnvState, Transition]:
        lanes, keys = split(lanes)
        straight = Straight(jnp.float32(0.9), ROBOT)(lanes.robots.observation, lanes.relative_goal)
        anywhere = jax.vmap(lambda k: jax.random.uniform(k, (3,), minval=-1.0))(keys)
        to_goal = jnp.arange(LANES)[:, None] % 2 == 0
        return advance(TASK, ROBOT, lanes, jnp.where(to_goal, straight, anywhere))

    def walk(keys: jax.Array) -> tuple[Transition, Any]:
        _, steps = jax.lax.scan(step, TASK.start(ROBOT, keys), length=STEPS)
        return steps, jax.vmap(functools.partial(to_replay_transition, ROBOT))(steps)

    steps, memory = jax.jit(walk)(jax.random.split(jax.random.key(0), LANES))
    parts = [
        jax.tree.map(lambda x, n=n: x[n : n + UNROLL], memory) for n in range(0, STEPS, UNROLL)
    ]
    buffer, fill = empty(parts[0], AGENT.max_replay_size), jax.jit(add)
    for part in parts:
        buffer = fill(buffer, part)
    return jax.tree.map(np.asarray, steps), buffer


OLDEST = STEPS - ROWS


def number(row: int) -> int:
    """Which of all steps lies in a row of the ring."""
    return OLDEST + (row - OLDEST) % ROWS


def window(strategy: Strategy, n: int, lane: int) -> tuple[int, int]:
    """First and last step whose outcome may be the goal of step n."""
    steps, _ = walked()
    begun = end = n
    while steps.episode_step[begun, lane] > 0 and begun > OLDEST:
        begun -= 1
    while not steps.last[end, lane] and end < STEPS - 1:
        end += 1
    return {"future": (n, end), "final": (end, end), "episode": (begun, end)}[strategy]


@functools.cache
def goals(her: HER) -> tuple[Index, np.ndarray]:
    """Steps drawn from the buffer, and the goals `[DRAWN, 3]` that they are given."""
    _, buffer = walked()

    @jax.jit
    def given(buffer: Buffer, key: jax.Array) -> tuple[Index, jax.Array]:
        which, what = jax.random.split(key)
        at = sample_index(buffer, which, DRAWN)
        return at, her.goal(buffer, steps_left(buffer), at, what, ROBOT.standing_height)

    return jax.tree.map(np.asarray, given(buffer, jax.random.key(1)))


def relabelled(her: HER) -> tuple[list[tuple[int, int]], list[list[int]], int]:
    """Steps with a new goal, the steps of their lane that ended there, and how many kept theirs."""
    steps, _ = walked()
    at, goal = goals(her)
    drawn = [
        (number(row), lane) for row, lane in zip(at.row.tolist(), at.lane.tolist(), strict=True)
    ]
    moved = [(x, g) for x, g in zip(drawn, goal, strict=True) if (steps.goal[x] != g).any()]
    ended = [
        np.flatnonzero((steps.after.position[:, lane, :2] == g[:2]).all(-1)).tolist()
        for (_, lane), g in moved
    ]
    return [x for x, _ in moved], ended, len(drawn) - len(moved)


STRATEGIES = ("future", "final", "episode")


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_new_goals_are_where_the_same_episode_got_to(strategy: Strategy) -> None:
    steps, ended, _ = relabelled(HER(strategy))
    assert all(len(where) == 1 for where in ended) and len(steps) > DRAWN / 2
    windows = [window(strategy, *step) for step in steps]
    assert all(low <= n <= high for (n,), (low, high) in zip(ended, windows, strict=True))


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_moment_of_the_window_is_as_likely_as_any(strategy: Strategy) -> None:
    steps, ended, _ = relabelled(HER(strategy))
    low, high = np.array([window(strategy, *step) for step in steps]).T
    chance = 1 / (high - low + 1)
    for end in (low, high):
        hits = np.ravel(ended) == end
        assert abs(hits.sum() - chance.sum()) <= 4 * np.sqrt((chance * (1 - chance)).sum())


@pytest.mark.parametrize("her", [HER(), HER(n_sampled_goal=1)])
def test_of_so_many_goals_one_is_the_steps_own(her: HER) -> None:
    *_, own = relabelled(her)
    share = 1 / (her.n_sampled_goal + 1)
    assert abs(own - share * DRAWN) < 4 * np.sqrt(DRAWN * share * (1 - share))


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_new_goals_are_as_high_as_the_tasks(strategy: Strategy) -> None:
    _, goal = goals(HER(strategy))
    assert (goal[:, 2] == ROBOT.standing_height).all()


# ── what a step is worth for its new goal ───────────────────────────────────────────────


REWARDS = {"progress": ProgressReward(), "sparse": Sparse(), "dense": Dense()}


@functools.cache
def sampled(agent: SAC, task: GoToGoal) -> tuple[Any, Transition, Transition]:
    """A minibatch, the steps that it was made of, and the same steps made for its goals."""
    steps, buffer = walked()
    sample = jax.jit(functools.partial(agent.sample, ROBOT, task))
    batch = sample(buffer, jax.jit(steps_left)(buffer), jax.random.key(2))
    where = {
        a.tobytes(): at for at, a in zip(np.ndindex(STEPS, LANES), flat(steps.action), strict=True)
    }
    assert len(where) == STEPS * LANES  # no two actions are the same
    at = tuple(np.array([where[a.tobytes()] for a in np.asarray(batch.action)]).T)
    were = jax.tree.map(lambda x: jnp.asarray(x[at]), steps)
    goal = batch.observation[:, ROBOT.observation.size :] + were.before.position
    keys = jax.random.split(jax.random.key(3), agent.batch_size)
    lanes = EnvState(were.before, were.episode_step, keys, goal)
    _, anew = jax.jit(functools.partial(advance, task, ROBOT))(lanes, were.action)
    return jax.tree.map(np.asarray, (batch, were, anew))


def flat(x: np.ndarray) -> np.ndarray:
    return x.reshape(-1, x.shape[-1])


@pytest.mark.parametrize("name", REWARDS)
def test_a_relabelled_step_is_worth_what_it_would_have_been(name: str) -> None:
    task = dataclasses.replace(TASK, reward=REWARDS[name])
    batch, were, anew = sampled(AGENT, task)
    np.testing.assert_array_equal(batch.discount, 1.0 - anew.terminal)
    np.testing.assert_allclose(
        batch.reward, bootstrapped_reward(anew, AGENT.discounting), rtol=1e-5, atol=1e-4
    )
    before = inputs(were.before.observation, anew.goal - were.before.position)
    np.testing.assert_allclose(batch.observation, before, rtol=0, atol=1e-6)
    # Where the episode went on, what is bootstrapped from is what the step led to.
    after = inputs(anew.after.observation, anew.goal - anew.after.position)
    goes_on = ~were.last
    np.testing.assert_allclose(batch.next_observation[goes_on], after[goes_on], rtol=0, atol=1e-5)
    # Where it ended, the next row is another episode's: it is an end here too, or not learned from.
    truncation = batch.extras["state_extras"]["truncation"]
    np.testing.assert_array_equal(truncation, were.last & ~anew.terminal)


def test_the_minibatch_has_what_these_tests_need() -> None:
    _, were, anew = sampled(AGENT, TASK)
    moved = np.abs(anew.goal - were.goal).max(-1) > 1e-3
    reached = anew.terminal & ~anew.after.fallen
    assert (reached & moved & ~were.terminal).sum() > 100
    assert (were.terminal & ~anew.terminal & moved).sum() > 30
    assert (anew.after.fallen & moved).sum() > 30 and (were.last & ~were.terminal).sum() > 30


def test_without_hindsight_goals_and_rewards_are_the_tasks_own() -> None:
    batch, were, anew = sampled(dataclasses.replace(AGENT, her=None), TASK)
    np.testing.assert_allclose(anew.goal, were.goal, rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        batch.reward, bootstrapped_reward(were, AGENT.discounting), rtol=1e-6
    )
    np.testing.assert_array_equal(batch.discount, 1.0 - were.terminal)
    own = were.last & ~were.terminal
    np.testing.assert_array_equal(batch.extras["state_extras"]["truncation"], own)


def test_what_diverged_is_remembered_as_a_fall() -> None:
    steps, _ = walked()
    fell, lost = steps.after.fallen, np.arange(LANES) % 3 == np.arange(STEPS)[:, None] % 3
    after = dataclasses.replace(steps.after, diverged=lost)
    memory = to_replay_transition(ROBOT, dataclasses.replace(steps, after=after))
    np.testing.assert_array_equal(memory.fallen, fell | lost)
    assert (fell & ~lost).any() and (lost & ~fell).any()


# ── bad input ───────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("number", [0, -1])
def test_no_goals_are_refused(number: int) -> None:
    with pytest.raises(BadInput, match="n_sampled_goal must be at least 1"):
        HER(n_sampled_goal=number)


@pytest.mark.parametrize("learner", [SAC, DDPG])
def test_hindsight_without_goals_is_refused(learner: type) -> None:
    with pytest.raises(BadInput, match="this task has no goals"):
        learner(her=HER()).learning(ROBOT, WalkForward(), devices.mesh())
