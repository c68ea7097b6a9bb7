"""The paper's test (A.1.3): closest distance to the target in every scenario."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from genidm import checks, devices
from genidm.checks import check_value, count
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.evaluator import (
    ControllerFn,
    EpisodeResults,
    EvaluationSettings,
    Evaluator,
    Record,
    position,
)
from genidm.evaluation.scenarios import MOST_EPISODES, Scenarios
from genidm.progress import Progress
from genidm.robots.base import Robot
from genidm.store import Stage


def evaluate(
    robot: Robot,
    controller: ControllerFn,
    scenarios: Scenarios,
    settings: EvaluationSettings | None = None,
    *,
    mesh: Mesh | None = None,
    stage: Stage | None = None,
    quiet: bool = False,
) -> Episodes:
    """Run every scenario to its end (A.1.3).

    The controller computes a new action at each step (A.1.3: "we replan at each step").

    Args:
      robot: robot to control.
      controller: (s, relative goal) → a.
      scenarios: scenarios `[seeds, episodes]`.
      settings: length of an episode, goal radius, lanes.
      mesh: devices that share the lanes; None takes those of the robot's engine.
      stage: where to write checkpoints and metrics; None writes nothing.
      quiet: do not show a progress bar.
    """
    results, _ = run(
        robot, controller, flatten(scenarios), settings, mesh=mesh, stage=stage, quiet=quiet
    )
    return episodes(results, scenarios.shape)


def trace(
    robot: Robot,
    controller: ControllerFn,
    scenarios: Scenarios,
    settings: EvaluationSettings | None = None,
) -> tuple[Episodes, list[np.ndarray]]:
    """`evaluate`, and the trajectory `[steps + 1, 3]` of each episode in metres."""
    results, trajectories = run(
        robot, controller, flatten(scenarios), settings, traced=scenarios.yaw.size, quiet=True
    )
    return episodes(results, scenarios.shape), trajectories


def walking_speed(
    robot: Robot, policy: ControllerFn, episodes: int = 100, seed: int = 0
) -> np.ndarray:
    """Measure the speed of a policy towards +x, `[episodes]`, m/s.

    Each episode starts as in training and ends with a fall, or after 1000 steps.

    Raises:
      BadInput: `episodes` is not in [1, `MOST_EPISODES`], or the seed is not of 32 bits.
    """
    check_value("episodes", episodes, count(1, MOST_EPISODES))
    check_value("seed", seed, checks.seed())
    keys = jax.random.split(jax.random.key(seed), (1, episodes))
    # The target is out of reach, so the distance gained on it is the distance walked.
    target = jnp.broadcast_to(jnp.asarray([1e4, 0.0, 0.0], jnp.float32), (1, episodes, 3))
    results = evaluate(
        robot, policy, Scenarios(keys, jnp.zeros((1, episodes), jnp.float32), target)
    )
    return (results.start - results.closest)[0] / (results.steps[0] * robot.dt)


def run(
    robot: Robot,
    controller: ControllerFn,
    scenarios: Scenarios,
    settings: EvaluationSettings | None = None,
    *,
    traced: int = 0,
    record: Record = position,
    mesh: Mesh | None = None,
    stage: Stage | None = None,
    quiet: bool = False,
) -> tuple[EpisodeResults, list[Any]]:
    """`evaluate` on scenarios `[N]`, with traces of the first episodes.

    Args:
      robot: robot to control.
      controller: (s, relative goal) → a.
      scenarios: scenarios `[N]` (`flatten`).
      settings: length of an episode, goal radius, lanes.
      traced: number of the first episodes to trace.
      record: what a trace keeps of each state; by default the position.
      mesh: devices that share the lanes; None takes those of the robot's engine.
      stage: where to write checkpoints and metrics; None writes nothing.
      quiet: do not show a progress bar.

    Returns:
      results `[N]`, and the trace of each traced episode, a tree `[steps + 1, ...]`.
    """
    evaluator = Evaluator(
        robot, scenarios, settings or EvaluationSettings(), mesh or robot.mesh(), traced, record
    )
    state, calls = evaluator.start(), 0
    # A state is laid out for its devices and lanes: with others the test starts again.
    here = f"{evaluator.mesh.size}_devices_{state.running.episode.size}_lanes"
    checkpoints = stage.checkpoints(here) if stage else None
    found = checkpoints.latest(state) if checkpoints else None
    if found:
        calls, state = found[0], devices.put(found[1], evaluator.mesh)
    step = evaluator.prepare(controller, state)
    done = evaluator.ended(state)
    directory = stage.directory if stage else None
    with Progress("evaluate", evaluator.total, "episodes", directory, done, quiet) as bar:
        while done < evaluator.total:
            state, calls = step(state), calls + 1
            before, done = done, evaluator.ended(state)
            useful, longest = evaluator.useful(state, calls), evaluator.longest(state)
            bar.advance(done - before, useful=useful, longest=longest)
            if checkpoints and checkpoints.due():
                checkpoints.save(calls, state)
    return evaluator.results(state), evaluator.traces(state)


def flatten(*scenarios: Scenarios) -> Scenarios:
    """Concatenate scenarios `[seeds, episodes]` to scenarios `[N]`."""

    def join(*parts: Any) -> Any:
        return jnp.concatenate([x.reshape(-1, *x.shape[2:]) for x in parts])

    return jax.tree.map(join, *scenarios)


def episodes(results: EpisodeResults, shape: tuple[int, int]) -> Episodes:
    """Reshape results `[seeds × episodes]` to Episodes `[seeds, episodes]`."""
    names = [f.name for f in dataclasses.fields(EpisodeResults)]
    return Episodes(**{name: np.asarray(getattr(results, name)).reshape(shape) for name in names})
