"""Steps per second by number of lanes: of `robot.step` alone, of 𝒢, and of the test."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.measuring import carried
from experiments.gpu.results import Row
from genidm import devices
from genidm.controller import Controller
from genidm.evaluation.evaluate import EvaluationSettings, flatten
from genidm.evaluation.evaluator import EvaluationState, Evaluator
from genidm.evaluation.scenarios import scenarios
from genidm.paper.idm import Architecture
from genidm.paper.methods import LR
from genidm.paper.replaying import Runner
from genidm.robots import Robot, State

# Numbers of lanes on engines that run on an accelerator, and on others.
LANES, FEW_LANES = (128, 512, 2048, 8192), (128, 512)
# Steps per lane in a call.
STEPS = 32
# The rate is a median over calls: at least `CALLS`, and more until `SECONDS` are over.
CALLS, SECONDS = 3, 2.0
# Programs compiled in parallel for an accelerator; its host has idle cores.
WORKERS = 3


class Probe(NamedTuple):
    """A call to be timed.

    Attributes:
      call: does `steps` steps, and returns when they are done.
      steps: steps per call, over all lanes.
    """

    call: Callable[[], object]
    steps: int


def stepping(robot: Robot, lanes: int) -> Probe:
    """Only `robot.step`, with random actions drawn in advance."""
    mesh = robot.mesh()
    state = devices.put(_standing(robot, lanes), mesh)
    actions = devices.put(_actions(robot, lanes), mesh, 1)

    def walk(state: State, actions: jax.Array) -> State:
        return jax.lax.scan(lambda s, a: (robot.step(s, a), None), state, actions)[0]

    sharded = devices.over_lanes(walk, mesh, [0, 1], 0)
    program = jax.jit(sharded, donate_argnums=0).lower(state, actions).compile()
    return Probe(carried(lambda s: program(s, actions), state), lanes * STEPS)


def generalizing(robot: Robot, lanes: int) -> Probe:
    """𝒢 of one block, with its transfer to the devices and back, as in `replay`."""
    state, actions = _standing(robot, lanes), _actions(robot, lanes)
    # Robots are set only at the first step, so the physics of other steps does not matter.
    physics, s = jax.tree.map(
        lambda x: np.broadcast_to(np.asarray(x), (STEPS, *x.shape)),
        (state.physics, state.observation),
    )
    placed = np.arange(STEPS)[:, None] == np.zeros(lanes)
    valid = np.ones_like(placed)
    block = dict(physics=physics, s=s, a=np.asarray(actions), placed=placed, valid=valid)
    keys = jax.random.split(jax.random.key(0), lanes)
    runner = Runner(robot, robot.mesh(), (keys, block))

    def call() -> None:
        _, seen = runner.program(runner.start(keys, block), runner.put(block))
        jax.tree.map(np.asarray, seen)

    return Probe(call, lanes * STEPS)


def testing(robot: Robot, lanes: int) -> Probe:
    """The test with an untrained LR controller, with as many scenarios as lanes."""
    test_scenarios = flatten(scenarios(robot, 1, lanes))
    test = Evaluator(
        robot, test_scenarios, EvaluationSettings(num_envs=lanes, chunk=STEPS), robot.mesh()
    )
    queue = test.start()
    program = test.prepare(_untrained(robot), queue)

    def step(queue: EvaluationState) -> EvaluationState:
        queue = program(queue)
        return test.start() if test.ended(queue) == test.total else queue

    return Probe(carried(step, queue), lanes * STEPS)


PROBES: dict[str, Callable[[Robot, int], Probe]] = {
    "step": stepping,
    "𝒢": generalizing,
    "test": testing,
}
"""Name of a measurement → the function that builds its probe."""


def _standing(robot: Robot, lanes: int) -> State:
    return jax.jit(robot.reset)(jax.random.split(jax.random.key(1), lanes), jnp.zeros(lanes))


def _actions(robot: Robot, lanes: int) -> jax.Array:
    shape = (STEPS, lanes, robot.action.size)
    return jax.random.uniform(jax.random.key(0), shape, minval=-1.0)


def _untrained(robot: Robot) -> Controller:
    fit, size = LR.fit, robot.observation.size
    architecture = Architecture(robot.action.size, fit.idm, fit.lfm, fit.latent_size)
    params = architecture.init(jax.random.key(0), size)
    return Controller(params, jnp.zeros(size), jnp.ones(size), architecture, "world", robot)


# ── measuring ───────────────────────────────────────────────────────────────────────────────


class Built(NamedTuple):
    """A probe, or the error that building it raised; and the seconds of building."""

    probe: Probe | Exception
    seconds: float


class Measuring:
    """Measures from few lanes to many, within a time limit.

    If a number of lanes fails (for example for lack of memory), its row has the error, and more
    lanes are not tried.

    Args:
      robot: the robot to step.
      engine: name of its engine.
      seconds: time limit; numbers of lanes that would exceed it are left out.
      known: returns the row with these identifying fields, if it need not be measured again.
      save: receives each row as soon as it is measured.
    """

    def __init__(
        self,
        robot: Robot,
        engine: str,
        seconds: float,
        known: Callable[[Row], Row | None],
        save: Callable[[Row], None],
    ):
        self._robot, self._engine, self._known, self._save = robot, engine, known, save
        self._end = time.monotonic() + seconds
        self._failed: set[str] = set()

    def run(self) -> bool:
        """Measures the missing rows; returns False if some are left out for lack of time."""
        devices, took = self._robot.mesh().size, 0.0
        engine = self._robot.engine
        for asked in LANES if engine and engine.on_accelerator else FEW_LANES:
            lanes = -(-asked // devices) * devices  # devices need equal numbers of lanes
            todo = [what for what in PROBES if self._wanted(self._names(what, lanes))]
            if todo and self._end - time.monotonic() < took:
                print(f"{lanes} lanes: not enough time is left", file=sys.stderr)
                return False
            began = time.monotonic()
            self._measure(todo, lanes)
            # Most of the time is compilation, so it grows more slowly than the number of lanes.
            took = max(took, time.monotonic() - began)
        return True

    def _names(self, what: str, lanes: int) -> Row:
        return dict(robot=self._robot.name, what=what, engine=self._engine, lanes=lanes)

    def _wanted(self, names: Row) -> bool:
        row = self._known(names)
        if row and "error" in row:
            self._failed.add(names["what"])
        return row is None and names["what"] not in self._failed

    def _measure(self, todo: list[str], lanes: int) -> None:
        """Compiles all probes, in parallel for an accelerator, then times each."""
        workers = WORKERS if devices.accelerated() else 1
        with ThreadPoolExecutor(workers) as pool:
            ready = list(pool.map(lambda what: _build(what, self._robot, lanes), todo))
        for what, built in zip(todo, ready, strict=True):
            row = _row(built, self._end)
            self._save(self._names(what, lanes) | row)
            print(f"{what}, {lanes} lanes, {self._engine}: {_said(row)}", file=sys.stderr)
            if "error" in row:
                self._failed.add(what)


def _build(what: str, robot: Robot, lanes: int) -> Built:
    began = time.perf_counter()
    try:
        probe: Probe | Exception = PROBES[what](robot, lanes)
    except Exception as error:  # any error: the other rows do not depend on it
        probe = error
    return Built(probe, time.perf_counter() - began)


def _row(built: Built, end: float) -> Row:
    """The row of a probe: the median rate of several calls, or the error."""
    try:
        if isinstance(built.probe, Exception):
            raise built.probe
        return _timed(built.probe, end) | {"compiling": round(built.seconds, 1)}
    except Exception as error:
        traceback.print_exc()
        return {"error": f"{type(error).__name__}: {error}".splitlines()[0][:200]}


def _timed(probe: Probe, end: float) -> Row:
    """The median rate of several calls, after a warm-up call."""
    probe.call()
    began, taken = time.perf_counter(), list[float]()
    while len(taken) < CALLS or (time.perf_counter() - began < SECONDS and time.monotonic() < end):
        start = time.perf_counter()
        probe.call()
        taken.append(time.perf_counter() - start)
    rates = probe.steps / np.asarray(taken)
    stats = jax.devices()[0].memory_stats() or {}
    return {
        "steps_per_second": _digits(np.median(rates)),
        "spread": [_digits(rates.min()), _digits(rates.max())],
        "calls": len(taken),
        "peak_bytes": stats.get("peak_bytes_in_use"),
    }


def _digits(x: float) -> float:
    """Rounds to four digits, the precision of timings."""
    return float(f"{x:.4g}")


def _said(row: Row) -> str:
    return row["error"] if "error" in row else f"{row['steps_per_second']:,.0f} steps/s"
