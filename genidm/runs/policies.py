"""The stages of runs whose controller is the policy of an agent, not a fit."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from genidm import controller
from genidm.agents.collect import whole
from genidm.config import to_json
from genidm.evaluation.evaluate import ControllerFn
from genidm.paper.methods import AgentTurned, GoalConditioned
from genidm.runs.recording import COLLECT, CollectingRun, RecordingRun
from genidm.store import Stage


@dataclasses.dataclass(frozen=True)
class GoalConditionedRun(CollectingRun[GoalConditioned]):
    """The run of a method whose agent learns to reach goals; its policy is the controller."""

    @functools.cached_property
    def controller_stage(self) -> Stage:
        config = self._learning(self.method.agent, self.scale.interactions)
        return self._stage(self._label, config | {"name": self.method.name}, __name__, COLLECT)

    @property
    def sources(self) -> list[Stage]:
        return [self.controller_stage]

    def controller(self) -> ControllerFn:
        """The agent's final policy; learned if its stage is not finished."""
        stage = self.controller_stage
        stage.run_once(self._learned)
        return stage.read(controller.load, "controller", self.robot)

    def _learned(self) -> dict[str, Any]:
        stage, m = self.controller_stage, self.method
        _, policy = self._collect(stage, m.agent, self.scale.interactions, keep=False)
        assert policy  # the agent of every GoalConditioned method learns one
        policy.save(stage.path("controller"), overwrite=True)
        interactions = whole(m.agent, self.scale.interactions)
        return {
            "robot": self.robot.name,
            "method": m.name,
            "interactions": interactions,
            "learned_from": interactions,
            "replayed": 0,
            "settings": to_json(m),
        }


@dataclasses.dataclass(frozen=True)
class AgentTurnedRun(RecordingRun[AgentTurned]):
    """The run of the agent itself: its policy, in a world turned so that +x points at the goal."""

    @functools.cached_property
    def controller_stage(self) -> Stage:
        config = {"source": self.policy_stage.directory.name, "name": self.method.name}
        return self._stage(self._label, config, __name__, "genidm.agents.policy")

    @property
    def sources(self) -> list[Stage]:
        return [self.policy_stage, self.controller_stage]

    def controller(self) -> ControllerFn:
        """The turned policy; learned if its stage is not finished."""
        stage = self.controller_stage
        stage.run_once(self._turned)
        return stage.read(controller.load, "controller", self.robot)

    def _turned(self) -> dict[str, Any]:
        self.policy().replace(faces_goal=True).save(
            self.controller_stage.path("controller"), overwrite=True
        )
        interactions = self.policy_stage.summary()["interactions"]
        return {
            "robot": self.robot.name,
            "method": self.method.name,
            "interactions": interactions,
            "learned_from": interactions,
            "replayed": 0,
            "settings": to_json(self.method),
        }
