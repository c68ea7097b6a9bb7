"""The run of an offline goal-conditioned baseline, on the records of the paper's methods."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from genidm.experience import Experience
from genidm.offline.data import dataset
from genidm.offline.methods import OfflineGoalConditioned
from genidm.offline.policy import GoalPolicy
from genidm.offline.train import train
from genidm.runs.fitting import FittingRun


@dataclasses.dataclass(frozen=True)
class OfflineRun(FittingRun[OfflineGoalConditioned]):
    """The run of a method that trains an offline learner on experience.

    Its record and its 𝒢 are stages that it shares with the paper's methods.
    """

    made_by: ClassVar[tuple[str, ...]] = ("genidm.offline.train", "genidm.offline.data")

    def fit(self, record: Experience) -> tuple[GoalPolicy, dict[str, Any]]:
        data = dataset(self.robot, record, self.replay(record))
        policy = train(data, self.fit_key, self.method.learner, stage=self.controller_stage)
        return policy, {"longest_goal": float(policy.longest_goal)}
