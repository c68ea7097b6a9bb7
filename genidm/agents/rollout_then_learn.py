"""The iteration of all learning agents: all devices step their lanes, then one device learns."""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import flax.struct
import jax
from jax.sharding import Mesh

from genidm import devices
from genidm.agents.base import Agent, Iterate, Learning, Metrics
from genidm.agents.policy import Activation, Policy
from genidm.experience import Experience
from genidm.progress import compile_ahead
from genidm.robots.base import Robot
from genidm.rollout import narrow
from genidm.tasks import EnvState, Task


class AgentState(flax.struct.PyTreeNode):
    """The state of an agent between two iterations: what `Learning` calls a learner.

    Attributes:
      env_state: state of the environments.
      training_state: the agent's TrainingState. Its `actor_params` are (statistics of the inputs,
        parameters of the policy network).
    """

    env_state: EnvState
    training_state: Any


@dataclasses.dataclass(frozen=True)
class RolloutThenLearn:
    """An iteration of two programs: all devices step, then one learns and the others wait.

    Attributes:
      title: name of the agent in messages.
      start: key → AgentState.
      rollout: (statistics, policy, lanes `[B]`) → (lanes, Experience, batch, metrics); all but
        the lanes are `[unroll_length, B, ...]`.
      learn: (training state, batch) → (training state, losses).
      mesh: the devices that share the lanes; the first of them learns.
    """

    title: str
    start: Callable[[jax.Array], AgentState]
    rollout: Callable[..., Any]
    learn: Callable[..., Any]
    mesh: Mesh

    @functools.cached_property
    def stepping(self) -> Any:
        """The first program: `rollout`, sharded over the lanes; it donates the lanes."""
        sharded = devices.over_lanes(self.rollout, self.mesh, [None, None, 0], (0, 1, 1, 1))
        return jax.jit(sharded, donate_argnums=2)

    @functools.cached_property
    def updating(self) -> Any:
        """The second program: `learn`, on one device; it donates the training state."""
        return jax.jit(self.learn, donate_argnums=0)

    def acting(self, training: Any) -> tuple[Any, Any]:
        """Copy the statistics and policy parameters to every device."""
        return devices.put(training.actor_params, self.mesh, None)

    def place(self, learner: AgentState) -> AgentState:
        return AgentState(
            devices.put(learner.env_state, self.mesh),
            devices.gather(learner.training_state, self.mesh),
        )

    def prepare(self, learner: AgentState) -> Iterate:
        args = (*self.acting(learner.training_state), learner.env_state)
        step = compile_ahead(f"rollout of {self.title}", self.stepping, *args)
        batch = jax.eval_shape(self.stepping, *args)[2]
        update = compile_ahead(
            f"learning of {self.title}", self.updating, learner.training_state, batch
        )

        def iterate(learner: AgentState) -> tuple[AgentState, Experience, Metrics]:
            lanes, experience, batch, seen = step(
                *self.acting(learner.training_state), learner.env_state
            )
            training, losses = update(learner.training_state, devices.gather(batch, self.mesh))
            return AgentState(lanes, training), experience, seen | losses

        return iterate

    def learning(self) -> Learning:
        """The functions that `collect` needs."""
        return Learning(self.start, self.place, self.prepare)


class LearningAgent(Agent):
    """Settings of an agent whose iteration is RolloutThenLearn.

    Attributes:
      activation: activation of the policy's hidden layers.
      policy_hidden_layer_sizes: widths of the policy's hidden layers.
      mirror: whether the policy is its own mirror image (`mirroring`).
    """

    activation: ClassVar[Activation]
    policy_hidden_layer_sizes: tuple[int, ...]
    mirror: bool

    @abc.abstractmethod
    def programs(self, robot: Robot, task: Task, mesh: Mesh) -> RolloutThenLearn:
        """The rollout and learning programs of an iteration."""

    def learning(self, robot: Robot, task: Task, mesh: Mesh) -> Learning:
        return self.programs(robot, task, mesh).learning()

    def policy(self, robot: Robot, task: Task, learner: AgentState) -> Policy:
        """The learned policy, without exploration."""
        statistics, params = learner.training_state.actor_params
        statistics = narrow(statistics)
        return Policy(
            params=params,
            mean=statistics.mean,
            std=statistics.std,
            policy_hidden_layer_sizes=self.policy_hidden_layer_sizes,
            activation=self.activation,
            goal_conditioned=task.goal_conditioned,
            robot=robot,
            nearest_side=task.nearest_side,
            mirror=self.mirror,
        )
