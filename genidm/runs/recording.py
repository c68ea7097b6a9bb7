"""The stages of a run that collects: an agent that learns, and the record of its experience."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from genidm import controller, experience
from genidm.agents.base import Agent
from genidm.agents.collect import collect, whole
from genidm.agents.frozen import Acting, Frozen
from genidm.agents.policy import Policy
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.runs.run import M, Run
from genidm.store import Stage

# Module that makes a record, besides the agent's own.
COLLECT = "genidm.agents.collect"


@dataclasses.dataclass(frozen=True)
class CollectingRun(Run[M]):
    """A run in which an agent acts and learns."""

    def _learning(self, agent: Any, interactions: int) -> dict[str, Any]:
        """The config of a stage in which an agent collects or learns."""
        return {"agent": agent, "task": self.method.task, "interactions": interactions}

    def _collect(
        self, stage: Stage, agent: Agent, interactions: int, keep: bool = True
    ) -> tuple[Any, Policy | None]:
        """Runs an agent; returns its record (if `keep`) and its final policy, if it has one."""
        task = self.method.task
        record, learner = collect(
            self.robot, agent, interactions, self.seed, task=task, stage=stage, keep=keep
        )
        return record, agent.policy(self.robot, task, learner)


@dataclasses.dataclass(frozen=True)
class RecordingRun(CollectingRun[M]):
    """A run that keeps the experience of its agent; methods with the same agent share it."""

    @functools.cached_property
    def experience_stage(self) -> Stage:
        """The stage of the record; methods with the same agent share it."""
        agent = self.method.agent
        config = self._learning(agent, self.scale.interactions)
        return self._stage(
            f"experience-{type(agent).__name__}-{self.seed}", config, __name__, COLLECT
        )

    def experience(self) -> Experience:
        """The record E of the agent (§4.1); collected if its stage is not finished."""
        stage, made = self.experience_stage, list[Experience]()
        stage.run_once(lambda: self._collected(made))
        if made:
            return made[0]
        recorded = stage.summary()["recorded"]
        return stage.read(experience.load_chunks, "experience", self.robot, recorded)

    def _collected(self, made: list[Experience]) -> dict[str, Any]:
        """Collects, and appends the record to `made`, so that it is not read from disk again."""
        stage, (agent, before) = self.experience_stage, self._collector()
        record, policy = self._collect(stage, agent, self.scale.interactions - before)
        if policy:
            policy.save(stage.path("policy"), overwrite=True)
        made.append(record)
        recorded = record.interactions
        return {"interactions": before + recorded, "recorded": recorded}

    @functools.cached_property
    def agent_stage(self) -> Stage | None:
        """The stage of the policy that is frozen and then collects; None for other agents."""
        frozen = self.method.agent
        if not isinstance(frozen, Frozen):
            return None
        config = self._learning(frozen.agent, self._before(frozen))
        return self._stage(
            f"agent-{type(frozen.agent).__name__}-{self.seed}", config, __name__, COLLECT
        )

    def _before(self, frozen: Frozen) -> int:
        """Interactions after which the agent is frozen."""
        return whole(frozen.agent, round(frozen.fraction * self.scale.interactions))

    @property
    def policy_stage(self) -> Stage:
        """The stage in which the agent learns: the agent's own, or that of the record."""
        return self.agent_stage or self.experience_stage

    def policy(self) -> Policy:
        """The policy that the agent has learned; learned if its stage is not finished.

        Raises:
          BadInput: the agent does not learn.
        """
        stage = self.policy_stage
        if stage is self.agent_stage:
            stage.run_once(self._learned)
        elif not stage.done:
            self.experience()
        if not stage.path("policy").exists():
            raise BadInput(f"{type(self.method.agent).__name__} learns no policy")
        learned = stage.read(controller.load, "policy", self.robot)
        assert isinstance(learned, Policy)
        return learned

    def _learned(self) -> dict[str, Any]:
        """Trains the agent that is frozen afterwards."""
        frozen, stage = self.method.agent, self.policy_stage
        assert isinstance(frozen, Frozen)
        interactions = self._before(frozen)
        _, policy = self._collect(stage, frozen.agent, interactions, keep=False)
        assert policy  # every agent that can be frozen has a policy
        policy.save(stage.path("policy"), overwrite=True)
        return {"interactions": interactions}

    def _collector(self) -> tuple[Agent, int]:
        """The agent that collects, and the interactions in which it has learned before."""
        frozen = self.method.agent
        if not isinstance(frozen, Frozen):
            return frozen, 0
        return Acting(frozen.agent, self.policy()), self._before(frozen)
