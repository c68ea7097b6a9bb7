"""The methods of Table 1, as data: what each is made of (Table 2), and nothing else.

An experiment runs the stages that a method names. To try something new, copy a method
with `dataclasses.replace` and change one thing.
"""

from __future__ import annotations

import dataclasses

from genidm.agents.ddpg import DDPG
from genidm.agents.frozen import Frozen
from genidm.agents.her import HER
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.sac import SAC
from genidm.checks import check, count, positive
from genidm.controller import Frame
from genidm.errors import BadInput
from genidm.fit import Fit
from genidm.generalize import Generalize
from genidm.tasks import Dense, GoToGoal, Sparse, WalkForward


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to a controller.

    Attributes:
      name: as it stands in the table.
      agent: what collects the experience, or is itself the controller.
      task: what the agent is rewarded for meanwhile.
    """

    name: str
    agent: PPO | SAC | DDPG | RandomActions | Frozen
    task: WalkForward | GoToGoal

    def __post_init__(self) -> None:
        name = self.name
        if not name.strip() or "/" in name or name.startswith(".") or not name.isprintable():
            raise BadInput(f"a method's name begins directories: not {name!r:.60}")


@dataclasses.dataclass(frozen=True)
class Direct(Method):
    """A baseline (§5.1): the agent learns to go to goals, and its policy is the controller."""

    agent: PPO | SAC | DDPG
    task: GoToGoal


@dataclasses.dataclass(frozen=True)
class Inverse(Method):
    """From experience that was never goal-directed to a controller, by inverse dynamics (§4).

    Attributes:
      share: the part of the record, from its start, that is learned from. The paper's GE
        and LR make the other half with 𝒢 (A.1.2).
      generalize: settings of 𝒢; None learns from the record alone.
      look_ahead: h, steps to the intermediate goal o'; 1 is the paper's "next position".
        Steps whose episode ends before are left out.
      mirror: adds the reflection of every sample; not in the paper.
      frame: "heading" turns every input so that the robot faces +x; not in the paper.
      fit: networks and losses.
    """

    share: float
    generalize: Generalize | None
    look_ahead: int
    mirror: bool
    frame: Frame
    fit: Fit

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, share=positive(1), look_ahead=count())


RL = Inverse(
    name="RL",
    agent=PPO(),
    task=WalkForward(),
    share=1.0,
    generalize=None,
    look_ahead=100,
    mirror=False,
    frame="world",
    fit=Fit(),
)
RS = dataclasses.replace(RL, name="RS", agent=RandomActions())
GE = dataclasses.replace(RL, name="GE", share=0.5, generalize=Generalize())
LR = dataclasses.replace(
    GE,
    name="LR",
    fit=Fit(idm=(50, 50), lfm=(256, 256), latent_size=10, latent_weight=0.75, averaged=False),
)
HF = dataclasses.replace(RL, name="HF", mirror=True, frame="heading")

VGCP = Direct(name="VGCP", agent=PPO(), task=GoToGoal())
HER_SP = Direct(name="HER_SP", agent=SAC(her=HER()), task=GoToGoal(reward=Sparse()))
HER_DE = Direct(name="HER_DE", agent=DDPG(her=HER()), task=GoToGoal(reward=Dense()))

Methods = tuple[Direct | Inverse, ...]

ANT: Methods = (RS, RL, VGCP, HER_SP, HER_DE, GE, LR, HF)
"""Table 1's rows for the Ant, and HF."""

EXTRA = ("HF",)
"""Methods that the paper does not have."""

ORDER = tuple(method.name for method in ANT)
"""Rows of the table, top to bottom; other names follow."""


# Of 0.0165 s a step: at 0.98 the agent would look 0.8 s ahead, and throw itself forwards.
_SAC = SAC(hidden=(256, 256), updates=64, discount=0.99, layer_norm=True)
_HER = dataclasses.replace(_SAC, hidden=(64, 64), her=HER())
_WALKER = Frozen(_SAC, share=1 / 3)
_LR_FIT = dataclasses.replace(LR.fit, idm=(256, 256), latent_size=50)

HUMANOID: Methods = (
    # Moved at random it lies down within 25 steps: farther ahead there is nothing to be seen.
    dataclasses.replace(RS, look_ahead=10),
    dataclasses.replace(RL, agent=_WALKER),
    dataclasses.replace(VGCP, agent=_SAC),
    dataclasses.replace(HER_SP, agent=_HER),
    dataclasses.replace(HER_DE, agent=_HER),
    dataclasses.replace(GE, agent=_WALKER),
    dataclasses.replace(LR, agent=_WALKER, fit=_LR_FIT),
    # The gait is not its own mirror image: fitted to both, HF falls (docs/choices.md).
    dataclasses.replace(HF, agent=_WALKER, mirror=False),
)
"""SAC learns for 5 M interactions, is frozen, and collects 10 M (A.1.2, Table 2)."""

# It stands by itself, so nothing is paid for noise, which would hide the gait (docs/choices.md).
_STROLLER = PPO(hidden=(256, 256), entropy=0.0)

MINITAUR: Methods = (
    RS,
    dataclasses.replace(RL, agent=_STROLLER),
    dataclasses.replace(VGCP, agent=_STROLLER),
    HER_SP,
    dataclasses.replace(HER_DE, agent=SAC(her=HER())),
    dataclasses.replace(GE, agent=_STROLLER),
    dataclasses.replace(LR, agent=_STROLLER),
    # This gait veers to one side: it is not its own mirror image, either.
    dataclasses.replace(HF, agent=_STROLLER, mirror=False),
)
"""PPO of 256×256 collects, and learns to go to goals (A.1.2, Table 2)."""

TABLES = {
    "ant": ANT,
    "humanoid": HUMANOID,
    "humanoid_world": HUMANOID,
    "minitaur": MINITAUR,
}
"""Robot → the methods of its column. A robot without one has the Ant's."""


def by_name(name: str, robot: str = "ant") -> Direct | Inverse:
    """The method of that name, with its settings for a robot.

    Raises:
      BadInput: there is none.
    """
    for method in TABLES.get(robot, ANT):
        if method.name == name:
            return method
    raise BadInput(f"no method is called {name!r}; there are: {', '.join(ORDER)}")


def literal(method: Inverse) -> Inverse:
    """The method to the paper's letter.

    h = 1, whole-episode replay (§5.2), λ = 0.25, φ fitted to mean latents (Eq. 6), and Adam
    at 1e-3 throughout (A.1.2).
    """
    return dataclasses.replace(
        method,
        name=f"{method.name} literal",
        look_ahead=1,
        generalize=method.generalize and dataclasses.replace(method.generalize, mode="episodes"),
        fit=dataclasses.replace(method.fit, latent_weight=0.25, averaged=True, decay=False),
    )
