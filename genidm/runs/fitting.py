"""The stages of a run that fits: 𝒢, and the controller that learns from the record."""

from __future__ import annotations

import abc
import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

import jax
from tqdm.auto import tqdm

from genidm import controller, files
from genidm.config import to_json
from genidm.controller import Controller
from genidm.evaluation.evaluate import ControllerFn
from genidm.experience import Experience
from genidm.paper.fit import fit
from genidm.paper.generalize import replay, residual
from genidm.paper.held_out import FILE, held_out_error
from genidm.paper.methods import FromRecord, InverseDynamics
from genidm.paper.pairs import Pairs, split_pairs
from genidm.paper.replaying import RotatedReplay
from genidm.runs.recording import RecordingRun
from genidm.store import Stage

R = TypeVar("R", bound=FromRecord)


class Saved(Protocol):
    """What a fit makes: a controller that `controller.load` reads."""

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Write the controller as a directory."""


@dataclasses.dataclass(frozen=True)
class FittingRun(RecordingRun[R]):
    """The run of a method that learns a controller from a record of experience.

    Attributes:
      repeat: number of an independent fit to the same record; 0 is the method's own fit.
      made_by: modules that make the controller.
    """

    repeat: int = 0
    made_by: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def fit(self, record: Experience) -> tuple[Saved, dict[str, Any]]:
        """Learns a controller from the method's part of the record, and from `replay` of it.

        Returns:
          the controller, and what the stage's summary says of it.
        """

    @functools.cached_property
    def replay_stage(self) -> Stage | None:
        """The stage of 𝒢(E); None for a method that learns from the record alone."""
        m = self.method
        if m.generalize is None:
            return None
        source = self.experience_stage.directory.name
        config = {"experience": source, "fraction": m.fraction, "skip": m.skip}
        config |= {"generalize": m.generalize}
        name = f"replay-{m.generalize.mode}-{self.seed}"
        return self._stage(name, config, __name__, "genidm.paper.generalize")

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
        return self._stage(label, config, __name__, *self.made_by)

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
        stage.run_once(self._fitted)
        return stage.read(controller.load, "controller", self.robot)

    def _fitted(self) -> dict[str, Any]:
        stage, m = self.controller_stage, self.method
        record = self.experience().part(m.fraction, m.skip).prepared(self.robot)
        model, found = self.fit(record)
        model.save(stage.path("controller"), overwrite=True)
        return {
            "robot": self.robot.name,
            "method": m.name,
            "experience": self.experience_stage.directory.name,
            "interactions": self._count(self.experience_stage, "interactions"),
            "learned_from": record.interactions,
            "replayed": self._count(self.replay_stage, "replayed"),
            "settings": to_json(m),
            **found,
        }

    def _count(self, stage: Stage | None, what: str) -> int:
        return stage.summary()[what] if stage else 0


@dataclasses.dataclass(frozen=True)
class InverseDynamicsRun(FittingRun[InverseDynamics]):
    """The run of a method that fits an inverse dynamics model to experience."""

    made_by: ClassVar[tuple[str, ...]] = ("genidm.paper.fit", "genidm.paper.held_out")

    def fit(self, record: Experience) -> tuple[Controller, dict[str, Any]]:
        m, stage = self.method, self.controller_stage
        samples, held_out = split_pairs(
            self.robot, record, self.replay(record),
            goal_horizon=m.goal_horizon, mirror=m.mirror, labels=m.labels,
            nearest_side=m.nearest_side,
        )  # fmt: skip
        model = fit(
            self.robot, samples, self.fit_key, m.fit, input_frame=m.input_frame, stage=stage
        ).replace(clip_bearing=m.clip_bearing, nearest_side=m.nearest_side)
        return model, {
            "bearings": to_json(model.bearings),
            "held_out": self._judged(model, samples, held_out),
        }

    def _judged(self, model: Controller, fitted: Pairs, held_out: Pairs) -> dict[str, Any] | None:
        """Writes and prints the error of a fit on held-out samples; returns its totals."""
        if not len(held_out.a):
            return None
        found = held_out_error(self.robot, model, held_out, fitted)
        files.save_json(self.controller_stage.path(FILE), found)
        tqdm.write(f"{self.method.name}: {found}", file=sys.stderr)
        return found.totals
