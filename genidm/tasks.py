"""What a robot is rewarded for, and when its episode ends, over any Robot.

Collecting rewards walking one way (A.1.1): forward velocity, a bonus for staying up,
minus control and contact costs. The baselines are rewarded for walking to a goal.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp

from genidm.checks import check, count, number, positive
from genidm.robots.base import Robot, State
from genidm.symmetry import horizontal_norm


class EnvState(flax.struct.PyTreeNode):
    """B robots in the middle of their episodes.

    Attributes:
      robots: their State.
      episode_step: `[B]` int32, steps since the episode began.
      keys: `[B]`, one random stream a lane, so that results do not depend on sharding.
      goal: `[B, 3]`, metres, world frame; None where the task has no goals.
    """

    robots: State
    episode_step: jax.Array
    keys: jax.Array
    goal: Any = None

    @property
    def relative_goal(self) -> Any:
        """From the robots to their goals `[B, 3]`, metres; None where the task has none."""
        return None if self.goal is None else self.goal - self.robots.position


class Outcome(NamedTuple):
    """What a task makes of a step, `[...]` each.

    Attributes:
      reward: of the step.
      terminal: bool, the episode ends here for good.
      absorbing_reward: reward of each step for ever after a terminal one. A robot that has fallen
        is not let off: what it would be charged if it lay there stands here.
    """

    reward: jax.Array
    terminal: jax.Array
    absorbing_reward: jax.Array


class Transition(flax.struct.PyTreeNode):
    """One transition of B lanes, before any reset; what learners and records read.

    Attributes:
      before: State `[B]` that the action was chosen in.
      action: a `[B, A]`.
      after: State `[B]` that it led to.
      goal: `[B, 3]`, metres, world frame; None where the task has no goals.
      reward: `[B]`.
      absorbing_reward: `[B]`, see `Outcome`.
      episode_step: `[B]` int32, steps of the episode before this one.
      terminal: `[B]` bool, the robot fell, arrived, or its physics diverged.
      last: `[B]` bool, the episode ended here: terminal, or at the time limit.
    """

    before: State
    action: jax.Array
    after: State
    goal: Any
    reward: jax.Array
    absorbing_reward: jax.Array
    episode_step: jax.Array
    terminal: jax.Array
    last: jax.Array

    @property
    def first(self) -> jax.Array:
        """`[B]` bool, `before` is the start of an episode."""
        return self.episode_step == 0


class Task(Protocol):
    """What an agent learns: settings, as a frozen dataclass.

    Attributes:
      goal_conditioned: whether there are goals.
    """

    goal_conditioned: ClassVar[bool]

    def start(self, robot: Robot, keys: jax.Array) -> EnvState:
        """EnvState `[B]` at the start of fresh episodes."""

    def transition(
        self, robot: Robot, lanes: EnvState, action: jax.Array, after: State
    ) -> Transition:
        """What a step of every lane under `[B, A]`, which led to `after`, is worth."""

    def metrics(self, robot: Robot, step: Transition) -> dict[str, jax.Array]:
        """What is worth a learning curve, `[B]` each."""


@dataclasses.dataclass(frozen=True)
class WalkForward:
    """Walk towards +x for as long as you stand.

    Attributes:
      episode_steps: the time limit.
      start_yaw: radians; starts are turned by a yaw drawn from ± this. 0 is the paper's:
        every episode starts facing +x.
    """

    episode_steps: int = 1000
    start_yaw: float = 0.0
    goal_conditioned: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check(self, episode_steps=count(), start_yaw=number(0))

    def start(self, robot: Robot, keys: jax.Array) -> EnvState:
        robots, streams = _fresh(robot, keys, self.start_yaw)
        return EnvState(robots, jnp.zeros(keys.shape, jnp.int32), streams)

    def transition(
        self, robot: Robot, lanes: EnvState, action: jax.Array, after: State
    ) -> Transition:
        forward = (after.position[:, 0] - lanes.robots.position[:, 0]) / robot.dt
        terminal = after.fallen | after.diverged
        reward = forward + robot.healthy_reward * ~terminal - robot.cost(after, action)
        outcome = Outcome(reward, terminal, jnp.zeros_like(reward))
        return to_transition(lanes, action, after, outcome, self.episode_steps)

    def metrics(self, robot: Robot, step: Transition) -> dict[str, jax.Array]:
        """Forward speed in m/s, reward, falls, divergences."""
        forward = step.after.position[:, 0] - step.before.position[:, 0]
        return {"speed": forward / robot.dt} | _common(step)


class GoalStep(NamedTuple):
    """A step towards a goal, as far as its reward depends on it, `[...]` each.

    Attributes:
      before: metres to the goal before the step, horizontally.
      after: metres after it.
      cost: control and contact costs.
      fallen: bool.
      reached: bool.
    """

    before: jax.Array
    after: jax.Array
    cost: jax.Array
    fallen: jax.Array
    reached: jax.Array


@dataclasses.dataclass(frozen=True)
class ProgressReward:
    """Of VGCP: the robot "is encouraged to move in the direction of the goal" (A.1.1).

    The walking reward, with the speed towards the goal in place of the forward speed. Who
    has arrived stands there for ever, so that it is not better to keep away.
    """

    def __call__(self, robot: Robot, step: GoalStep) -> tuple[jax.Array, jax.Array]:
        alive = robot.healthy_reward * ~step.fallen
        speed = (step.before - step.after) / robot.dt
        return speed + alive - step.cost, alive


@dataclasses.dataclass(frozen=True)
class Sparse:
    """Of HER-Sparse: "0 if it reaches the goal, and −1 otherwise" (A.1.1)."""

    def __call__(self, robot: Robot, step: GoalStep) -> tuple[jax.Array, jax.Array]:
        reward = jnp.where(step.reached, 0.0, -1.0)
        return reward, reward


@dataclasses.dataclass(frozen=True)
class Dense:
    """Of HER-Dense: "a weighted sum of distance to the goal and contact and control costs".

    Attributes:
      distance: weight of a metre.
      cost: weight of the costs.
    """

    distance: float = 1.0
    cost: float = 0.1

    def __post_init__(self) -> None:
        check(self, distance=number(0), cost=number(0))

    def __call__(self, robot: Robot, step: GoalStep) -> tuple[jax.Array, jax.Array]:
        far = jnp.where(step.reached, 0.0, -self.distance * step.after)
        return far - self.cost * step.cost, far


@dataclasses.dataclass(frozen=True)
class GoToGoal:
    """Walk to a goal; start, heading and goal are drawn afresh for every episode.

    Goals lie as in the paper's test (A.1.3): no baseline is asked for what it never saw.

    Attributes:
      reward: of a step.
      episode_steps: the time limit.
      start_yaw: radians; starts are turned by a yaw drawn from ± this.
      bearing: radians; goals lie within ± this of the heading.
      goal_radius: metres; nearer is reached, and ends the episode.
    """

    reward: ProgressReward | Sparse | Dense = ProgressReward()
    episode_steps: int = 300
    start_yaw: float = math.pi
    bearing: float = math.pi / 4
    goal_radius: float = 0.1
    goal_conditioned: ClassVar[bool] = True

    def __post_init__(self) -> None:
        angle = number(0)
        check(self, episode_steps=count(), start_yaw=angle, bearing=angle, goal_radius=positive())

    def start(self, robot: Robot, keys: jax.Array) -> EnvState:
        robots, streams = _fresh(robot, keys, self.start_yaw)
        streams = jax.vmap(jax.random.split)(streams)
        low, high = robot.target_distance

        def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
            far, side = jax.random.split(key)
            distance = jax.random.uniform(far, (), jnp.float32, low, high)
            bearing = jax.random.uniform(side, (), jnp.float32, -self.bearing, self.bearing)
            return distance, bearing

        distance, bearing = jax.vmap(draw)(streams[:, 0])
        goal = ahead(robot, robots, distance, bearing)
        return EnvState(robots, jnp.zeros(keys.shape, jnp.int32), streams[:, 1], goal)

    def outcome(
        self,
        robot: Robot,
        o: jax.Array,
        o_next: jax.Array,
        goal: jax.Array,
        cost: jax.Array,
        fallen: jax.Array,
    ) -> Outcome:
        """What a step from `o` to `o_next` `[..., 3]` is worth on the way to `goal`.

        A function of what a replay buffer holds, so that a relabelled step is judged as if
        it had been made for its new goal.
        """
        after = horizontal_norm(goal - o_next)
        reached = after <= self.goal_radius
        step = GoalStep(horizontal_norm(goal - o), after, cost, fallen, reached)
        reward, absorbing_reward = self.reward(robot, step)
        return Outcome(reward, fallen | reached, absorbing_reward)

    def transition(
        self, robot: Robot, lanes: EnvState, action: jax.Array, after: State
    ) -> Transition:
        outcome = self.outcome(
            robot, lanes.robots.position, after.position, lanes.goal,
            robot.cost(after, action), after.fallen | after.diverged,
        )  # fmt: skip
        return to_transition(lanes, action, after, outcome, self.episode_steps)

    def metrics(self, robot: Robot, step: Transition) -> dict[str, jax.Array]:
        """Speed towards the goal in m/s, arrivals, reward, falls, divergences."""
        before, after = (horizontal_norm(step.goal - x.position) for x in (step.before, step.after))
        speed = (before - after) / robot.dt
        return {"speed": speed, "reached": 1.0 * (after <= self.goal_radius)} | _common(step)


def ahead(robot: Robot, state: State, distance: jax.Array, bearing: jax.Array) -> jax.Array:
    """Targets `[B, 3]` at the height of a standing robot.

    Args:
      robot: gives the height.
      state: of robots `[B]`, which the targets are seen from.
      distance: `[B]`, metres, horizontal.
      bearing: `[B]`, radians to the left of the heading.
    """
    angle = state.heading + bearing
    offset = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1) * distance[:, None]
    height = jnp.full_like(distance, robot.standing_height)
    return jnp.concatenate([state.position[:, :2] + offset, height[:, None]], axis=-1)


def _fresh(robot: Robot, keys: jax.Array, start_yaw: float) -> tuple[State, jax.Array]:
    """Fresh starts of B lanes, turned by up to ± `start_yaw`, and what is left of their keys."""
    streams = jax.vmap(lambda k: jax.random.split(k, 3))(keys)
    turn = jax.vmap(lambda k: jax.random.uniform(k, (), jnp.float32, -1.0, 1.0))(streams[:, 0])
    return robot.reset(streams[:, 1], start_yaw * turn), streams[:, 2]


def to_transition(
    lanes: EnvState, action: jax.Array, after: State, outcome: Outcome, episode_steps: int
) -> Transition:
    """The transition of lanes that have stepped, and whether their episodes end with it."""
    return Transition(
        before=lanes.robots,
        action=action,
        after=after,
        goal=lanes.goal,
        reward=outcome.reward,
        absorbing_reward=outcome.absorbing_reward,
        episode_step=lanes.episode_step,
        terminal=outcome.terminal,
        last=outcome.terminal | (lanes.episode_step + 1 >= episode_steps),
    )


def _common(step: Transition) -> dict[str, jax.Array]:
    return {
        "reward": step.reward,
        "falls": 1.0 * step.after.fallen,
        "diverged": 1.0 * step.after.diverged,
    }


def inputs(s: jax.Array, relative_goal: Any) -> jax.Array:
    """What a policy is fed: s `[..., S]`, or (s, g − o) `[..., S + 3]` where there are goals."""
    return s if relative_goal is None else jnp.concatenate([s, relative_goal], axis=-1)


def input_size(robot: Robot, task: Task) -> int:
    """Length of `inputs`."""
    return robot.observation.size + 3 * task.goal_conditioned


def bootstrapped_reward(step: Outcome | Transition, discounting: float) -> jax.Array:
    """Reward `[...]` of a step and, if it is terminal, of all that would follow it."""
    return step.reward + step.terminal * step.absorbing_reward * discounting / (1 - discounting)
