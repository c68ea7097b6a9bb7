"""The paper's test (A.1.3): closest distance to the target, over scenarios."""

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
    """Runs every scenario to its end.

    The controller is asked anew at each step (A.1.3: "we replan at each step").

    Args:
      robot: what is steered.
      controller: what steers it.
      scenarios: scenarios `[seeds, episodes]`.
      settings: length of an episode, goal radius, lanes.
      mesh: devices to share the lanes among; as the robot's engine wants, unless given.
      stage: where checkpoints and metrics go; nowhere, unless given.
      quiet: no progress bar.
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
    """`evaluate`, and the trajectory `[steps + 1, 3]` of every episode, in the scenarios' order."""
    results, trajectories = run(
        robot, controller, flatten(scenarios), settings, traced=scenarios.yaw.size, quiet=True
    )
    return episodes(results, scenarios.shape), trajectories


def walking_speed(
    robot: Robot, policy: ControllerFn, episodes: int = 100, seed: int = 0
) -> np.ndarray:
    """Speed towards +x of a policy that learned to walk there, `[episodes]`, m/s.

    Each episode starts as in training and ends with a fall, or after 1000 steps.

    Raises:
      BadInput: there is no episode, or too many; or the seed has no 32 bits.
    """
    check_value("episodes", episodes, count(1, MOST_EPISODES))
    check_value("seed", seed, checks.seed())
    keys = jax.random.split(jax.random.key(seed), (1, episodes))
    # A target that is out of reach: what is gained on it is the way walked.
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
    """`evaluate` on scenarios `[N]`, the first of them traced.

    Args:
      robot: what is steered.
      controller: what steers it.
      scenarios: scenarios `[N]` (`flatten`).
      settings: length of an episode, goal radius, lanes.
      traced: how many of the first episodes to give the traces of.
      record: what a trace keeps of each state; the position, unless given.
      mesh: devices to share the lanes among; as the robot's engine wants, unless given.
      stage: where checkpoints and metrics go; nowhere, unless given.
      quiet: no progress bar.

    Returns:
      outcomes `[N]`, and for each traced episode a tree `[steps + 1, ...]` of what was kept.
    """
    evaluator = Evaluator(
        robot, scenarios, settings or EvaluationSettings(), mesh or robot.mesh(), traced, record
    )
    queue, calls = evaluator.start(), 0
    # Its queues belong to the devices: on others the test begins anew.
    here = f"{evaluator.mesh.size}_devices_{queue.running.episode.size}_lanes"
    checkpoints = stage.checkpoints(here) if stage else None
    found = checkpoints.latest(queue) if checkpoints else None
    if found:
        calls, queue = found[0], devices.put(found[1], evaluator.mesh)
    step = evaluator.prepare(controller, queue)
    done = evaluator.ended(queue)
    directory = stage.directory if stage else None
    with Progress("evaluate", evaluator.total, "episodes", directory, done, quiet) as bar:
        while done < evaluator.total:
            queue, calls = step(queue), calls + 1
            before, done = done, evaluator.ended(queue)
            useful, longest = evaluator.useful(queue, calls), evaluator.longest(queue)
            bar.advance(done - before, useful=useful, longest=longest)
            if checkpoints and checkpoints.due():
                checkpoints.save(calls, queue)
    return evaluator.results(queue), evaluator.traces(queue)


def flatten(*scenarios: Scenarios) -> Scenarios:
    """Scenarios `[seeds, episodes]` one after another, as scenarios `[N]`."""

    def join(*parts: Any) -> Any:
        return jnp.concatenate([x.reshape(-1, *x.shape[2:]) for x in parts])

    return jax.tree.map(join, *scenarios)


def episodes(results: EpisodeResults, shape: tuple[int, int]) -> Episodes:
    """Outcomes `[seeds × episodes]` as Episodes `[seeds, episodes]`."""
    names = [f.name for f in dataclasses.fields(EpisodeResults)]
    return Episodes(**{name: np.asarray(getattr(results, name)).reshape(shape) for name in names})
