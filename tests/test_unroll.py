"""An agent's steps, held against a loop that takes them one by one."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import close, is_key, same
from point import Point

from genidm import devices, symmetry
from genidm.agents.unroll import generate_unroll
from genidm.experience import Experience
from genidm.tasks import EnvState, GoToGoal, Task, Transition, WalkForward

# It falls often, so that lanes end several episodes within one walk.
ROBOT = Point(speed=4.0, falls_at=1.2)
SHORT = Point(speed=4.0, falls_at=0.35)
LANES, STEPS = 24, 40
RATE, SPREAD = 0.2, 0.7
TASKS: dict[str, Task] = {
    "forward": WalkForward(episode_steps=15),
    "goal": GoToGoal(episode_steps=15, goal_radius=0.5),
    "turning": WalkForward(episode_steps=15, start_yaw=0.5, turn_rate=RATE, turn_spread=SPREAD),
}
each = pytest.mark.parametrize("name", TASKS)


def draw(key: jax.Array) -> jax.Array:
    return jax.random.uniform(key, (3,), minval=-1.0)


def choose(x: jax.Array, drawn: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    return drawn, 0.5 * drawn, x


def keep(step: Transition, fed: jax.Array) -> tuple[Transition, jax.Array]:
    return step, fed


def start(task: Task, robot: Point = ROBOT) -> EnvState:
    return jax.jit(functools.partial(task.start, robot))(jax.random.split(jax.random.key(0), LANES))


@functools.cache
def walked(name: str, robot: Point = ROBOT) -> tuple[EnvState, Experience, Any, dict[str, Any]]:
    program = jax.jit(
        functools.partial(generate_unroll, robot, TASKS[name], STEPS, draw, choose, keep)
    )
    return jax.tree.map(
        lambda x: x if is_key(x) else np.asarray(x), program(start(TASKS[name], robot))
    )


@each
def test_a_lane_goes_on_from_where_it_was_or_starts_afresh(name: str) -> None:
    lanes, record, (step, _), _ = walked(name)
    same(step.before.physics.position[0], start(TASKS[name]).robots.physics.position)
    going, ended = ~step.last[:-1], step.last[:-1]
    assert going.any() and ended.any()
    np.testing.assert_array_equal(
        step.before.physics.position[1:][going], step.after.physics.position[:-1][going]
    )
    np.testing.assert_array_equal(step.episode_step[1:][going], step.episode_step[:-1][going] + 1)
    assert (step.episode_step[1:][ended] == 0).all() and (
        record.first == (step.episode_step == 0)
    ).all()
    # Fresh starts lie near the origin, where no robot was that had gone on.
    assert np.linalg.norm(step.before.position[1:][ended][:, :2], axis=-1).max() < 0.15
    same(
        lanes.robots.physics.position[~step.last[-1]],
        step.after.physics.position[-1][~step.last[-1]],
    )


@each
def test_the_robot_makes_the_steps_that_are_recorded(name: str) -> None:
    _, record, (step, fed), metrics = walked(name)
    flat = jax.tree.map(lambda x: jnp.asarray(x).reshape(-1, *x.shape[2:]), step)
    after = jax.jit(ROBOT.step)(flat.before, flat.action)
    close(after.position, flat.after.position, atol=1e-6)
    keys = jax.random.split(jax.random.key(0), len(flat.episode_step))
    lanes = EnvState(flat.before, flat.episode_step, keys, flat.goal, view=flat.view)
    anew = TASKS[name].transition(ROBOT, lanes, flat.action, flat.after)
    close(anew.reward, flat.reward, atol=1e-5)
    assert (np.asarray(anew.last) == np.asarray(flat.last)).all()
    np.testing.assert_array_equal(record.a, step.action)
    np.testing.assert_array_equal(record.intended, 0.5 * step.action)
    if step.view.forward is None:
        np.testing.assert_array_equal(fed[..., : record.s.shape[-1]], record.s)
    assert metrics["reward"].shape == (STEPS, LANES)


def test_the_world_turns_about_the_robot_and_the_record_does_not() -> None:
    _, record, (step, fed), metrics = walked("turning")
    going = ~step.last[:-1]
    turned = going & (step.view.forward[1:] != step.view.forward[:-1])
    assert 0.7 * RATE < turned.sum() / going.sum() < 1.3 * RATE
    after_start = np.where(step.episode_step == 0, step.view.forward, 0)
    assert not after_start.any()  # an episode starts with +x as forward
    relative = np.asarray(symmetry.wrap(step.view.forward[1:] - step.after.heading[:-1]))[turned]
    assert np.abs(relative).max() <= SPREAD + 1e-5
    assert relative.min() < -0.8 * SPREAD and relative.max() > 0.8 * SPREAD
    # The policy sees the robot in the turned world; the record holds it in the true one.
    heading = symmetry.wrap(step.before.heading - step.view.forward)
    close(ROBOT.observation.yaw(fed), heading, atol=1e-5)
    close(ROBOT.observation.yaw(record.s), step.before.heading, atol=1e-5)
    np.testing.assert_array_equal(record.forward, step.view.forward)
    np.testing.assert_array_equal(record.o[1:][going], record.o_next[:-1][going])
    # It is paid for the speed along the forward direction of the step.
    way = (record.o_next - record.o)[..., :2]
    ahead = np.stack([np.cos(step.view.forward), np.sin(step.view.forward)], axis=-1)
    speed = (way * ahead).sum(-1) / ROBOT.dt
    close(metrics["speed"], speed, atol=1e-4)
    close(step.reward, speed + 1 - ROBOT.cost(step.after, step.action), atol=1e-4)


def test_a_world_that_does_not_turn_draws_the_same_numbers_as_one_that_does() -> None:
    straight = dataclasses.replace(TASKS["turning"], turn_rate=0.0)
    program = jax.jit(
        functools.partial(generate_unroll, ROBOT, straight, STEPS, draw, choose, keep)
    )
    record = program(start(straight))[1]
    np.testing.assert_array_equal(record.a, walked("turning")[1].a)
    assert record.forward is None


def test_no_start_and_no_action_comes_twice_however_short_the_episodes() -> None:
    """Lanes that end more than one episode in a walk draw starts anew within it."""
    _, record, (step, _), _ = walked("forward", SHORT)
    assert step.last.sum(0).min() >= 3
    starts = step.before.position[record.first]
    assert len(np.unique(starts, axis=0)) == len(starts) == record.first.sum()
    actions = record.a.reshape(-1, 3)
    assert len(np.unique(actions, axis=0)) == len(actions)


@each
def test_lanes_walk_alike_however_they_are_shared_out(name: str) -> None:
    task = TASKS[name]

    def on(count: int) -> Any:
        mesh = devices.mesh(jax.devices()[:count])
        body = functools.partial(generate_unroll, ROBOT, task, STEPS, draw, choose, keep)
        program = jax.jit(devices.over_lanes(body, mesh, [0], (0, 1, 1, 1)))
        return program(devices.put(start(task), mesh))

    one, two = on(1), on(2)
    close(one, two, atol=1e-5)
