"""Going to a goal: where episodes begin and end, and what every step of them is worth."""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_step import advance, split
from point import Point, Straight

from genidm.errors import BadInput
from genidm.symmetry import wrap
from genidm.tasks import (
    Dense,
    GoToGoal,
    ProgressReward,
    Sparse,
    Transition,
    WalkForward,
    ahead,
    bootstrapped_reward,
    input_size,
    inputs,
)

# It arrives, it falls, it diverges beyond that, and it runs into the time limit.
ROBOT = Point(speed=4.0, falls_at=6.0, diverges_at=6.1)
REWARDS = {"progress": ProgressReward(), "sparse": Sparse(), "dense": Dense(distance=0.7, cost=0.3)}
TASK = GoToGoal(episode_steps=35, goal_radius=0.15)
LANES, STEPS = 48, 300


def steered(lanes, key: jax.Array) -> jax.Array:
    """A third of the lanes go to the goal, a third away from it, a third anywhere."""
    s, way = lanes.robots.observation, lanes.relative_goal
    straight, away = (Straight(jnp.float32(pace), ROBOT)(s, way) for pace in (1.0, -1.0))
    anywhere = jax.vmap(lambda k: jax.random.uniform(k, (3,), minval=-1.0))(key)
    kind = jnp.arange(LANES)[:, None] % 3
    return jnp.where(kind == 0, straight, jnp.where(kind == 1, away, anywhere))


@functools.cache
def walked() -> dict[str, Transition]:
    """The same steps `[STEPS, LANES]` under each reward, in NumPy."""
    tasks = {name: dataclasses.replace(TASK, reward=r) for name, r in REWARDS.items()}

    def step(lanes, _):
        lanes, keys = split(lanes)
        made = {name: advance(t, ROBOT, lanes, steered(lanes, keys)) for name, t in tasks.items()}
        return made["progress"][0], {name: step for name, (_, step) in made.items()}

    def walk(keys: jax.Array) -> dict[str, Transition]:
        return jax.lax.scan(step, TASK.start(ROBOT, keys), length=STEPS)[1]

    return jax.tree.map(np.asarray, jax.jit(walk)(jax.random.split(jax.random.key(0), LANES)))


def distances(step: Transition) -> tuple[np.ndarray, np.ndarray]:
    """Metres to the goal before and after each step, horizontally."""
    ways = (np.float64(step.goal) - x.position for x in (step.before, step.after))
    before, after = (np.hypot(way[..., 0], way[..., 1]) for way in ways)
    return before, after


# ── where episodes begin ────────────────────────────────────────────────────────────────


def test_every_episode_has_a_start_a_heading_and_a_goal_of_its_own() -> None:
    step = walked()["progress"]
    first = step.episode_step == 0
    episodes = first.sum()
    assert episodes > 500 and first[0].all()
    np.testing.assert_array_equal(first[1:], step.last[:-1])
    for x in (step.goal, step.before.position, step.before.heading[..., None]):
        assert len(np.unique(x[first], axis=0)) == episodes
    goes_on = ~first[1:]
    np.testing.assert_array_equal(step.goal[1:][goes_on], step.goal[:-1][goes_on])
    np.testing.assert_array_equal(
        step.episode_step[1:][goes_on], step.episode_step[:-1][goes_on] + 1
    )


def goals(step: Transition) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heading, distance and bearing of the goal at the start of every episode."""
    first = step.episode_step == 0
    way = (step.goal - step.before.position)[first]
    heading = step.before.heading[first]
    bearing = wrap(jnp.asarray(np.arctan2(way[:, 1], way[:, 0]) - heading))
    return heading, np.hypot(way[:, 0], way[:, 1]), np.asarray(bearing)


def test_goals_lie_where_the_test_has_them() -> None:
    step = walked()["progress"]
    heading, distance, bearing = goals(step)
    spans = (heading, -math.pi, math.pi), (distance, 2, 5), (bearing, -math.pi / 4, math.pi / 4)
    for x, low, high in spans:
        assert low - 1e-5 < x.min() and x.max() < high + 1e-5
        counts = np.histogram(x, 8, (low, high))[0]
        assert abs(counts - len(x) / 8).max() < 4 * np.sqrt(len(x) / 8)
    start = step.before.position[step.episode_step == 0]
    drawn = np.corrcoef([heading, distance, bearing, start[:, 0], start[:, 1]])
    assert abs(drawn - np.eye(5)).max() < 4 / np.sqrt(len(heading))
    assert (step.goal[..., 2] == ROBOT.standing_height).all()


def test_what_is_done_has_nothing_to_do_with_what_was_drawn() -> None:
    """No key is used for both: a lane that goes anywhere goes there whatever its start."""
    step = walked()["progress"]
    anywhere = (step.episode_step == 0) & (np.arange(LANES) % 3 == 2)
    start, a = step.before.position[anywhere], step.action[anywhere]
    drawn = np.corrcoef(np.concatenate([start - step.goal[anywhere], start, a], axis=-1).T)
    assert abs(drawn[-3:, :-3]).max() < 4 / np.sqrt(len(start))


@pytest.mark.parametrize(("yaw", "bearing"), [(0.0, math.pi), (1.0, 0.0)])
def test_headings_and_bearings_can_be_set(yaw: float, bearing: float) -> None:
    start = functools.partial(GoToGoal(start_yaw=yaw, bearing=bearing).start, ROBOT)
    lanes = jax.jit(start)(jax.random.split(jax.random.key(1), 500))
    heading = np.asarray(lanes.robots.heading)
    angle = jnp.arctan2(lanes.relative_goal[:, 1], lanes.relative_goal[:, 0])
    seen = np.asarray(wrap(angle - lanes.robots.heading))
    assert yaw + 0.3 < abs(heading).max() < yaw + 0.5 + 1e-5  # half a radian is the point's own
    assert 0.95 * bearing <= abs(seen).max() < bearing + 1e-5


def test_a_bearing_is_to_the_left_of_the_heading() -> None:
    """In complex numbers: o + distance · e^(i (heading + bearing)), at standing height."""
    rng = np.random.default_rng(0)
    yaw, bearing = rng.uniform(-3, 3, (2, 20))
    distance = rng.uniform(1, 5, 20)
    state = jax.jit(ROBOT.reset)(jax.random.split(jax.random.key(0), 20), jnp.asarray(yaw))
    goal = ahead(ROBOT, state, jnp.asarray(distance), jnp.asarray(bearing))
    x, y = state.position[:, 0], state.position[:, 1]
    expected = x + 1j * y + distance * np.exp(1j * (np.float64(state.heading) + bearing))
    np.testing.assert_allclose(goal[:, 0] + 1j * goal[:, 1], expected, atol=1e-5)
    assert (goal[:, 2] == ROBOT.standing_height).all()


# ── walking forward ─────────────────────────────────────────────────────────────────────


def test_walking_forward_is_worth_what_the_paper_says() -> None:
    """Metres a second along x, 1 for a step without a fall, less the costs (A.1.1)."""
    robot, task = Point(speed=4.0, falls_at=0.4, diverges_at=0.5), WalkForward(episode_steps=30)
    lanes = task.start(robot, jax.random.split(jax.random.key(2), 400))
    a = jax.random.uniform(jax.random.key(3), (400, 3), minval=-1.0)
    step_all = jax.jit(robot.step)
    for _ in range(2):
        after = step_all(lanes.robots, a)
        step = task.transition(robot, lanes, a, after)
        before, lanes = lanes.robots, lanes.replace(robots=after)
    ahead = (after.position[:, 0] - before.position[:, 0]) / robot.dt
    down = np.asarray(after.fallen | after.diverged)
    assert 20 < down.sum() < 380 and np.asarray(after.diverged).any()
    np.testing.assert_array_equal(step.terminal, down)
    expected = ahead + ~down - 0.05 * (np.asarray(a) ** 2).sum(-1)
    np.testing.assert_allclose(step.reward, expected, rtol=0, atol=1e-4)
    np.testing.assert_allclose(task.metrics(robot, step)["speed"], ahead, rtol=0, atol=1e-5)


# ── where they end ──────────────────────────────────────────────────────────────────────


def endings(step: Transition) -> tuple[np.ndarray, np.ndarray]:
    """Where the robot arrived, and where it fell or its physics diverged."""
    return distances(step)[1] <= TASK.goal_radius, step.after.fallen | step.after.diverged


def test_arriving_and_falling_are_ends_and_the_time_limit_is_none() -> None:
    step = walked()["progress"]
    reached, down = endings(step)
    late = step.episode_step + 1 == TASK.episode_steps
    np.testing.assert_array_equal(step.terminal, reached | down)
    np.testing.assert_array_equal(step.last, reached | down | late)
    ended = [x.sum() for x in (reached, step.after.fallen, step.after.diverged, step.last)]
    assert min(ended) > 30 and (late & ~step.terminal).sum() > 30


def test_what_is_counted_is_what_happened() -> None:
    step = walked()["dense"]
    metrics = jax.tree.map(np.asarray, TASK.metrics(ROBOT, step))
    reached, _ = endings(step)
    before, after = distances(step)
    np.testing.assert_array_equal(metrics["reached"], reached)
    np.testing.assert_array_equal(metrics["falls"], step.after.fallen)
    np.testing.assert_array_equal(metrics["diverged"], step.after.diverged)
    np.testing.assert_array_equal(metrics["reward"], step.reward)
    np.testing.assert_allclose(metrics["speed"], (before - after) / 0.05, rtol=0, atol=1e-4)
    straight = np.arange(LANES) % 3 == 0
    assert metrics["speed"][:, straight].mean() == pytest.approx(4.0, abs=0.2)


# ── what a step is worth, in the words of A.1.1 ─────────────────────────────────────────


def progress(before, after, cost, down, reached) -> tuple[float, float]:
    """The walking reward, "encouraged to move in the direction of the goal"."""
    alive = 0.0 if down else 1.0
    return (before - after) / 0.05 + alive - cost, alive


def sparse(before, after, cost, down, reached) -> tuple[float, float]:
    """ "0 if it reaches the goal, and −1 otherwise"."""
    return (0.0, 0.0) if reached else (-1.0, -1.0)


def dense(before, after, cost, down, reached) -> tuple[float, float]:
    """ "A weighted sum of distance to the goal and contact and control costs"."""
    far = 0.0 if reached else 0.7 * after
    return -far - 0.3 * cost, -far


ORACLES = {"progress": progress, "sparse": sparse, "dense": dense}


@pytest.mark.parametrize("name", REWARDS)
def test_a_step_is_worth_what_the_paper_says(name: str) -> None:
    step = walked()[name]
    before, after = distances(step)
    reached, down = endings(step)
    cost = 0.05 * (np.float64(step.action) ** 2).sum(-1)
    expected = np.zeros((2, STEPS, LANES))
    for at in np.ndindex(STEPS, LANES):
        expected[:, *at] = ORACLES[name](*(x[at] for x in (before, after, cost, down, reached)))
    np.testing.assert_allclose(step.reward, expected[0], rtol=0, atol=1e-4)
    np.testing.assert_allclose(step.absorbing_reward, expected[1], rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", REWARDS)
def test_the_outlook_of_an_end_is_the_sum_of_what_would_follow(name: str) -> None:
    step, discounting = walked()[name], 0.97
    series = np.zeros(step.reward.shape)
    for k in range(1, 1500):
        series += discounting**k * np.float64(step.absorbing_reward)
    expected = step.reward + np.where(step.terminal, series, 0.0)
    found = np.asarray(bootstrapped_reward(step, discounting))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(found[~step.terminal], step.reward[~step.terminal])


def test_no_fall_is_a_way_out() -> None:
    """Who falls is charged as if it never arrived; who arrives has the best there is."""
    reached, down = endings(walked()["sparse"])
    reached, down = reached & ~down, down & ~reached
    ends = {name: np.asarray(bootstrapped_reward(step, 0.97)) for name, step in walked().items()}
    np.testing.assert_allclose(ends["sparse"][down], -1 / 0.03, rtol=1e-5)
    assert (ends["sparse"][reached] == 0).all()
    assert ends["dense"][down].max() < -50 < -1 < ends["dense"][reached].min()
    assert ends["progress"][down].max() < 5 < 30 < ends["progress"][reached].min()


# ── inputs ──────────────────────────────────────────────────────────────────────────────


def test_a_policy_is_fed_the_way_to_the_goal_where_there_is_one() -> None:
    step = walked()["progress"]
    fed = np.asarray(inputs(step.after.observation, step.goal - step.after.position))
    size = ROBOT.observation.size
    assert fed.shape == (STEPS, LANES, input_size(ROBOT, TASK)) == (STEPS, LANES, size + 3)
    np.testing.assert_array_equal(fed[..., :size], step.after.observation)
    np.testing.assert_array_equal(fed[..., size:], step.goal - step.after.position)
    task, keys = WalkForward(), jax.random.split(jax.random.key(0), 3)
    lanes = jax.eval_shape(functools.partial(task.start, ROBOT), keys)
    assert lanes.goal is None and lanes.relative_goal is None
    assert inputs(lanes.robots.observation, None).shape == (3, input_size(ROBOT, task))


def test_a_goal_that_cannot_be_reached_is_refused() -> None:
    with pytest.raises(BadInput, match="goal_radius"):
        GoToGoal(goal_radius=0.0)


@pytest.mark.parametrize("task", [WalkForward, GoToGoal])
def test_episodes_without_a_step_are_refused(task) -> None:
    with pytest.raises(BadInput, match="episode_steps must be at least 1"):
        task(episode_steps=0)
