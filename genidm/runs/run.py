"""The stages of a run (one cell of Table 1), and its test; a finished stage is skipped.

    [agent ──▶] experience ──▶ replay (𝒢) ──▶ controller ──▶ test        InverseDynamics methods
                experience ──────────────────▶ policy ──────▶ test        AgentTurned
                                              policy ──────▶ test        GoalConditioned methods

The name of a stage's directory contains a hash of all settings that the stage depends on:
methods with equal settings share a stage, and a killed run resumes. The stages before the test
are in `recording` (agent, experience), `fitting` (replay, controller) and `goals` (policy).
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import numpy as np

from genidm import files
from genidm.config import to_json
from genidm.errors import BadInput
from genidm.evaluation import sanity
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.evaluate import ControllerFn, EvaluationSettings, episodes, flatten, run
from genidm.evaluation.scenarios import Scenarios, fig8_scenarios
from genidm.paper.methods import Method
from genidm.provenance import code_of
from genidm.robots import Robot, State
from genidm.runs.scale import Scale
from genidm.store import Stage

M = TypeVar("M", bound=Method)

# Test episodes that are recorded for rendering.
RECORDED_EPISODES = 3
# Modules of the test, besides the robot and its engine.
TEST = (
    *("genidm.evaluation.evaluate", "genidm.evaluation.scenarios", "genidm.evaluation.sanity"),
    "genidm.controller",
)


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

    def _stage(self, name: str, config: dict[str, Any], module: str, *code: Any) -> Stage:
        """The stage of a config.

        Args:
          name: first part of the directory's name.
          config: the settings that the stage depends on, besides robot and seed.
          module: the module that defines the stage. It imports more than the stage needs, so only
            its own code counts.
          code: other code that the stage depends on, besides robot, engine and `config`.
        """
        made_by = code_of(self.robot, self.robot.engine, config, *code, alone=[module])
        config = {"robot": self.robot.settings, "seed": self.seed} | config
        return Stage.open(self.root, name, config, made_by, self.other_code)

    @property
    def _label(self) -> str:
        return f"{self.method.name.replace(' ', '-')}-{self.seed}"

    def _key(self, stage: int) -> jax.Array:
        return jax.random.fold_in(jax.random.key(self.seed), stage)

    def test_stage(self, scenarios: Scenarios, kind: str = "test") -> Stage:
        """The stage of the test on some scenarios.

        Args:
          scenarios: the scenarios.
          kind: first word of the stage's name. Only tests of kind "test" become rows of the
            report's table.
        """
        source = self.controller_stage.directory.name
        config = {"fit": source, "scenarios": scenarios.digest(), "test": self.test}
        return self._stage(f"{kind}-{self._label}", config, __name__, *TEST)

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
