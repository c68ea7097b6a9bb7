"""The data of a report's figures, computed once from the stages of its methods."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from genidm import controller, experience, files, symmetry
from genidm.errors import BadInput
from genidm.evaluation import stats
from genidm.evaluation.invariance import ANGLES, invariance, probes
from genidm.evaluation.scenarios import FIG8_EPISODES, UNSEEN_YAW, Scenarios, fig8_scenarios
from genidm.progress import METRICS, read_metrics
from genidm.report.figures import Panel
from genidm.report.runs import Runs
from genidm.robots import Robot

Curves = dict[str, list[dict[str, Any]]]


@dataclasses.dataclass(frozen=True)
class Shown:
    """The data of the figures.

    Attributes:
      closest: method → closest distance `[seeds, episodes]`, metres; NaN for diverged episodes.
      heading: initial heading of the robot `[seeds, episodes]`, radians.
      bearing: bearing of the target from that heading `[seeds, episodes]`, radians.
      panels: trajectories of Fig. 8.
      collecting: agent → metrics during collecting.
      learning: method → metrics while its agent learned to reach goals.
      fitting: method → metrics of its fit.
      held_out: method → the held-out error of its fit (`genidm.paper.held_out.HeldOut`).
      residuals: mode of 𝒢 → its residual (`genidm.paper.generalize.residual`).
      changes: method → change of its actions `[angles, states]` at `ANGLES`; empty if there is
        no record to sample states from.
    """

    closest: dict[str, np.ndarray]
    heading: np.ndarray
    bearing: np.ndarray
    panels: list[Panel]
    collecting: Curves
    learning: Curves
    fitting: Curves
    held_out: dict[str, dict[str, Any]]
    residuals: dict[str, dict[str, np.ndarray]]
    changes: dict[str, np.ndarray]

    def invariance(self, name: str) -> float | None:
        """Mean change of a method's action over states and angles above 0; None if unknown."""
        change = self.changes.get(name)
        return None if change is None else float(change[ANGLES > 0].mean())


def gather(runs: Runs) -> Shown:
    """Collects the data of all figures of a report."""
    heading, bearing = angles(runs.robot, runs.scenarios)
    learned = {name: _metrics(tests[0].controller.parent) for name, tests in runs.found.items()}
    return Shown(
        closest={name: stats.masked(tests[0].episodes) for name, tests in runs.found.items()},
        heading=heading,
        bearing=bearing,
        panels=_panels(runs),
        collecting=_collecting(runs),
        learning={name: records for name, records in learned.items() if _holds(records, "reached")},
        fitting={
            name: records for name, records in learned.items() if _holds(records, "loss_action")
        },
        held_out={
            name: found for name, tests in runs.found.items() if (found := tests[0].held_out)
        },
        residuals=_residuals(runs),
        changes=_changes(runs),
    )


def _panels(runs: Runs) -> list[Panel]:
    """Trajectories of Fig. 8, from an initial heading of training and from an unseen heading."""
    target = np.asarray(fig8_scenarios(runs.robot).target)
    trajectories = {
        name: [path[:, :2] for path in tests[0].trajectories] for name, tests in runs.found.items()
    }
    return [
        (
            "as learned",
            {n: w[:FIG8_EPISODES] for n, w in trajectories.items()},
            target[0, :, :2],
            0.0,
        ),
        (
            "turned 135°",
            {n: w[FIG8_EPISODES:] for n, w in trajectories.items()},
            target[1, :, :2],
            UNSEEN_YAW,
        ),
    ]


def angles(robot: Robot, scenarios: Scenarios) -> tuple[np.ndarray, np.ndarray]:
    """Initial heading and the target's bearing from it, each `[seeds, episodes]`, radians."""

    def angles(keys: jax.Array, yaw: jax.Array, target: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = robot.reset(keys, yaw)
        goal = target - state.position
        bearing = jax.numpy.arctan2(goal[:, 1], goal[:, 0]) - state.heading
        return state.heading, symmetry.wrap(bearing)

    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), scenarios)
    out = jax.jit(angles)(flat.keys, flat.yaw, flat.target)
    heading, bearing = (np.asarray(x).reshape(scenarios.shape) for x in out)
    return heading, bearing


def _collecting(runs: Runs) -> Curves:
    curves = {}
    for stage in runs.records:
        _, agent, seed, _ = stage.name.split("-")
        curves[f"{agent}, seed {seed}"] = _metrics(stage)
    return curves


def _residuals(runs: Runs) -> dict[str, dict[str, np.ndarray]]:
    """Residuals of the replays of the rows' records; of several with one mode, the last by name."""
    records = {stage.name for stage in runs.records}
    found = {}
    for path in sorted(runs.root.glob("replay-*/done.json")):
        stage = path.parent
        with contextlib.suppress(BadInput, KeyError, TypeError):  # of another program, or corrupt
            config = files.load_json(stage / "config.json")["config"]
            if config["experience"] in records:
                mode = config["generalize"]["mode"]
                found[mode] = files.load_arrays(stage / "residual")[0]
    return found


def _changes(runs: Runs) -> dict[str, np.ndarray]:
    """Method → change of its actions `[angles, states]`, in the states of one record."""
    chunk = runs.last_chunk()
    if chunk is None:
        return {}
    states = probes(runs.robot, experience.load(chunk, runs.robot))
    paths = {name: tests[0].controller for name, tests in runs.found.items()}
    return {
        name: invariance(runs.robot, controller.load(path, runs.robot), *states, ANGLES)
        for name, path in paths.items()
        if path.exists()
    }


def _metrics(stage: Path) -> list[dict[str, Any]]:
    path = stage / METRICS
    return read_metrics(path) if path.exists() else []


def _holds(records: list[dict[str, Any]], metric: str) -> bool:
    return any(metric in record for record in records)
