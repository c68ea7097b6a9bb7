"""The methods of Table 1 (§5.1, §5.2) as data, with the networks and algorithms of Table 2.

An experiment runs the stages that a method names. To try something new, copy a method
with `dataclasses.replace` and change one thing.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from genidm.agents.base import Agent
from genidm.agents.ddpg import DDPG
from genidm.agents.frozen import Frozen
from genidm.agents.her import HER
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.rollout_then_learn import LearningAgent
from genidm.agents.sac import SAC
from genidm.checks import check, check_value, count, label, number, positive
from genidm.controller import Frame
from genidm.errors import BadInput
from genidm.paper import protocol
from genidm.paper.fit import Fit
from genidm.paper.generalize import Generalize
from genidm.paper.pairs import Labels
from genidm.tasks import Dense, GoToGoal, Sparse, WalkForward


@dataclasses.dataclass(frozen=True)
class Method:
    """Settings that make a controller.

    Attributes:
      name: name of the method in the table.
      agent: collects the experience, or is itself the controller.
      task: gives the agent its rewards.
    """

    name: str
    agent: Agent | Frozen
    task: WalkForward | GoToGoal

    def __post_init__(self) -> None:
        check_value("a method's name", self.name, label)


@dataclasses.dataclass(frozen=True)
class GoalConditioned(Method):
    """A baseline (§5.1): the agent learns to reach goals, and its policy is the controller."""

    agent: LearningAgent
    task: GoToGoal


@dataclasses.dataclass(frozen=True)
class FromRecord(Method):
    """A method that learns a controller from a record of experience without goals.

    Attributes:
      fraction: fraction of the record to learn from. For the paper's GE and LR, 𝒢 makes the
        other half (A.1.2).
      generalize: settings of 𝒢; None learns from the record only.
      skip: fraction of the record to leave out before that part; 0 takes the first part, as the
        paper does, and 1 − fraction the last.
    """

    fraction: float
    generalize: Generalize | None
    skip: float = dataclasses.field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, fraction=positive(1), skip=number(0, 1))
        if self.fraction + self.skip > 1 + 1e-9:
            raise BadInput(
                f"skip {self.skip:g} and fraction {self.fraction:g} are more than the record"
            )


@dataclasses.dataclass(frozen=True)
class InverseDynamics(FromRecord):
    """Inverse dynamics (§4): a controller fitted to experience without goals.

    Attributes:
      goal_horizon: h, steps to the intermediate goal o' (Def. 1); 1 is the paper's "next
        position". Steps whose episode ends earlier are left out.
      mirror: add the reflection of every sample; not in the paper.
      input_frame: "heading" rotates every input so that the robot faces +x; not in the paper.
      fit: networks and losses.
      labels: the recorded actions to learn: "performed" (the paper's), or "intended", the agent's
        choice before exploration.
      clip_bearing: at run time, rotate d into the range of bearings of the samples where it lies
        outside (`Controller.bearings`); not in the paper.
      nearest_side: count the side of the body that is nearest to d as its front, for a body with
        four equal sides; not in the paper.
    """

    goal_horizon: int
    mirror: bool
    input_frame: Frame
    fit: Fit
    labels: Labels = "performed"
    clip_bearing: bool = False
    nearest_side: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, goal_horizon=count())


@dataclasses.dataclass(frozen=True)
class AgentTurned(Method):
    """The agent itself, with the world turned so that +x points at the goal: no fit at all.

    It is not in the paper. A fit to the agent's experience should steer better than this.
    """


AnyMethod = GoalConditioned | InverseDynamics | AgentTurned
Methods = tuple[AnyMethod, ...]
Column = tuple[
    InverseDynamics,
    InverseDynamics,
    GoalConditioned,
    GoalConditioned,
    GoalConditioned,
    InverseDynamics,
    InverseDynamics,
    InverseDynamics,
    AgentTurned,
]

WALK = WalkForward()
"""The paper's task of collection: every episode starts facing +x, and +x never changes."""


@dataclasses.dataclass(frozen=True)
class Choices:
    """Our settings for a robot, where the paper is silent or where ours come nearer (docs).

    The hidden layers of every policy are those of Table 2, not those of these agents.

    Attributes:
      ppo: settings of PPO.
      sac: settings of SAC.
      ddpg: settings of DDPG.
      walk: task of collection: a turning world.
      mirror_agent: whether the collecting agent also learns from mirror images. So its gait is
        nearly its own mirror image, and HF can learn from mirror images, too.
      skip: fraction of the record to leave out. An agent that still learns to walk has nothing to
        teach; a frozen agent's record has no such part.
      goal_horizon: h.
      goal_horizon_of_random: h of RS.
      idm: hidden layers of φ without an LFM.
      lfm: hidden layers of ψ.
      idm_of_latent: hidden layers of φ after an LFM.
      updates: updates of a fit.
      nearest_side: whether the side of the body nearest to d counts as its front.
      mirror: whether HF also learns from mirror images.
    """

    ppo: PPO = dataclasses.field(default_factory=PPO)
    sac: SAC = dataclasses.field(default_factory=SAC)
    ddpg: DDPG = dataclasses.field(default_factory=DDPG)
    walk: WalkForward = WALK
    mirror_agent: bool = True
    skip: float = 0.5
    goal_horizon: int = 50
    goal_horizon_of_random: int = 100
    idm: tuple[int, ...] = (256, 256, 256, 256)
    lfm: tuple[int, ...] = (256, 256, 256, 256)
    idm_of_latent: tuple[int, ...] = (256, 256)
    updates: int = 10_000
    nearest_side: bool = False
    mirror: bool = False

    def agent(self, training: protocol.Training, her: HER | None = None) -> LearningAgent:
        """Make the agent of a row of Table 2."""
        agents: dict[str, Any] = {"PPO": self.ppo, "SAC": self.sac, "DDPG": self.ddpg}
        relabelling = {"her": her} if her else {}
        agent: LearningAgent = dataclasses.replace(
            agents[training.algorithm or ""],
            policy_hidden_layer_sizes=training.policy,
            **relabelling,
        )
        return agent


def column(robot: str, choices: Choices) -> Column:
    """Make our methods for one robot; `paper_settings` gives those of Table 2 and A.1.2.

    The last two are not in the paper: HF is RL in the heading frame, and AGENT the agent itself,
    turned towards the goal.
    """
    table = protocol.TABLE2[robot]

    def inverse(name: str) -> InverseDynamics:
        latent = table[name].lfm is not None
        fit = Fit(
            updates=choices.updates,
            idm=choices.idm_of_latent if latent else choices.idm,
            lfm=choices.lfm,
            latent_size=protocol.LATENT_SIZE[robot] if latent else None,
            latent_loss_weight=0.75,
            mean_latent=False,
        )
        return InverseDynamics(
            name=name,
            agent=_collector(robot, choices, table[name]),
            task=choices.walk,
            fraction=1 - choices.skip,
            skip=choices.skip,
            generalize=Generalize() if name in ("GE", "LR") else None,
            goal_horizon=choices.goal_horizon,
            mirror=False,
            input_frame="world",
            nearest_side=choices.nearest_side,
            fit=fit,
        )

    def direct(name: str, task: GoToGoal, her: HER | None = None) -> GoalConditioned:
        return GoalConditioned(name, choices.agent(table[name], her), task)

    rl = inverse("RL")
    return (
        _of_random(inverse("RS"), choices),
        rl,
        direct("VGCP", GoToGoal()),
        direct("HER_SP", GoToGoal(reward=Sparse()), HER()),
        direct("HER_DE", GoToGoal(reward=Dense()), HER()),
        inverse("GE"),
        inverse("LR"),
        dataclasses.replace(rl, name="HF", mirror=choices.mirror, input_frame="heading"),
        AgentTurned("AGENT", rl.agent, rl.task),
    )


def _of_random(method: InverseDynamics, choices: Choices) -> InverseDynamics:
    """A method that learns from random actions, which have no frame and no best part."""
    return dataclasses.replace(
        method, task=WALK, fraction=1.0, skip=0.0, goal_horizon=choices.goal_horizon_of_random
    )


def _collector(robot: str, choices: Choices, training: protocol.Training) -> Agent | Frozen:
    if training.algorithm is None:
        return RandomActions()
    plain: Any = choices.agent(training)
    agent = dataclasses.replace(plain, mirror=choices.mirror_agent)
    before = protocol.LEARNED_BEFORE.get(robot)
    if before is None:
        return agent
    return Frozen(agent, fraction=before / protocol.INTERACTIONS[robot])


ANT = column(
    "ant",
    Choices(
        walk=WalkForward(start_yaw=0.5, turn_rate=0.01, turn_spread=math.pi, nearest_side=True),
        goal_horizon=25,
        nearest_side=True,
        mirror=True,
    ),
)
HUMANOID = column(
    "humanoid",
    Choices(
        # A step is 0.0165 s: 0.98 looks 0.8 s ahead only, and the robot throws itself forwards.
        sac=SAC(grad_updates_per_step=16, discounting=0.99, layer_norm=True),
        walk=WalkForward(start_yaw=0.5, turn_rate=0.01, turn_spread=1.0),
        skip=0.0,
        # Random actions make the robot fall within 25 steps: a longer horizon has few samples.
        goal_horizon_of_random=10,
    ),
)
MINITAUR = column(
    "minitaur",
    Choices(
        # The robot stands by itself, and an entropy bonus would hide the gait in noise
        # (docs/choices.md).
        ppo=PPO(entropy_cost=0.0),
        walk=WalkForward(start_yaw=0.5, turn_rate=0.01, turn_spread=1.0),
    ),
)

# A user's robot: its forward direction turns, and its body may have no four equal sides.
OTHER = column("ant", Choices(walk=WalkForward(start_yaw=0.5, turn_rate=0.01)))

RS, RL, VGCP, HER_SP, HER_DE, GE, LR, HF, AGENT = ANT

EXTRA = ("HF", "AGENT")
"""Methods that are not in the paper."""

ORDER = tuple(method.name for method in ANT)
"""Order of the rows of the table; other names follow."""

TABLES = {
    "ant": ANT,
    "humanoid": HUMANOID,
    "humanoid_world": HUMANOID,
    "minitaur": MINITAUR,
}
"""Robot → the methods of its column; other robots use `OTHER`."""


def by_name(name: str, robot: str = "ant") -> AnyMethod:
    """Find a method by its name, with its settings for a robot.

    Raises:
      BadInput: no method has this name.
    """
    for method in TABLES.get(robot, OTHER):
        if method.name == name:
            return method
    raise BadInput(f"no method is called {name!r}; there are: {', '.join(ORDER)}")


def paper_settings(method: InverseDynamics, robot: str) -> InverseDynamics:
    """Give a method the paper's settings where ours differ.

    A world that does not turn, h = 1 (Def. 1), whole-episode replay (§5.2), φ fitted to mean
    latents (Eq. 6), d as it is (Remark 2), λ = 0.25, Adam with a constant learning rate, and the
    first part of the record (A.1.2). The networks are those of Table 2 where it has the method and
    the robot.

    The agent does not learn from mirror images.

    Args:
      method: the method.
      robot: name of the robot.
    """
    name = method.name.removesuffix(" paper")
    row = protocol.TABLE2.get(robot, {}).get(name, protocol.Training())
    fit = dataclasses.replace(
        method.fit,
        updates=Fit.updates,
        idm=row.idm or method.fit.idm,
        lfm=row.lfm or method.fit.lfm,
        network="mlp",
        weight_decay=0.0,
        latent_loss_weight=protocol.LATENT_WEIGHT,
        mean_latent=True,
        cosine_decay=False,
    )
    return dataclasses.replace(
        method,
        name=f"{name} paper",
        agent=without_mirror(method.agent),
        task=WALK,
        fraction=protocol.FRACTION.get(name, 1.0),
        skip=0.0,
        labels="performed",
        goal_horizon=1,
        clip_bearing=False,
        nearest_side=False,
        mirror=False,
        generalize=method.generalize and dataclasses.replace(method.generalize, mode="episodes"),
        fit=fit,
    )


def without_mirror(agent: Any) -> Any:
    """An agent that learns from what it does alone."""
    if isinstance(agent, Frozen):
        return dataclasses.replace(agent, agent=without_mirror(agent.agent))
    return dataclasses.replace(agent, mirror=False) if hasattr(agent, "mirror") else agent
