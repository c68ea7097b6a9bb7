"""Evaluation: how fast lanes step, and how many of their steps are of use."""

from __future__ import annotations

import dataclasses

import jax

from experiments.benchmark.bench import Bench
from experiments.benchmark.collecting import record
from experiments.benchmark.measuring import Probe, carried, timed
from genidm.controller import load
from genidm.evaluate import Queue, Steering, Test, Testing, evaluate, flatten
from genidm.fit import fit
from genidm.generalize import rotate
from genidm.methods import LR
from genidm.pairs import pairs
from genidm.progress import METRICS, read_metrics
from genidm.scenarios import Scenarios, scenarios
from genidm.store import Stage


def controller(bench: Bench) -> Steering:
    """That of the run, or an untrained one."""
    if bench.options.run:
        return load(bench.options.run / "controller", bench.robot)
    turned = rotate(bench.robot, bench.once(record), jax.random.key(1))
    # To the next step, as the episodes of a short record may all end before more.
    samples = pairs(bench.robot, bench.once(record), turned, look_ahead=1)
    settings = dataclasses.replace(LR.fit, updates=1)
    return fit(bench.robot, samples, jax.random.key(2), settings, quiet=True)


def evaluating(bench: Bench) -> Probe:
    """What `evaluate` does with a bank; lane-steps without an episode count too."""
    settings, bank = _test(bench)
    testing = Testing(bench.robot, flatten(bank), settings, bench.mesh)
    queue = testing.start()
    program = testing.prepare(bench.once(controller), queue)

    def step(queue: Queue) -> Queue:
        queue = program(queue)
        return testing.start() if testing.ended(queue) == testing.total else queue

    lanes = queue.running.episode.shape[0]
    call = timed(carried(step, queue), lanes * settings.chunk)
    return Probe(call, f"{lanes} lanes, {_steering(bench)}")


def lane_steps(bench: Bench) -> tuple[float, float]:
    """Lane-steps of evaluating the bank: all of them, and those spent in episodes."""
    stage = Stage(bench.scratch / "test")
    settings, bank = _test(bench)
    model = bench.once(controller)
    outcome = evaluate(bench.robot, model, bank, settings, mesh=bench.mesh, stage=stage)
    useful = float(outcome.steps.sum())
    return useful / read_metrics(stage.path(METRICS))[-1]["useful"], useful


def tested(bench: Bench, *, useful: bool) -> Probe:
    """Lane-steps of evaluating the whole bank: those spent in episodes, or all."""
    seeds, episodes = bench.options.bank
    steps = bench.once(lane_steps)
    mean = steps[1] / (seeds * episodes)
    test = f"{seeds} × {episodes} episodes of {mean:.0f} steps, {_steering(bench)}"
    return Probe(lambda _: steps[useful], test)


def _test(bench: Bench) -> tuple[Test, Scenarios]:
    return Test(lanes=bench.options.wide), scenarios(bench.robot, *bench.options.bank)


def _steering(bench: Bench) -> str:
    """Whose controller it is."""
    return bench.options.run.name if bench.options.run else "an untrained controller"
