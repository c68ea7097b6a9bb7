"""The stages of a run (one cell of Table 1); a finished stage is skipped.

    [agent ──▶] experience ──▶ replay (𝒢) ──▶ controller ──▶ test        FromRecord methods
                                              policy ──────▶ test        GoalConditioned methods

The name of a stage's directory contains a hash of all settings that the stage depends on:
methods with equal settings share a stage, and a killed run resumes.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import jax
import numpy as np

from genidm import controller, experience, files
from genidm.agents.base import Agent
from genidm.agents.collect import collect, whole
from genidm.agents.frozen import Acting, Frozen
from genidm.agents.policy import Policy
from genidm.config import to_json
from genidm.controller import Controller
from genidm.errors import BadInput
from genidm.evaluation import sanity
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.evaluate import ControllerFn, EvaluationSettings, episodes, flatten, run
from genidm.evaluation.scenarios import Scenarios, fig8_scenarios
from genidm.experience import Experience
from genidm.paper.fit import fit
from genidm.paper.generalize import replay, residual
from genidm.paper.methods import FromRecord, GoalConditioned, InverseDynamics, Method
from genidm.paper.pairs import pairs
from genidm.paper.replaying import RotatedReplay
from genidm.provenance import code_of
from genidm.robots import Robot, State
from genidm.runs.scale import Scale
from genidm.store import Stage

M = TypeVar("M", bound=Method)
R = TypeVar("R", bound=FromRecord)

# Test episodes that are recorded for rendering.
RECORDED_EPISODES = 3
# Module that makes a record, besides the agent's own.
COLLECT = "genidm.agents.collect"
# Modules of the test, besides the robot and its engine.
TEST = (
    *("genidm.evaluation.evaluate", "genidm.evaluation.scenarios", "genidm.evaluation.sanity"),
    "genidm.controller",
)


class SavedController(Protocol):
    """What a fit makes: a controller that `controller.load` reads."""

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Write the controller as a directory."""


class Trace(NamedTuple):
    """The part of states `[B]` that is needed to plot and render an episode."""

    position: jax.Array
    physics: Any


def position_and_physics(state: State) -> Trace:
    """Keeps o and the physics state."""
    return Trace(state.position, state.physics)


@dataclasses.dataclass(frozen=True)
class Run(abc.ABC, Generic[M]):
    """One method on one robot with one training seed, as a series of stages.

    Attributes:
      robot: the robot.
      method: the method.
      scale: how much of the paper's protocol to do.
      seed: training seed; the test seeds are fixed.
      root: directory that contains the stages.
      test: settings of the test.
      notes: where settings come from (`resolve.who_set_what`), stored with the test.
      other_code: use finished stages that other code made.
    """

    robot: Robot
    method: M
    scale: Scale
    seed: int
    root: Path
    test: EvaluationSettings
    notes: tuple[str, ...] = ()
    other_code: bool = False

    @property
    @abc.abstractmethod
    def controller_stage(self) -> Stage:
        """The stage that makes the controller."""

    @abc.abstractmethod
    def controller(self) -> ControllerFn:
        """The controller of the test; made if its stage is not finished."""

    @property
    def config(self) -> dict[str, Any]:
        """All settings of the run.

        Returns:
          robot, method, scale, seed, test and notes, not yet converted to JSON.
        """
        names = ("method", "scale", "seed", "test", "notes")
        return {"robot": self.robot.settings} | {name: getattr(self, name) for name in names}

    @property
    @abc.abstractmethod
    def sources(self) -> list[Stage]:
        """The stages that lead to the controller; the controller's own is the last."""

    def _stage(self, name: str, config: dict[str, Any], *code: Any) -> Stage:
        """The stage of a config; it depends on this module, the robot, its engine and `code`."""
        # This module imports all stages; a stage depends only on the code of its own.
        made_by = code_of(self.robot, self.robot.engine, config, *code, alone=[__name__])
        config = {"robot": self.robot.settings, "seed": self.seed} | config
        return Stage.open(self.root, name, config, made_by, self.other_code)

    @property
    def _label(self) -> str:
        return f"{self.method.name.replace(' ', '-')}-{self.seed}"

    def _key(self, stage: int) -> jax.Array:
        return jax.random.fold_in(jax.random.key(self.seed), stage)

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

    def test_stage(self, scenarios: Scenarios, kind: str = "test") -> Stage:
        """The stage of the test on some scenarios.

        Args:
          scenarios: the scenarios.
          kind: first word of the stage's name. Only tests of kind "test" become rows of the
            report's table.
        """
        source = self.controller_stage.directory.name
        config = {"fit": source, "scenarios": scenarios.digest(), "test": self.test}
        return self._stage(f"{kind}-{self._label}", config, *TEST)

    def run_test(self, scenarios: Scenarios, kind: str = "test") -> Stage:
        """Runs the test (A.1.3) and the episodes of Fig. 8; returns the finished `test_stage`."""
        stage = self.test_stage(scenarios, kind)
        stage.run_once(lambda: self._tested(stage, scenarios))
        return stage

    def _tested(self, stage: Stage, scenarios: Scenarios) -> dict[str, Any]:
        model, fig8 = self.controller(), fig8_scenarios(self.robot)
        first = fig8.yaw.size
        outcome, traces = run(
            self.robot,
            model,
            flatten(fig8, scenarios),
            self.test,
            traced=first + min(RECORDED_EPISODES, scenarios.shape[1]),
            record=position_and_physics,
            stage=stage,
        )
        tested = jax.tree.map(lambda x: np.asarray(x)[first:], outcome)
        trajectories = [trace.position for trace in traces[:first]]
        recordings = self._recordings(traces[first:], scenarios.target[0])
        outcomes = episodes(tested, scenarios.shape)
        save_test(stage, outcomes, trajectories, recordings)
        return (
            self.controller_stage.summary()
            | sanity.walked(self.method.name, outcomes)
            | sanity.heeds(self.method.name, trajectories, np.asarray(fig8.target))
            | {"seed": self.seed, "scale": self.scale.name, "scenarios": scenarios.digest()}
            | {"engine": self.robot.engine_name}
            | {"test": to_json(self.test), "fit": self.controller_stage.directory.name}
            | {"stages": [source.directory.name for source in self.sources], "run": self.config}
        )

    def _recordings(self, traces: list[Trace], target: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Recordings for `genidm.video`; an empty list if the robot has no visual model."""
        try:
            poses = [self.robot.visual_qpos(trace.physics) for trace in traces]
        except BadInput:
            return []
        return [
            {"qpos": qpos, "position": np.asarray(trace.position), "target": np.asarray(at)}
            for qpos, trace, at in zip(poses, traces, target, strict=False)
        ]


@dataclasses.dataclass(frozen=True)
class RecordRun(Run[R]):
    """The run of a method that learns a controller from a record of experience.

    Attributes:
      repeat: number of an independent fit to the same record; 0 is the method's own fit.
      made_by: modules that make the controller.
    """

    repeat: int = 0
    made_by: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def fitted(self, record: Experience) -> SavedController:
        """The controller that learns from `record`, with the `replay` of it."""

    @functools.cached_property
    def experience_stage(self) -> Stage:
        """The stage of the record; methods with the same agent share it."""
        agent = self.method.agent
        config = self._learning(agent, self.scale.interactions)
        return self._stage(f"experience-{type(agent).__name__}-{self.seed}", config, COLLECT)

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
        return self._stage(f"agent-{type(frozen.agent).__name__}-{self.seed}", config, COLLECT)

    def _before(self, frozen: Frozen) -> int:
        """Interactions after which the agent is frozen."""
        return whole(frozen.agent, round(frozen.fraction * self.scale.interactions))

    def _collector(self) -> tuple[Agent, int]:
        """The agent that collects, and the interactions in which it has learned before."""
        frozen, stage = self.method.agent, self.agent_stage
        if not isinstance(frozen, Frozen):
            return frozen, 0
        assert stage
        interactions = self._before(frozen)

        def work() -> dict[str, Any]:
            _, policy = self._collect(stage, frozen.agent, interactions, keep=False)
            assert policy  # every agent that can be frozen has a policy
            policy.save(stage.path("policy"), overwrite=True)
            return {"interactions": interactions}

        stage.run_once(work)
        learned = stage.read(controller.load, "policy", self.robot)
        assert isinstance(learned, Policy)
        return Acting(frozen.agent, learned), interactions

    @functools.cached_property
    def replay_stage(self) -> Stage | None:
        """The stage of 𝒢(E); None for a method that learns from the record alone."""
        m = self.method
        if m.generalize is None:
            return None
        source = self.experience_stage.directory.name
        config = {"experience": source, "fraction": m.fraction, "generalize": m.generalize}
        name = f"replay-{m.generalize.mode}-{self.seed}"
        return self._stage(name, config, "genidm.paper.generalize")

    def replay(self, record: Experience) -> RotatedReplay | None:
        """𝒢(E) (Def. 4) of `record`, the part that the method learns from; None without 𝒢."""
        stage = self.replay_stage
        if stage is None:
            return None

        def work() -> dict[str, Any]:
            replayed = replay(self.robot, record, self._key(1), self.method.generalize)
            replayed.save(stage.path("replay"))
            errors = residual(record, replayed)
            files.save_arrays(stage.path("residual"), errors, {}, overwrite=True)
            return {"replayed": replayed.yaw.size}

        stage.run_once(work)
        return stage.read(RotatedReplay.load, "replay")

    @functools.cached_property
    def controller_stage(self) -> Stage:
        """The stage of the fitted controller."""
        source = self.replay_stage or self.experience_stage
        # All fields but those that the source stages contain, so that a new field counts too.
        config = {f.name: getattr(self.method, f.name) for f in dataclasses.fields(self.method)}
        for upstream in ("agent", "task"):
            del config[upstream]
        config = {"source": source.directory.name, "repeat": self.repeat} | config
        label = f"{self._label}-fit{self.repeat}" if self.repeat else self._label
        return self._stage(label, config, *self.made_by)

    @property
    def sources(self) -> list[Stage]:
        stages = (self.agent_stage, self.experience_stage, self.replay_stage, self.controller_stage)
        return [stage for stage in stages if stage]

    @property
    def fit_key(self) -> jax.Array:
        """Random key of the fit."""
        key = self._key(2)
        return jax.random.fold_in(key, self.repeat) if self.repeat else key

    def controller(self) -> ControllerFn:
        """The fitted controller; fitted if its stage is not finished."""
        stage = self.controller_stage
        stage.run_once(self._fit)
        return stage.read(controller.load, "controller", self.robot)

    def _fit(self) -> dict[str, Any]:
        stage, m = self.controller_stage, self.method
        record = self.experience().first_fraction(m.fraction).prepared(self.robot)
        self.fitted(record).save(stage.path("controller"), overwrite=True)
        return {
            "robot": self.robot.name,
            "method": m.name,
            "experience": self.experience_stage.directory.name,
            "interactions": self._count(self.experience_stage, "interactions"),
            "learned_from": record.interactions,
            "replayed": self._count(self.replay_stage, "replayed"),
            "settings": to_json(m),
        }

    def _count(self, stage: Stage | None, what: str) -> int:
        return stage.summary()[what] if stage else 0


@dataclasses.dataclass(frozen=True)
class InverseDynamicsRun(RecordRun[InverseDynamics]):
    """The run of a method that fits an inverse dynamics model to experience."""

    made_by: ClassVar[tuple[str, ...]] = ("genidm.paper.fit", "genidm.paper.pairs")

    def fitted(self, record: Experience) -> Controller:
        m, stage = self.method, self.controller_stage
        samples = pairs(
            self.robot, record, self.replay(record), goal_horizon=m.goal_horizon, mirror=m.mirror
        )
        return fit(self.robot, samples, self.fit_key, m.fit, input_frame=m.input_frame, stage=stage)


@dataclasses.dataclass(frozen=True)
class GoalConditionedRun(Run[GoalConditioned]):
    """The run of a method whose agent learns to reach goals; its policy is the controller."""

    @functools.cached_property
    def controller_stage(self) -> Stage:
        config = self._learning(self.method.agent, self.scale.interactions)
        return self._stage(self._label, config | {"name": self.method.name}, COLLECT)

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


def save_test(
    stage: Stage,
    outcome: Episodes,
    trajectories: list[np.ndarray],
    recordings: Sequence[dict[str, np.ndarray]] = (),
) -> None:
    """Writes the results of a test to `episodes` in its stage.

    Args:
      stage: stage of the test.
      outcome: results of the episodes.
      trajectories: positions in the episodes of Fig. 8, `[steps + 1, 3]` each, metres.
      recordings: the first episodes: qpos `[steps + 1, nq]` of the robot's visual model,
        position `[steps + 1, 3]` and target `[3]`, metres.
    """
    tree = {
        "episodes": dataclasses.asdict(outcome),
        "trajectories": {str(i): w for i, w in enumerate(trajectories)},
        "recordings": {str(i): recording for i, recording in enumerate(recordings)},
    }
    files.save_arrays(stage.path("episodes"), tree, {}, overwrite=True)
