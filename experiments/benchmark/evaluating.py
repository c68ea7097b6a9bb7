"""Rows of evaluation: its speed, and the share of useful lane-steps."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
from mujoco.batch import Batch

from experiments.benchmark.bench import Bench
from experiments.benchmark.collecting import record
from experiments.benchmark.measuring import Probe, carried, timed
from experiments.benchmark.stepping import STEPS, among, place, step_batch, walk
from genidm import devices
from genidm.controller import load
from genidm.engines.mujoco import MuJoCo
from genidm.evaluation.evaluate import ControllerFn, EvaluationSettings, evaluate, flatten
from genidm.evaluation.evaluator import EvaluationState, Evaluator
from genidm.evaluation.scenarios import Scenarios, scenarios
from genidm.paper.fit import fit
from genidm.paper.generalize import rotate_exactly
from genidm.paper.methods import LR
from genidm.paper.pairs import pairs
from genidm.progress import METRICS, read_metrics
from genidm.robots import State
from genidm.robots.mujoco import MujocoRobot
from genidm.rollout import Move, rollout
from genidm.store import Stage

# Steps before the measured ones, so that the robots walk already.
WARM_UP = 100


def controller(bench: Bench) -> ControllerFn:
    """The controller of `options.run`, or an untrained controller."""
    if bench.options.run:
        return load(bench.options.run, bench.robot)
    turned = rotate_exactly(bench.robot, bench.once(record), jax.random.key(1))
    # Horizon 1: in a short record, all episodes may end before a longer one.
    samples = pairs(bench.robot, bench.once(record), turned, goal_horizon=1)
    settings = dataclasses.replace(LR.fit, updates=1)
    return fit(bench.robot, samples, jax.random.key(2), settings, quiet=True)


def evaluating(bench: Bench) -> Probe:
    """`evaluate` with scenarios; lane-steps without an episode count too."""
    settings, test_scenarios = _test(bench)
    evaluator = Evaluator(bench.robot, flatten(test_scenarios), settings, bench.mesh)
    queue = evaluator.start()
    program = evaluator.prepare(bench.once(controller), queue)

    def step(queue: EvaluationState) -> EvaluationState:
        queue = program(queue)
        return evaluator.start() if evaluator.ended(queue) == evaluator.total else queue

    lanes = queue.running.episode.shape[0]
    call = timed(carried(step, queue), lanes * settings.chunk)
    return Probe(call, f"{lanes} lanes, {_steering(bench)}")


def _steered(bench: Bench) -> tuple[State, jax.Array]:
    """States `[B]` in mid-episode, and the controller's next actions `[STEPS, B, A]`."""
    robot, model = bench.robot, bench.once(controller)
    starts = scenarios(robot, 1, bench.options.wide)
    keys, yaw, target = starts.keys[0], starts.yaw[0], starts.target[0]

    def act(state: State, _: None) -> tuple[State, jax.Array, None]:
        return state, model(state.observation, target - state.position), None

    def watch(_: State, move: Move) -> tuple[State, jax.Array]:
        return move.after, move.action

    @functools.partial(jax.jit, static_argnums=1)
    def steer(state: State, steps: int) -> tuple[State, jax.Array]:
        return rollout(robot, act, watch, state, steps=steps)

    middle, _ = steer(jax.jit(robot.reset)(keys, yaw), WARM_UP)
    return middle, steer(middle, STEPS)[1]


def retracing(bench: Bench) -> Probe:
    """The limit of `evaluating`: the engine alone repeats recorded steps of the test.

    Robots with a controller are slower to step than robots with random actions, because more
    feet are on the ground.
    """
    robot, (state, actions) = bench.robot, bench.once(_steered)
    lanes = actions.shape[1]
    if isinstance(robot, MujocoRobot) and isinstance(robot.engine, MuJoCo):
        simulations = Batch(robot.mj_model, lanes, nthread=robot.engine.threads)
        given = np.asarray(actions, np.float64)

        def call() -> None:
            place(simulations, state.physics)
            step_batch(robot, simulations, given)

    else:
        mesh = bench.mesh
        program = jax.jit(devices.over_lanes(functools.partial(walk, robot), mesh, [0, 1], 0))
        there = devices.put(state, mesh), devices.put(actions, mesh, 1)

        def call() -> None:
            jax.block_until_ready(program(*there))

    note = f"{lanes} lanes, {among(robot, bench.mesh)}, {_steering(bench)}"
    return Probe(timed(call, lanes * STEPS), note)


def lane_steps(bench: Bench) -> tuple[float, float]:
    """Lane-steps of evaluating the scenarios: all, and those within episodes."""
    stage = Stage(bench.scratch / "test")
    settings, test_scenarios = _test(bench)
    model = bench.once(controller)
    outcome = evaluate(bench.robot, model, test_scenarios, settings, mesh=bench.mesh, stage=stage)
    useful = float(outcome.steps.sum())
    return useful / read_metrics(stage.path(METRICS))[-1]["useful"], useful


def tested(bench: Bench, *, useful: bool) -> Probe:
    """Lane-steps of evaluating all scenarios: those within episodes if `useful`, else all."""
    seeds, episodes = bench.options.scenarios
    steps = bench.once(lane_steps)
    mean = steps[1] / (seeds * episodes)
    test = f"{seeds} × {episodes} episodes of {mean:.0f} steps, {_steering(bench)}"
    return Probe(lambda _: steps[useful], test)


def _test(bench: Bench) -> tuple[EvaluationSettings, Scenarios]:
    return EvaluationSettings(num_envs=bench.options.wide), scenarios(
        bench.robot, *bench.options.scenarios
    )


def _steering(bench: Bench) -> str:
    """The controller, in words."""
    return Path(bench.options.run).name if bench.options.run else "an untrained controller"
