"""Tasks: the reward of a step and the end of an episode, for any Robot.

Collection rewards walking forward (A.1.1): forward velocity and a bonus for not falling,
minus control and contact costs. The baselines get a reward for walking to a goal.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp

from genidm.checks import check, count, number, positive
from genidm.errors import BadInput
from genidm.paper.protocol import TARGET_BEARING
from genidm.robots.base import Robot, State
from genidm.symmetry import horizontal_norm, quarters_to, vector, wrap

RELATIVE_GOAL = vector("relative goal")


class View(flax.struct.PyTreeNode):
    """How a policy sees robots `[B]`, and what its actions mean.

    Attributes:
      forward: `[B]`, radians, the direction in the world that the policy sees as +x; None: +x.
      nearest_side: whether the policy sees the side of the body that is nearest to +x as its front
        (for a body with four equal sides).
    """

    forward: Any = None
    nearest_side: bool = flax.struct.field(pytree_node=False, default=False)

    def state(self, robot: Robot, robots: State) -> jax.Array:
        """s `[B, S]` as the policy sees it."""
        s = robots.observation
        if self.forward is not None:
            s = robot.observation.rotate(s, -self.forward)
        if self.nearest_side:
            s = robot.observation.turn_body_by(s, self._quarters(robots))
        return s

    def seen_action(self, robot: Robot, robots: State, a: jax.Array) -> jax.Array:
        """The policy's action `[B, A]` for the robot's action `a [B, A]`."""
        return robot.action.turn_body_by(a, self._quarters(robots)) if self.nearest_side else a

    def robot_action(self, robot: Robot, robots: State, a: jax.Array) -> jax.Array:
        """The robot's action `[B, A]` for the policy's action `a [B, A]`."""
        return robot.action.turn_body_by(a, -self._quarters(robots)) if self.nearest_side else a

    def _quarters(self, robots: State) -> jax.Array:
        forward = jnp.zeros_like(robots.heading) if self.forward is None else self.forward
        return quarters_to(forward, robots.heading)


class EnvState(flax.struct.PyTreeNode):
    """The state of B environments.

    Attributes:
      robots: State `[B]`.
      episode_step: `[B]` int32, steps since the episode began.
      keys: `[B]`, one random key per lane, so that results do not depend on sharding.
      goal: `[B, 3]`, metres, world frame; None if the task has no goals.
      view: how the policy sees the robots.
    """

    robots: State
    episode_step: jax.Array
    keys: jax.Array
    goal: Any = None
    view: View = View()

    @property
    def relative_goal(self) -> Any:
        """Vectors `[B, 3]` from robots to goals, metres; None if the task has no goals."""
        return None if self.goal is None else self.goal - self.robots.position

    def inputs(self, robot: Robot) -> jax.Array:
        """The input `[B, I]` of a policy in this state."""
        return inputs(self.view.state(robot, self.robots), self.relative_goal)


class Outcome(NamedTuple):
    """The task's result of a step, `[...]` each.

    Attributes:
      reward: reward of the step.
      terminal: bool, the episode ends here, but not by the time limit.
      absorbing_reward: reward of every step after a terminal step, for ever. So the value of a
        fall includes the negative rewards that would follow.
    """

    reward: jax.Array
    terminal: jax.Array
    absorbing_reward: jax.Array


class Transition(flax.struct.PyTreeNode):
    """One transition of B lanes, before any reset; learners and records read it.

    Attributes:
      before: State `[B]` before the step.
      action: a `[B, A]`.
      after: State `[B]` after the step.
      goal: `[B, 3]`, metres, world frame; None if the task has no goals.
      view: how the policy saw the robots before the step.
      reward: `[B]`.
      absorbing_reward: `[B]`, see `Outcome`.
      episode_step: `[B]` int32, steps of the episode before this step.
      terminal: `[B]` bool, the robot fell or reached the goal, or its physics diverged.
      last: `[B]` bool, the last step of an episode: terminal, or at the time limit.
    """

    before: State
    action: jax.Array
    after: State
    goal: Any
    view: View
    reward: jax.Array
    absorbing_reward: jax.Array
    episode_step: jax.Array
    terminal: jax.Array
    last: jax.Array

    @property
    def first(self) -> jax.Array:
        """`[B]` bool, the first step of an episode."""
        return self.episode_step == 0

    def inputs(self, robot: Robot) -> jax.Array:
        """The input `[B, I]` of the policy before the step."""
        goal = None if self.goal is None else self.goal - self.before.position
        return inputs(self.view.state(robot, self.before), goal)


class Task(Protocol):
    """The interface of a task; tasks are frozen dataclasses of settings, and subclasses of this.

    Attributes:
      goal_conditioned: whether the task has goals.
      nearest_side: see `View`.
    """

    goal_conditioned: ClassVar[bool]
    nearest_side: bool = False

    def start(self, robot: Robot, keys: jax.Array) -> EnvState:
        """EnvState `[B]` at the start of new episodes, from keys `[B]`."""

    def transition(
        self, robot: Robot, lanes: EnvState, action: jax.Array, after: State
    ) -> Transition:
        """The transition `[B]` from `lanes` under `action [B, A]` to `after`, with its reward."""

    def metrics(self, robot: Robot, step: Transition) -> dict[str, jax.Array]:
        """Metrics of a step for the learning curves, `[B]` each."""

    def draw(self, key: jax.Array) -> Any:
        """Draw the random numbers of one step of one lane; None if the task needs none."""
        return None

    def advance(self, lanes: EnvState, numbers: Any) -> EnvState:
        """Change the task of `lanes [B]` after a step, with the numbers that `draw` drew for it."""
        return lanes


@dataclasses.dataclass(frozen=True)
class WalkForward(Task):
    """The task to walk towards +x without a fall (A.1.1), optionally in a turning world.

    In a turning world, the direction that the policy sees as +x, and is rewarded for, changes at
    random times. So the agent learns to turn while it walks. It still has one reward, and no goal.
    The robot and its record stay in the world frame: a turn interrupts neither.

    Attributes:
      episode_steps: time limit of an episode, in steps.
      start_yaw: radians; the initial yaw is uniform in ± this value. 0, as in the paper: every
        episode starts facing +x.
      turn_rate: probability per step that the world turns. 0, as in the paper: it never turns.
      turn_spread: radians; after a turn, +x is uniform in ± this value about the robot's heading.
      nearest_side: the policy sees the side of the body that is nearest to +x as its front, so
        that it need not turn by more than 45°. Only for a body with four equal sides (the Ant).
    """

    episode_steps: int = 1000
    start_yaw: float = 0.0
    turn_rate: float = 0.0
    turn_spread: float = 1.0
    nearest_side: bool = False
    goal_conditioned: ClassVar[bool] = False

    def __post_init__(self) -> None:
        angle = number(0)
        check(self, episode_steps=count(), start_yaw=angle, turn_spread=angle)
        check(self, turn_rate=number(0, 1))

    def start(self, robot: Robot, keys: jax.Array) -> EnvState:
        if self.nearest_side and not robot.can_turn_body:
            raise BadInput(f"nearest_side needs a body with four equal sides, not the {robot.name}")
        robots, streams = _fresh(robot, keys, self.start_yaw)
        forward = jnp.zeros_like(robots.heading) if self.turn_rate else None
        view = View(forward, self.nearest_side)
        return EnvState(robots, jnp.zeros(keys.shape, jnp.int32), streams, view=view)

    def draw(self, key: jax.Array) -> Any:
        """Two uniform numbers, in [0, 1) for when and in [−1, 1) for how far the world turns."""
        if not self.turn_rate:
            return None
        when, far = jax.random.split(key)
        return (
            jax.random.uniform(when, (), jnp.float32),
            jax.random.uniform(far, (), jnp.float32, minval=-1.0),
        )

    def advance(self, lanes: EnvState, numbers: Any) -> EnvState:
        """Turn the world of some lanes."""
        if numbers is None:
            return lanes
        when, far = numbers
        turned = wrap(lanes.robots.heading + self.turn_spread * far)
        forward = jnp.where(when < self.turn_rate, turned, lanes.view.forward)
        return lanes.replace(view=lanes.view.replace(forward=forward))

    def transition(
        self, robot: Robot, lanes: EnvState, action: jax.Array, after: State
    ) -> Transition:
        speed = _forward_speed(robot, lanes.robots, after, lanes.view.forward)
        terminal = after.fallen | after.diverged
        reward = speed + robot.healthy_reward * ~terminal - robot.cost(after, action)
        outcome = Outcome(reward, terminal, jnp.zeros_like(reward))
        return to_transition(lanes, action, after, outcome, self.episode_steps)

    def metrics(self, robot: Robot, step: Transition) -> dict[str, jax.Array]:
        """Forward speed in m/s, reward, falls, divergences."""
        speed = _forward_speed(robot, step.before, step.after, step.view.forward)
        return {"speed": speed} | _common(step)


def _forward_speed(robot: Robot, before: State, after: State, forward: Any) -> jax.Array:
    """Speed `[B]` in the direction `forward [B]` (None: +x), m/s."""
    way = after.position - before.position
    ahead = way[:, 0]
    if forward is not None:
        ahead = way[:, 0] * jnp.cos(forward) + way[:, 1] * jnp.sin(forward)
    return ahead / robot.dt


class GoalStep(NamedTuple):
    """The quantities that the reward of a step to a goal depends on, `[...]` each.

    Attributes:
      before: horizontal distance to the goal before the step, metres.
      after: horizontal distance to the goal after the step, metres.
      cost: control and contact costs.
      fallen: bool, the robot fell, or its physics diverged.
      reached: bool, the goal is within the goal radius.
    """

    before: jax.Array
    after: jax.Array
    cost: jax.Array
    fallen: jax.Array
    reached: jax.Array


@dataclasses.dataclass(frozen=True)
class ProgressReward:
    """Reward of VGCP: the robot "is encouraged to move in the direction of the goal" (A.1.1).

    It is the walking reward with the speed towards the goal instead of the forward speed. At the
    goal, the absorbing reward is the healthy reward; otherwise it would pay to stay away.
    """

    def __call__(self, robot: Robot, step: GoalStep) -> tuple[jax.Array, jax.Array]:
        alive = robot.healthy_reward * ~step.fallen
        speed = (step.before - step.after) / robot.dt
        return speed + alive - step.cost, alive


@dataclasses.dataclass(frozen=True)
class Sparse:
    """Reward of HER-Sparse: "0 if it reaches the goal, and −1 otherwise" (A.1.1)."""

    def __call__(self, robot: Robot, step: GoalStep) -> tuple[jax.Array, jax.Array]:
        reward = jnp.where(step.reached, 0.0, -1.0)
        return reward, reward


@dataclasses.dataclass(frozen=True)
class Dense:
    """Reward of HER-Dense: minus "a weighted sum of distance to the goal and [...] costs" (A.1.1).

    Attributes:
      distance: weight of the distance, per metre.
      cost: weight of the contact and control costs.
    """

    distance: float = 1.0
    cost: float = 0.1

    def __post_init__(self) -> None:
        check(self, distance=number(0), cost=number(0))

    def __call__(self, robot: Robot, step: GoalStep) -> tuple[jax.Array, jax.Array]:
        absorbing = jnp.where(step.reached, 0.0, -self.distance * step.after)
        return absorbing - self.cost * step.cost, absorbing


@dataclasses.dataclass(frozen=True)
class GoToGoal(Task):
    """The task to walk to a goal; every episode has a new start, heading and goal.

    Goals have the distribution of the paper's test (A.1.3), so that the baselines train on
    what they are tested on.

    Attributes:
      reward: the reward function.
      episode_steps: time limit of an episode, in steps.
      start_yaw: radians; the initial yaw is uniform in ± this value.
      bearing: radians; the bearing of the goal from the heading is uniform in ± this value.
      goal_radius: metres; within this distance the goal is reached and the episode ends.
    """

    reward: ProgressReward | Sparse | Dense = ProgressReward()
    episode_steps: int = 300
    start_yaw: float = math.pi
    bearing: float = TARGET_BEARING
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
        """Outcome `[...]` of a step from `o` to `o_next` `[..., 3]` with the goal `goal [..., 3]`.

        All arguments are in the replay buffer, so HER can compute the outcome for a new goal.
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
        """Speed towards the goal in m/s, goals reached, reward, falls, divergences."""
        before, after = (horizontal_norm(step.goal - x.position) for x in (step.before, step.after))
        speed = (before - after) / robot.dt
        return {"speed": speed, "reached": 1.0 * (after <= self.goal_radius)} | _common(step)


def ahead(robot: Robot, state: State, distance: jax.Array, bearing: jax.Array) -> jax.Array:
    """Targets `[B, 3]` at the given distance and bearing, at the height of a standing robot.

    Args:
      robot: the robot, for its standing height.
      state: State `[B]`, from which distance and bearing are measured.
      distance: `[B]`, metres, horizontal.
      bearing: `[B]`, radians to the left of the heading.
    """
    angle = state.heading + bearing
    offset = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1) * distance[:, None]
    height = jnp.full_like(distance, robot.standing_height)
    return jnp.concatenate([state.position[:, :2] + offset, height[:, None]], axis=-1)


def _fresh(robot: Robot, keys: jax.Array, start_yaw: float) -> tuple[State, jax.Array]:
    """Initial states of B lanes, with a yaw in ± `start_yaw`, and new keys `[B]`."""
    streams = jax.vmap(lambda k: jax.random.split(k, 3))(keys)
    turn = jax.vmap(lambda k: jax.random.uniform(k, (), jnp.float32, -1.0, 1.0))(streams[:, 0])
    return robot.reset(streams[:, 1], start_yaw * turn), streams[:, 2]


def to_transition(
    lanes: EnvState, action: jax.Array, after: State, outcome: Outcome, episode_steps: int
) -> Transition:
    """The transition from `lanes` to `after`; it is `last` if terminal, or at `episode_steps`."""
    return Transition(
        before=lanes.robots,
        action=action,
        after=after,
        goal=lanes.goal,
        view=lanes.view,
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
    """The input of a policy: s `[..., S]`, or (s, g − o) `[..., S + 3]` with a goal."""
    return s if relative_goal is None else jnp.concatenate([s, relative_goal], axis=-1)


def mirror_inputs(robot: Robot, x: jax.Array) -> jax.Array:
    """The input `[..., I]` of a policy after the reflection y → −y."""
    s, relative_goal = jnp.split(x, [robot.observation.size], axis=-1)
    goal = RELATIVE_GOAL.mirror(relative_goal) if relative_goal.shape[-1] else None
    return inputs(robot.observation.mirror(s), goal)


def input_size(robot: Robot, task: Task) -> int:
    """Size of the input of a policy."""
    return robot.observation.size + 3 * task.goal_conditioned


def bootstrapped_reward(step: Outcome | Transition, discounting: float) -> jax.Array:
    """Reward `[...]` of a step plus, if it is terminal, γ / (1 − γ) times the absorbing reward."""
    return step.reward + step.terminal * step.absorbing_reward * discounting / (1 - discounting)
