"""The methods of Table 1, as data: what each is made of (Table 2), and nothing else.

An experiment runs the stages that a method names. To try something new, copy a method
with `dataclasses.replace` and change one thing.
"""

from __future__ import annotations

import dataclasses

from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.controller import Frame
from genidm.errors import BadInput
from genidm.fit import Fit
from genidm.generalize import Generalize
from genidm.tasks import WalkForward


@dataclasses.dataclass(frozen=True)
class Method:
    """A way from experience to a controller.

    Attributes:
      name: as it stands in the table.
      agent: what collects the experience.
      task: what the agent is rewarded for meanwhile.
      share: the part of the record, from its start, that is learned from. The paper's GE
        and LR make the other half with 𝒢 (A.1.2).
      generalize: settings of 𝒢; None learns from the record alone.
      look_ahead: h, steps to the intermediate goal o'; 1 is the paper's "next position".
        Steps whose episode ends before are left out.
      mirror: adds the reflection of every sample; not in the paper.
      frame: "heading" turns every input so that the robot faces +x; not in the paper.
      fit: networks and losses.
    """

    name: str
    agent: PPO | RandomActions
    task: WalkForward
    share: float
    generalize: Generalize | None
    look_ahead: int
    mirror: bool
    frame: Frame
    fit: Fit

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise BadInput(f"share must lie in (0, 1], not at {self.share}")
        if self.look_ahead < 1:
            raise BadInput(f"look_ahead must be at least 1, not {self.look_ahead}")


RL = Method(
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

ORDER = ("RS", "RL", "VGCP", "HER_SP", "HER_DE", "GE", "LR", "HF")
"""Rows of the table, top to bottom; other names follow."""


def literal(method: Method) -> Method:
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
