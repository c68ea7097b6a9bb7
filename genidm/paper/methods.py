"""The methods of Table 1 (§5.1, §5.2) as data, with the networks and algorithms of Table 2.

An experiment runs the stages that a method names. To try something new, copy a method
with `dataclasses.replace` and change one thing.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from genidm.agents.base import Agent
from genidm.agents.ddpg import DDPG
from genidm.agents.frozen import Frozen
from genidm.agents.her import HER
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.rollout_then_learn import LearningAgent
from genidm.agents.sac import SAC
from genidm.checks import check, check_value, count, label, positive
from genidm.controller import Frame
from genidm.errors import BadInput
from genidm.paper import protocol
from genidm.paper.fit import Fit
from genidm.paper.generalize import Generalize
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
      fraction: fraction of the record, from its start, to learn from. For the paper's GE and
        LR, 𝒢 makes the other half (A.1.2).
      generalize: settings of 𝒢; None learns from the record only.
    """

    fraction: float
    generalize: Generalize | None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, fraction=positive(1))


@dataclasses.dataclass(frozen=True)
class InverseDynamics(FromRecord):
    """Inverse dynamics (§4): a controller fitted to experience without goals.

    Attributes:
      goal_horizon: h, steps to the intermediate goal o' (Def. 1); 1 is the paper's "next
        position". Steps whose episode ends earlier are left out.
      mirror: add the reflection of every sample; not in the paper.
      input_frame: "heading" rotates every input so that the robot faces +x; not in the paper.
      fit: networks and losses.
    """

    goal_horizon: int
    mirror: bool
    input_frame: Frame
    fit: Fit

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, goal_horizon=count())


Methods = tuple[GoalConditioned | InverseDynamics, ...]
Column = tuple[
    InverseDynamics,
    InverseDynamics,
    GoalConditioned,
    GoalConditioned,
    GoalConditioned,
    InverseDynamics,
    InverseDynamics,
    InverseDynamics,
]

WALK = WalkForward()


@dataclasses.dataclass(frozen=True)
class Choices:
    """Our settings for a robot where the paper is silent.

    The hidden layers of every policy are those of Table 2, not those of these agents.

    Attributes:
      ppo: settings of PPO.
      sac: settings of SAC.
      ddpg: settings of DDPG.
      goal_horizon: h of RS.
      mirror: whether HF also learns from mirror images; True if the gait is symmetric.
    """

    ppo: PPO = dataclasses.field(default_factory=PPO)
    sac: SAC = dataclasses.field(default_factory=SAC)
    ddpg: DDPG = dataclasses.field(default_factory=DDPG)
    goal_horizon: int = 100
    mirror: bool = True

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
    """Make the methods of Table 1 for one robot, with the settings of Table 2 and A.1.2.

    The last is HF, which is not in the paper: RL in the heading frame.
    """
    table = protocol.TABLE2[robot]

    def inverse(name: str, latent_size: int | None = None) -> InverseDynamics:
        idm, lfm = table[name].idm or (), table[name].lfm or Fit.lfm
        return InverseDynamics(
            name=name,
            agent=_collector(robot, choices, table[name]),
            task=WALK,
            fraction=protocol.FRACTION[name],
            generalize=Generalize() if name in ("GE", "LR") else None,
            goal_horizon=100,
            mirror=False,
            input_frame="world",
            fit=Fit(idm=idm, lfm=lfm, latent_size=latent_size),
        )

    def direct(name: str, task: GoToGoal, her: HER | None = None) -> GoalConditioned:
        return GoalConditioned(name, choices.agent(table[name], her), task)

    lr = inverse("LR", protocol.LATENT_SIZE[robot])
    # These come nearer than the paper's (docs/choices.md), which `paper_settings` has.
    lr_fit = dataclasses.replace(lr.fit, latent_loss_weight=0.75, mean_latent=False)
    rl = inverse("RL")
    return (
        dataclasses.replace(inverse("RS"), goal_horizon=choices.goal_horizon),
        rl,
        direct("VGCP", GoToGoal()),
        direct("HER_SP", GoToGoal(reward=Sparse()), HER()),
        direct("HER_DE", GoToGoal(reward=Dense()), HER()),
        inverse("GE"),
        dataclasses.replace(lr, fit=lr_fit),
        dataclasses.replace(rl, name="HF", mirror=choices.mirror, input_frame="heading"),
    )


def _collector(robot: str, choices: Choices, training: protocol.Training) -> Agent | Frozen:
    if training.algorithm is None:
        return RandomActions()
    agent = choices.agent(training)
    before = protocol.LEARNED_BEFORE.get(robot)
    if before is None:
        return agent
    return Frozen(agent, fraction=before / protocol.INTERACTIONS[robot])


ANT = column("ant", Choices())
HUMANOID = column(
    "humanoid",
    Choices(
        # A step is 0.0165 s: 0.98 looks 0.8 s ahead only, and the robot throws itself forwards.
        sac=SAC(grad_updates_per_step=64, discounting=0.99, layer_norm=True),
        # Random actions make the robot fall within 25 steps: a longer horizon has few samples.
        goal_horizon=10,
        # The gait is not symmetric: with mirror images, HF falls (docs/choices.md).
        mirror=False,
    ),
)
MINITAUR = column(
    "minitaur",
    Choices(
        # The robot stands by itself, and an entropy bonus would hide the gait in noise
        # (docs/choices.md).
        ppo=PPO(entropy_cost=0.0),
        # This gait veers to one side: it is not symmetric either.
        mirror=False,
    ),
)

RS, RL, VGCP, HER_SP, HER_DE, GE, LR, HF = ANT

EXTRA = ("HF",)
"""Methods that are not in the paper."""

ORDER = tuple(method.name for method in ANT)
"""Order of the rows of the table; other names follow."""

TABLES = {
    "ant": ANT,
    "humanoid": HUMANOID,
    "humanoid_world": HUMANOID,
    "minitaur": MINITAUR,
}
"""Robot → the methods of its column; other robots use the Ant's."""


def by_name(name: str, robot: str = "ant") -> GoalConditioned | InverseDynamics:
    """Find a method by its name, with its settings for a robot.

    Raises:
      BadInput: no method has this name.
    """
    for method in TABLES.get(robot, ANT):
        if method.name == name:
            return method
    raise BadInput(f"no method is called {name!r}; there are: {', '.join(ORDER)}")


def paper_settings(method: InverseDynamics) -> InverseDynamics:
    """Give a method the paper's settings where ours differ.

    h = 1 (Def. 1), whole-episode replay (§5.2), λ = 0.25 (A.1.2), φ fitted to mean latents
    (Eq. 6), and Adam with a constant learning rate (A.1.2).
    """
    return dataclasses.replace(
        method,
        name=f"{method.name} paper",
        goal_horizon=1,
        generalize=method.generalize and dataclasses.replace(method.generalize, mode="episodes"),
        fit=dataclasses.replace(
            method.fit,
            latent_loss_weight=protocol.LATENT_WEIGHT,
            mean_latent=True,
            cosine_decay=False,
        ),
    )
