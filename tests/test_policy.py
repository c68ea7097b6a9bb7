"""A trained policy as a controller: what it answers, and what comes back from the disk."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import same
from brax.training.acme import running_statistics
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.sac import networks as sac_networks
from point import Point

from genidm import controller, devices, files, symmetry
from genidm.agents.ddpg import DDPG
from genidm.agents.policy import Policy
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.sac import SAC
from genidm.controller import Controller
from genidm.errors import BadInput
from genidm.evaluation.evaluate import walking_speed
from genidm.files import Corrupt
from genidm.paper.idm import Architecture
from genidm.tasks import GoToGoal, Task, WalkForward, inputs

ROBOT = Point()
S, A = ROBOT.observation.size, ROBOT.action.size
SMALL: dict[str, Any] = dict(num_envs=2, unroll_length=2, policy_hidden_layer_sizes=(7, 6))
OFF: dict[str, Any] = dict(max_replay_size=100, min_replay_size=0, critic_hidden_layer_sizes=(5,))
AGENTS = {
    "PPO": PPO(num_minibatches=2, **SMALL),
    "SAC": SAC(**SMALL, **OFF),
    "DDPG": DDPG(**SMALL, **OFF),
}
TASKS: dict[str, Task] = {"goal": GoToGoal(), "forward": WalkForward()}

every = pytest.mark.parametrize("name", AGENTS)
tasks = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


@functools.cache
def learner(name: str, task: Task) -> Any:
    """Fresh networks, their biases moved, and statistics that some inputs exceed by far."""
    learning = AGENTS[name].learning(ROBOT, task, devices.mesh(jax.devices()[:1]))
    begun = jax.jit(learning.start)(jax.random.key(0))
    rng = np.random.default_rng(1)
    size = S + 3 * task.goal_conditioned
    seen = jnp.float32(rng.normal(size=(50, size)) * 10.0 ** rng.uniform(-2, 1, size) + 0.3)
    statistics = running_statistics.update(begun.training_state.statistics, seen)
    training = begun.training_state.replace(statistics=statistics)
    return begun.replace(training_state=jax.tree.map(moved, training))


def moved(x: jax.Array) -> jax.Array:
    """Biases are zero at first."""
    return x + 0.1 * jnp.arange(x.size, dtype=x.dtype) if x.ndim == 1 else x


def policy(name: str, task: Task) -> Policy:
    made = AGENTS[name].policy(ROBOT, task, learner(name, task))
    assert made is not None
    return made


def questions() -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(2)
    return jnp.float32(rng.normal(size=(4, 5, S))), jnp.float32(rng.normal(size=(4, 5, 3)))


ask = jax.jit(Policy.__call__)


def braxs(name: str, task: Task, x: jax.Array) -> jax.Array:
    """Brax's own deterministic inference; DDPG, which Brax lacks, is tanh of its network."""
    agent, training, size = AGENTS[name], learner(name, task).training_state, x.shape[-1]
    if name == "DDPG":
        return jnp.tanh(
            agent.networks(ROBOT, size)[0].apply(training.statistics, training.networks.policy, x)
        )
    if name == "SAC":
        make, networks = sac_networks.make_inference_fn, agent.networks(ROBOT, size)
        params = (training.statistics, training.networks.policy)
    else:
        make, networks = ppo_networks.make_inference_fn, agent.networks(ROBOT, task)
        params = (training.statistics, training.params.policy)
    return make(networks)(params, deterministic=True)(x, jax.random.key(0))[0]


@every
@tasks
def test_it_answers_as_braxs_inference_does(name: str, task: Task) -> None:
    s, way = questions()
    answer = ask(policy(name, task), s, way)
    assert answer.shape == (4, 5, A) and abs(answer).max() <= 1 and answer.std() > 0.1
    s = ROBOT.observation.canonical(s)
    expected = braxs(name, task, inputs(s, way if task.goal_conditioned else None))
    np.testing.assert_allclose(answer, expected, rtol=0, atol=1e-6)


@every
def test_only_who_learned_to_go_to_goals_heeds_them(name: str) -> None:
    s, way = questions()
    goal, forward = (policy(name, task) for task in TASKS.values())
    same(ask(forward, s, way), ask(forward, s, -way))
    assert (abs(ask(goal, s, way) - ask(goal, s, -way)).max(-1) > 0).all()


@every
@tasks
def test_what_is_saved_is_read_to_the_bit(name: str, task: Task, tmp_path: Path) -> None:
    made = policy(name, task)
    made.save(tmp_path / "policy")
    back = controller.load(tmp_path / "policy", ROBOT)
    assert isinstance(back, Policy) and back.robot is ROBOT
    same(back, jax.tree.map(np.asarray, made))
    same(ask(back, *questions()), ask(made, *questions()))


def test_each_kind_of_controller_is_read_as_what_it_is(tmp_path: Path) -> None:
    architecture = Architecture(A, (4,), (4,), 2)
    params = architecture.init(jax.random.key(0), S)
    Controller(
        params=params, mean=jnp.zeros(S), std=jnp.ones(S), architecture=architecture,
        input_frame="world", robot=ROBOT,
    ).save(tmp_path / "controller")  # fmt: skip
    policy("SAC", GoToGoal()).save(tmp_path / "policy")
    kinds = [type(controller.load(tmp_path / x, ROBOT)) for x in ("controller", "policy")]
    assert kinds == [Controller, Policy]


def test_the_agent_turned_walks_to_the_goal_as_it_walks_to_x(tmp_path: Path) -> None:
    """With the world turned so that the goal lies on +x, it acts as without a goal."""
    plain = policy("PPO", TASKS["forward"])
    turned = plain.replace(faces_goal=True)
    s, goal = questions()
    angle = jnp.arctan2(goal[..., 1], goal[..., 0])
    expected = ask(plain, ROBOT.observation.rotate(s, -angle), goal)
    np.testing.assert_allclose(ask(turned, s, goal), expected, atol=1e-5)
    yaw = jnp.float32(0.7)
    around = ask(turned, ROBOT.observation.rotate(s, yaw), symmetry.rotate_vector(goal, yaw))
    np.testing.assert_allclose(around, expected, atol=1e-4)
    assert np.abs(ask(turned, s, -goal) - expected).max() > 1e-2
    turned.save(tmp_path / "turned")
    read = controller.load(tmp_path / "turned", ROBOT)
    assert isinstance(read, Policy) and read.faces_goal
    assert not (read.nearest_side or read.mirror)
    np.testing.assert_array_equal(ask(read, s, goal), ask(turned, s, goal))


def test_nothing_is_written_over_unasked(tmp_path: Path) -> None:
    policy("PPO", WalkForward()).save(tmp_path / "policy")
    with pytest.raises(BadInput):
        policy("SAC", GoToGoal()).save(tmp_path / "policy")
    policy("SAC", GoToGoal()).save(tmp_path / "policy", overwrite=True)
    assert controller.load(tmp_path / "policy", ROBOT).goal_conditioned


def test_the_policy_of_another_robot_is_refused(tmp_path: Path) -> None:
    class Other(Point):
        name = "other"

    policy("PPO", GoToGoal()).replace(robot=Other()).save(tmp_path / "policy")
    with pytest.raises(BadInput, match="controller for other, not for point"):
        controller.load(tmp_path / "policy", ROBOT)
    with pytest.raises(BadInput, match="no robot is called 'other'"):
        controller.load(tmp_path / "policy")


def test_what_is_no_controller_is_refused(tmp_path: Path) -> None:
    files.save_arrays(tmp_path / "policy", {"params": np.zeros(3)}, {"robot": "point"})
    with pytest.raises(BadInput, match="holds no controller"):
        controller.load(tmp_path / "policy", ROBOT)
    policy("PPO", GoToGoal()).save(tmp_path / "policy", overwrite=True)
    (tmp_path / "policy" / "mean.npy").unlink()
    with pytest.raises(Corrupt, match=r"mean\.npy is missing"):
        controller.load(tmp_path / "policy", ROBOT)


def test_random_actions_leave_no_policy() -> None:
    assert RandomActions().policy(ROBOT, WalkForward(), None) is None


@dataclasses.dataclass(frozen=True)
class Ahead:
    """Goes +x at a share of full speed, goals unheeded."""

    pace: float

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        yaw = ROBOT.observation.yaw(s)
        way = jnp.stack([jnp.cos(yaw), -jnp.sin(yaw), jnp.zeros_like(yaw)], axis=-1)
        return self.pace * way


def test_walking_speed_is_the_speed_towards_x() -> None:
    walker = jax.tree_util.Partial(Ahead(0.75))
    speed = walking_speed(ROBOT, walker, episodes=20)
    assert speed.shape == (20,)
    np.testing.assert_allclose(speed, 0.75, rtol=0, atol=1e-3)
