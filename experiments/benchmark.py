"""How fast everything is, as ratios to what limits it, all measured in one run.

    pip install torch stable-baselines3 "gymnasium[mujoco]"      # for the rows that need them
    python -m experiments.benchmark --run runs/ant/LR-0-0123456789

A row is measured in turns with the row that it is compared with, and its ratio is the
median over the turns: the speed of a shared machine drifts, but that falls on both alike.
Programs are compiled and run once before anything is timed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import itertools
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar
from unittest import mock

import jax
import jax.monitoring
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from jax.sharding import Mesh
from mujoco.rollout import Rollout
from tqdm.auto import tqdm

from experiments import _sb3
from genidm import controller, devices, evaluate, fit, generalize, store
from genidm.agents import ppo
from genidm.agents.base import Agent, Iterate
from genidm.collect import CHUNK, collect
from genidm.controller import Controller
from genidm.errors import BadInput
from genidm.evaluate import Test
from genidm.experience import Experience, concatenate
from genidm.experiment import guarded
from genidm.fit import Fit
from genidm.generalize import Generalize, Pairs, pairs, replay
from genidm.methods import GE, LR, RL, RS, Method
from genidm.progress import METRICS, Progress, read_metrics
from genidm.robots import Ant, Robot, by_name
from genidm.robots.base import State
from genidm.robots.mjx import MjxRobot
from genidm.scenarios import scenarios
from genidm.store import Stage

T = TypeVar("T")
Shape = tuple[int, int]

# Steps of a lane in a call of the raw rows, as in an iteration of PPO.
STEPS = 32
# Updates in a call of the fit's rows.
UPDATES = 100
# Samples to fit to: more than a cache holds, as in a real fit.
SAMPLES = 200_000


@dataclasses.dataclass(frozen=True)
class Options:
    """What is measured, and for how long.

    Attributes:
      out: where the rows are written, as JSON.
      run: the finished fit stage whose controller is evaluated; an untrained one, unless
        given. It decides how long episodes are, and with that the useful share.
      rows: only the rows of these names, or of which these are a part, and those that they
        are compared with; the file then holds no others.
      seconds: of measuring, for each row.
      lanes: robots at once in the rows of collecting.
      wide: robots at once in the rows of 𝒢 and evaluation.
      bank: test seeds, and episodes for each of them, of the useful share of evaluation.
    """

    out: Path = Path("experiments/results/benchmark.json")
    run: Path | None = None
    rows: tuple[str, ...] = ()
    seconds: float = 60.0
    lanes: int = RL.agent.lanes
    wide: int = Test().lanes
    bank: tuple[int, int] = (10, 1000)

    def __post_init__(self) -> None:
        if not 0 < self.seconds < math.inf:
            raise BadInput(f"seconds must be a number above 0, not {self.seconds}")
        if min(self.lanes, self.wide, *self.bank) < 1:
            raise BadInput("lanes, wide and both numbers of the bank must be at least 1")


class Skip(Exception):
    """Why a row cannot be measured here."""


class Probe(NamedTuple):
    """A way to measure one number, again and again.

    Attributes:
      sample: seconds to spend on it → the number, measured once.
      note: what it was measured on; it stands behind the row's name.
    """

    sample: Callable[[float], float]
    note: str


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
      name: what is measured.
      unit: of its value.
      build: makes all that is needed to measure it.
      ratio_to: name of the row that it is compared with.
      rounds: how often it is measured, if the seconds suffice.
    """

    name: str
    unit: str
    build: Callable[[Bench], Probe]
    ratio_to: str | None = None
    rounds: int = 9


@dataclasses.dataclass
class Bench:
    """What rows share, made when the first row asks for it.

    Attributes:
      robot: whose physics is stepped.
      options: sizes.
      exits: what is to be closed at the end.
    """

    robot: Robot
    options: Options
    exits: contextlib.ExitStack
    _probes: dict[Callable[[Bench], Probe], Probe] = dataclasses.field(default_factory=dict)

    def probe(self, row: Row) -> Probe:
        """The row's probe; rows with one `build` share it, and so compile once."""
        if row.build not in self._probes:
            self._probes[row.build] = row.build(self)
        return self._probes[row.build]

    @functools.cached_property
    def mesh(self) -> Mesh:
        """All devices."""
        return devices.mesh()

    @functools.cached_property
    def scratch(self) -> Path:
        """A directory that is removed at the end."""
        return Path(self.exits.enter_context(tempfile.TemporaryDirectory(prefix="genidm-")))

    @functools.cached_property
    def generalize(self) -> Generalize:
        """Settings of 𝒢."""
        assert LR.generalize
        return dataclasses.replace(LR.generalize, lanes=self.options.wide)

    @functools.cached_property
    def record(self) -> Experience:
        """Random actions, long enough for four blocks of 𝒢."""
        agent = dataclasses.replace(RS.agent, lanes=self.options.lanes)
        interactions = 4 * self.options.wide * self.generalize.segment
        return collect(self.robot, agent, interactions, mesh=self.mesh, quiet=True)[0]

    @functools.cached_property
    def samples(self) -> Pairs:
        """Noise of the shape of e.m.o. pairs, on the fit's device."""
        draw, sizes = np.random.default_rng(0), (self.robot.observation.size, 3)
        s, d = (draw.standard_normal((2, SAMPLES, n), np.float32) for n in sizes)
        a = draw.standard_normal((SAMPLES, self.robot.action.size), np.float32)
        return jax.device_put(Pairs(s, d, a), jax.devices()[0])

    @functools.cached_property
    def controller(self) -> Controller:
        """That of the run, or an untrained one."""
        if self.options.run:
            return controller.load(self.options.run / "controller", self.robot)
        turned = replay(self.robot, self.record, jax.random.key(1), Generalize(mode="rotate"))
        settings = dataclasses.replace(LR.fit, updates=1)
        samples = pairs(self.robot, self.record, turned)
        return fit.fit(self.robot, samples, jax.random.key(2), settings, quiet=True)

    @property
    def steering(self) -> str:
        """Whose controller that is."""
        return self.options.run.name if self.options.run else "an untrained controller"

    @functools.cached_property
    def tested(self) -> tuple[float, float]:
        """Lane-steps of evaluating the bank: all of them, and those spent in episodes."""
        stage = Stage(self.scratch / "test")
        test = Test(lanes=self.options.wide)
        bank = scenarios(self.robot, *self.options.bank)
        outcome = evaluate.evaluate(
            self.robot, self.controller, bank, test, mesh=self.mesh, stage=stage
        )
        useful = float(outcome.steps.sum())
        return useful / read_metrics(stage.path(METRICS))[-1]["useful"], useful

    @functools.cached_property
    def starts(self) -> tuple[dict[str, float], dict[str, float]]:
        """What is compiled when a command is started first, and when it is started again."""
        environment = os.environ | {"XDG_CACHE_HOME": str(self.scratch / "cache")}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        code = f"from experiments import benchmark; benchmark.start({self.robot.name!r})"
        command = [sys.executable, "-c", code]

        def once() -> dict[str, float]:
            out = subprocess.run(command, env=environment, stdout=subprocess.PIPE)
            if out.returncode:
                raise Skip("a process of its own failed")
            return json.loads(out.stdout.splitlines()[-1])

        return once(), once()


# ── measuring ───────────────────────────────────────────────────────────────────────────


def timed(call: Callable[[], object], amount: float) -> Callable[[float], float]:
    """A sample of how much `call` gets done in a second.

    Args:
      call: does `amount` of work, and returns when it is done.
      amount: of work in a call.
    """
    call()  # compiles

    def sample(seconds: float) -> float:
        began, calls = time.perf_counter(), 0
        while not calls or time.perf_counter() - began < seconds:
            call()
            calls += 1
        return amount * calls / (time.perf_counter() - began)

    return sample


def carried(step: Callable[[T], T], carry: T) -> Callable[[], None]:
    """A call that goes on from where the last one ended."""

    def call() -> None:
        nonlocal carry
        carry = jax.block_until_ready(step(carry))

    return call


def interleave(probes: Sequence[Probe], seconds: float, rounds: int) -> np.ndarray:
    """Samples `[rounds, probes]`: each probe once a round.

    Every other round goes backwards, so that a steady drift falls on all alike. No round is
    begun after the seconds are over; one is always made.
    """
    began, table = time.perf_counter(), list[list[float]]()
    share = seconds / (rounds * len(probes))
    while len(table) < rounds and (not table or time.perf_counter() - began < seconds):
        turn = 1 if len(table) % 2 == 0 else -1
        table.append([probe.sample(share) for probe in probes[::turn]][::turn])
    return np.asarray(table)


def measure(bench: Bench, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Measures rows, and says on stderr which cannot be measured here.

    Returns:
      what stands in the JSON: name, value, unit, ratio_to, ratio, hardware.
    """
    by_row = {row.name: row for row in rows}
    values: dict[str, list[float]] = defaultdict(list)
    ratios: dict[str, float] = {}
    compared = {row.ratio_to for row in rows}
    # What others are compared with, and itself with nothing, is measured beside them.
    todo = [row for row in rows if row.ratio_to or row.name not in compared]
    with Progress("benchmark", len(todo), "rows") as bar:
        for row in todo:
            group = [by_row[row.ratio_to], row] if row.ratio_to else [row]
            with _skipping(row):
                probes = [bench.probe(member) for member in group]
                table = interleave(probes, bench.options.seconds, row.rounds)
                for member, column in zip(group, table.T, strict=True):
                    values[member.name].extend(column)
                if row.ratio_to:
                    ratios[row.name] = float(np.median(table[:, 1] / table[:, 0]))
            bar.advance(1)
    measured = [row for row in rows if row.name in values]
    return [_result(bench, row, by_row, values[row.name], ratios) for row in measured]


@contextlib.contextmanager
def _skipping(row: Row) -> Iterator[None]:
    try:
        yield
    except (Skip, _sb3.Ended) as reason:
        tqdm.write(f"skipped: {row.name}: {reason}", file=sys.stderr)


def _result(
    bench: Bench, row: Row, rows: dict[str, Row], values: list[float], ratios: dict[str, float]
) -> dict[str, Any]:
    def full(row: Row) -> str:
        return f"{row.name} ({bench.probe(row).note})"

    # What could not be compared may have been measured all the same, for others' ratios.
    base = rows[row.ratio_to] if row.ratio_to and row.name in ratios else None
    return {
        "name": full(row),
        "value": _rounded(statistics.median(values)),
        "unit": row.unit,
        "ratio_to": full(base) if base else None,
        "ratio": _rounded(ratios[row.name]) if base else None,
        "hardware": store.environment()["hardware"],
    }


def _rounded(x: float) -> float | None:
    """Four digits, as many as timings have; None for what JSON cannot hold."""
    return float(f"{x:.4g}") if math.isfinite(x) else None


# ── physics ─────────────────────────────────────────────────────────────────────────────


def in_c(bench: Bench) -> Probe:
    """MuJoCo in C, one thread a core, on the robot's own model and solver settings."""
    robot, lanes = bench.robot, bench.options.lanes
    if not isinstance(robot, MjxRobot):
        raise Skip(f"the {robot.name} is no MuJoCo model")
    model, threads = robot.mj_model, _cores()
    pool = bench.exits.enter_context(Rollout(nthread=threads))
    data = [mujoco.MjData(model) for _ in range(threads)]
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (lanes, STEPS, model.nu))
    control = actions.repeat(robot.frames, axis=1)
    physics = _standing(robot, lanes).physics
    start = [np.zeros((lanes, 1)), physics.qpos, physics.qvel, np.zeros((lanes, model.na))]

    def step(state: np.ndarray) -> np.ndarray:
        states, _ = pool.rollout(model, data, state, control)
        return states[:, -1]

    call = carried(step, np.concatenate(start, axis=1))
    return Probe(timed(call, lanes * STEPS), f"{lanes} lanes, {threads} threads")


def raw(bench: Bench, *, wide: bool = False, count: int | None = None) -> Probe:
    """`robot.step` under random actions drawn beforehand, and nothing else.

    Args:
      bench: sizes.
      wide: as many lanes as 𝒢 and evaluation have.
      count: devices; all, unless given.
    """
    robot, lanes = bench.robot, bench.options.wide if wide else bench.options.lanes
    count = count or jax.device_count()
    if count > jax.device_count() or lanes % count:
        raise Skip(f"{lanes} lanes and {jax.device_count()} devices do not make {count} shares")
    mesh = devices.mesh(jax.devices()[:count])
    shape = (STEPS, lanes, robot.action.size)
    actions = devices.put(jax.random.uniform(jax.random.key(0), shape, minval=-1.0), mesh, 1)

    def walk(state: State, actions: jax.Array) -> State:
        return jax.lax.scan(lambda s, a: (robot.step(s, a), None), state, actions)[0]

    program = jax.jit(devices.over_lanes(walk, mesh, [0, 1], 0), donate_argnums=0)
    call = carried(lambda s: program(s, actions), devices.put(_standing(robot, lanes), mesh))
    return Probe(timed(call, lanes * STEPS), f"{lanes} lanes, {_count(count, 'device')}")


def _standing(robot: Robot, lanes: int) -> State:
    return jax.jit(robot.reset)(jax.random.split(jax.random.key(1), lanes), jnp.zeros(lanes))


# ── collecting ──────────────────────────────────────────────────────────────────────────


def collecting(bench: Bench, *, method: Method) -> Probe:
    """What `collect` does: iterations of the agent, its metrics read, its record kept."""
    agent = _agent(bench, method)
    iterate, learner = _learning(bench, method.task, agent)

    def step(learner: Any) -> Any:
        learner, part, metrics = iterate(learner)
        concatenate([part])
        _read(metrics)
        return learner

    return Probe(timed(carried(step, learner), agent.lanes * agent.unroll), _lanes(agent.lanes))


def unrecorded(bench: Bench) -> Probe:
    """The same with PPO, its record dropped before the program is compiled."""
    agent = _agent(bench, RL)
    with mock.patch.object(ppo, "record", return_value=()):
        iterate, learner = _learning(bench, RL.task, agent)

    def step(learner: Any) -> Any:
        learner, part, metrics = iterate(learner)
        assert not jax.tree.leaves(part)
        _read(metrics)
        return learner

    return Probe(timed(carried(step, learner), agent.lanes * agent.unroll), _lanes(agent.lanes))


def walking(bench: Bench) -> Probe:
    """PPO's stepping alone: the policy is asked, all is recorded, nothing is learned."""
    agent = _agent(bench, RL)
    assert isinstance(agent, ppo.PPO)
    learning = agent.learning(bench.robot, RL.task, bench.mesh)
    learner = learning.place(jax.jit(learning.start)(jax.random.key(0)))
    mind = (learner.mind.statistics, learner.mind.params.policy)
    policy = devices.put(mind, bench.mesh, None)
    networks = agent.networks(bench.robot)
    walk = functools.partial(ppo._walk, bench.robot, RL.task, networks, agent.unroll)
    sharded = devices.over_lanes(walk, bench.mesh, [None, None, 0], (0, 1, 1, 1))
    program = jax.jit(sharded, donate_argnums=2)
    call = carried(lambda lanes: program(*policy, lanes)[0], learner.lanes)
    return Probe(timed(call, agent.lanes * agent.unroll), _lanes(agent.lanes))


def writing(bench: Bench) -> Probe:
    """Writing the record to the disk, as `collect` does now and then."""
    copies = -(-CHUNK // bench.record.interactions)
    chunk = concatenate([bench.record] * copies)
    call = functools.partial(chunk.save, bench.scratch / "chunk")
    return Probe(timed(call, chunk.interactions), f"{chunk.interactions} steps at a time")


def _agent(bench: Bench, method: Method) -> Any:
    return dataclasses.replace(method.agent, lanes=bench.options.lanes)


def _learning(bench: Bench, task: Any, agent: Agent) -> tuple[Iterate, Any]:
    """The agent's iteration, compiled, and a learner at its start."""
    learning = agent.learning(bench.robot, task, bench.mesh)
    learner = learning.place(jax.jit(learning.start)(jax.random.key(0)))
    return learning.prepare(learner), learner


def _read(metrics: dict[str, jax.Array]) -> list[float]:
    return [float(np.mean(x)) for x in metrics.values()]


# ── 𝒢 and evaluation ────────────────────────────────────────────────────────────────────


def generalizing(bench: Bench, *, program_alone: bool = False) -> Probe:
    """What `replay` does: blocks sent to the devices, replayed and brought back.

    Args:
      bench: sizes.
      program_alone: leave out the sending and bringing back.
    """
    key, settings, record = jax.random.key(0), bench.generalize, bench.record
    placed = generalize._placements(np.asarray(record.first), settings)
    blocks = generalize._Blocks(record, placed, settings, bench.mesh.size)
    run = generalize._Runner(bench.robot, bench.mesh, blocks.example(key))
    bar, note = Progress("generalize", 0, "steps", quiet=True), _lanes(blocks.width)
    if not program_alone:
        return Probe(timed(lambda: blocks.gather(run.over(blocks, key, bar)), blocks.total), note)
    keys, block = blocks.example(key)
    on_devices = run._put(block)
    call = carried(lambda cursor: run.program(cursor, on_devices)[0], run._start(keys, block))
    return Probe(timed(call, blocks.length * blocks.width), note)


def evaluating(bench: Bench) -> Probe:
    """What `evaluate` does with a bank; lane-steps without an episode count too."""
    robot, mesh, settings = bench.robot, bench.mesh, Test(lanes=bench.options.wide)
    bank = evaluate.flatten(scenarios(robot, *bench.options.bank))
    total = bank.yaw.shape[0]
    steering = devices.put(bench.controller, mesh, None)
    queue, shares = evaluate._queues(robot, bank, settings, 0, mesh)
    body = functools.partial(evaluate._chunk, robot, settings)
    program = jax.jit(devices.over_lanes(body, mesh, [None, 0, 0], 0), donate_argnums=1)

    def step(queue: Any) -> Any:
        queue = program(steering, queue, shares)
        ended = evaluate._count(queue, total, mesh) == total
        return evaluate._queues(robot, bank, settings, 0, mesh)[0] if ended else queue

    lanes = queue.episode.shape[0]
    call = timed(carried(step, queue), lanes * settings.chunk)
    return Probe(call, f"{lanes} lanes, {bench.steering}")


def tested(bench: Bench, *, useful: bool) -> Probe:
    """Lane-steps of evaluating the whole bank: those spent in episodes, or all."""
    seeds, episodes = bench.options.bank
    steps = bench.tested[useful]
    mean = bench.tested[1] / (seeds * episodes)
    test = f"{seeds} × {episodes} episodes of {mean:.0f} steps, {bench.steering}"
    return Probe(lambda _: steps, test)


# ── fitting ─────────────────────────────────────────────────────────────────────────────


def fitting(bench: Bench, *, settings: Fit) -> Probe:
    """Updates of a fit."""
    samples = bench.samples
    learner = fit._start(bench.robot, samples, jax.random.key(0), settings, "world")
    program = jax.jit(fit._updates(settings), donate_argnums=0)
    call = carried(lambda x: program(x, samples, jnp.int32(UPDATES))[0], learner)
    return Probe(timed(call, UPDATES), _networks(settings))


def multiplying(bench: Bench, *, settings: Fit) -> Probe:
    """The matrix products of an update, forwards and backwards, and nothing else.

    They are those of the gradient of a network of the same shape without biases and
    nonlinearities; weights move a little, or XLA would take the products out of the loop.
    """
    psi, phi = _products(bench.robot, settings)
    keys = jax.random.split(jax.random.key(0), 3)
    weights = _weights(keys[0], psi), _weights(keys[1], phi)
    views = 2 if psi else 1
    x = jax.random.normal(keys[2], (views, settings.batch, (psi or phi)[0][0]))

    def loss(weights: tuple[list[jax.Array], list[jax.Array]], x: jax.Array) -> jax.Array:
        gamma = functools.reduce(jnp.matmul, weights[0], x).mean(0)
        return jnp.sum(functools.reduce(jnp.matmul, weights[1], gamma) ** 2)

    def update(_: int, weights: Any) -> Any:
        return jax.tree.map(lambda w, g: w - 1e-9 * g, weights, jax.grad(loss)(weights, x))

    program = jax.jit(lambda w: jax.lax.fori_loop(0, UPDATES, update, w), donate_argnums=0)
    return Probe(timed(carried(program, weights), UPDATES), _networks(settings))


def _products(robot: Robot, settings: Fit) -> tuple[list[Shape], list[Shape]]:
    """Shapes of the matrices in ψ, if there is one, and in φ."""
    state, latent = robot.observation.size + 3, settings.latent_size
    psi = (state, *settings.lfm, latent) if latent else ()
    phi = (latent or state, *settings.idm, robot.action.size)
    return list(itertools.pairwise(psi)), list(itertools.pairwise(phi))


def _weights(key: jax.Array, shapes: Sequence[Shape]) -> list[jax.Array]:
    keys = jax.random.split(key, len(shapes)) if shapes else ()
    return [
        jax.random.normal(k, shape) / math.sqrt(shape[0])
        for k, shape in zip(keys, shapes, strict=True)
    ]


def _networks(settings: Fit) -> str:
    shown = {"LFM": settings.lfm if settings.latent_size else (), "IDM": settings.idm}
    networks = [f"{k} {'×'.join(map(str, widths))}" for k, widths in shown.items() if widths]
    return f"batch {settings.batch}, {', '.join(networks)}"


# ── others' PPO ─────────────────────────────────────────────────────────────────────────


def baseline(bench: Bench) -> Probe:
    """Stable-Baselines3's PPO at its defaults on gymnasium's Ant-v5, at its fastest here."""
    missing = [name for name in _sb3.NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise Skip(f"{', '.join(missing)} missing: pip install -e '.[benchmark]'")
    say = functools.partial(tqdm.write, file=sys.stderr)
    setting = _sb3.fastest(_sb3.candidates(_cores()), say)
    agent = bench.exits.enter_context(_sb3.Baseline(*setting))
    return Probe(timed(agent.iterate, agent.steps), agent.note)


# ── starting ────────────────────────────────────────────────────────────────────────────


def starting(bench: Bench, *, second: bool, what: str) -> Probe:
    """What is compiled until PPO's first iteration is made, in a fresh process.

    Args:
      bench: the robot.
      second: with the compilation cache that a first start has left.
      what: a number that `start` prints.
    """
    number = bench.starts[second][what]
    return Probe(lambda _: number, "PPO's first iteration")


def start(robot: str) -> None:
    """In a fresh process: makes PPO's first iteration, and prints what was compiled."""
    with compiling() as counted:
        collect(by_name(robot), RL.agent, 1, quiet=True)
    print(json.dumps(counted))


@contextlib.contextmanager
def compiling() -> Iterator[dict[str, float]]:
    """Counts what jax compiles meanwhile.

    Yields:
      "seconds" spent in XLA or in reading its cache, "programs" that were compiled and
      took long enough to be kept in the cache, "wall" seconds in all.
    """
    counted = {"seconds": 0.0, "programs": 0.0, "wall": 0.0}

    def took(event: str, duration_secs: float, **_: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            counted["seconds"] += duration_secs

    def happened(event: str, **_: Any) -> None:
        counted["programs"] += event == "/jax/compilation_cache/cache_misses"

    jax.monitoring.register_event_duration_secs_listener(took)
    jax.monitoring.register_event_listener(happened)
    began = time.perf_counter()
    yield counted
    counted["wall"] = time.perf_counter() - began


# ── the rows ────────────────────────────────────────────────────────────────────────────


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'s' if n > 1 else ''}"


def _lanes(n: int) -> str:
    return _count(n, "lane")


_P = functools.partial  # one object a build: rows that share it share what it compiles
_RAW = _P(raw)
_PPO = _P(collecting, method=RL)


def _starts(name: str, what: str, unit: str) -> tuple[Row, Row]:
    """The rows of one number that `start` prints."""
    first, second = (_P(starting, second=second, what=what) for second in (False, True))
    base = Row(f"first start, {name}", unit, first, rounds=1)
    return base, Row(f"second start, {name}", unit, second, base.name, 1)


ROWS: tuple[Row, ...] = (
    Row("MuJoCo in C", "steps/s", in_c),
    Row("raw MJX", "steps/s", _RAW, "MuJoCo in C"),
    Row("raw MJX, wide", "steps/s", _P(raw, wide=True), "MuJoCo in C"),
    Row("raw MJX, one device", "steps/s", _P(raw, count=1)),
    Row("raw MJX, two devices", "steps/s", _P(raw, count=2), "raw MJX, one device"),
    Row("raw MJX, all devices", "steps/s", _RAW, "raw MJX, one device"),
    Row("collecting, random actions", "steps/s", _P(collecting, method=RS), "raw MJX"),
    Row("collecting, PPO", "steps/s", _PPO, "raw MJX"),
    Row("collecting, PPO's stepping alone", "steps/s", walking, "raw MJX"),
    Row("PPO, record dropped", "steps/s", unrecorded),
    Row("PPO, record kept", "steps/s", _PPO, "PPO, record dropped"),
    Row("writing the record", "steps/s", writing, "collecting, PPO"),
    Row("𝒢", "steps/s", _P(generalizing), "raw MJX, wide"),
    Row("𝒢, its program alone", "steps/s", _P(generalizing, program_alone=True), "raw MJX, wide"),
    Row("evaluation", "lane-steps/s", evaluating, "raw MJX, wide"),
    Row("evaluation, all", "lane-steps", _P(tested, useful=False), rounds=1),
    Row("evaluation, useful", "lane-steps", _P(tested, useful=True), "evaluation, all", 1),
    Row("fit of LR, products alone", "updates/s", _P(multiplying, settings=LR.fit)),
    Row("fit of LR", "updates/s", _P(fitting, settings=LR.fit), "fit of LR, products alone"),
    Row("fit of GE, products alone", "updates/s", _P(multiplying, settings=GE.fit)),
    Row("fit of GE", "updates/s", _P(fitting, settings=GE.fit), "fit of GE, products alone"),
    Row("PPO of Stable-Baselines3 on gymnasium's Ant-v5", "steps/s", baseline),
    Row("PPO", "steps/s", _PPO, "PPO of Stable-Baselines3 on gymnasium's Ant-v5"),
    *_starts("compiling", "seconds", "s"),
    *_starts("all", "wall", "s"),
    *_starts("compiled", "programs", "programs"),
)


def choose(texts: Sequence[str], rows: Sequence[Row] = ROWS) -> list[Row]:
    """The rows that are named, and those they are compared with.

    Args:
      texts: each is the name of a row, or a part of the names of several; none: all rows.
      rows: those there are.

    Raises:
      BadInput: a text is in no name.
    """
    by_row = {row.name: row for row in rows}
    wanted = {name for text in texts for name in _named(text, by_row)} or set(by_row)
    while bases := {by_row[n].ratio_to for n in wanted} - wanted - {None}:
        wanted |= {name for name in bases if name}
    return [row for row in rows if row.name in wanted]


def _named(text: str, names: Iterable[str]) -> list[str]:
    exact = [name for name in names if name == text]
    found = exact or [name for name in names if text.lower() in name.lower()]
    if not found:
        raise BadInput(f"no row is called {text!r}; there are: {'; '.join(names)}")
    return found


def table(results: Sequence[dict[str, Any]]) -> str:
    """The rows as text."""
    head = ("row", "value", "unit", "ratio", "to")
    body = []
    for r in results:
        base = (r["ratio_to"] or "").partition(" (")[0]  # its note stands in its own line
        body.append((r["name"], _number(r["value"]), r["unit"], _number(r["ratio"]), base))
    widths = [max(map(len, column)) for column in zip(head, *body, strict=True)]
    align = "<><><"
    lines = [
        "  ".join(f"{x:{a}{w}}" for x, a, w in zip(line, align, widths, strict=True)).rstrip()
        for line in (head, *body)
    ]
    lines.insert(1, "─" * max(map(len, lines)))
    return "\n".join(lines)


def _number(x: float | None) -> str:
    return "" if x is None else f"{x:,.0f}" if abs(x) >= 100 else f"{x:.3g}"


def benchmark(robot: Robot, options: Options) -> list[dict[str, Any]]:
    """Measures the rows, and writes them.

    Raises:
      BadInput: unknown rows, lanes that the devices cannot share, a run that is none, or a
        place that cannot be written.
    """
    rows = choose(options.rows)
    for lanes in (options.lanes, options.wide):
        if lanes % jax.device_count():
            raise BadInput(f"{lanes} lanes cannot be shared among {jax.device_count()} devices")
    with store.disk(options.out):  # before the measuring, not after it
        if options.out.is_dir():
            raise BadInput(f"{options.out} is a directory")
        options.out.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as exits:
        bench = Bench(robot, options, exits)
        if options.run:
            _ = bench.controller
        results = measure(bench, rows)
    store.save_json(options.out, results)
    return results


def main() -> None:
    """The command line."""

    def command(options: Annotated[Options, tyro.conf.arg(name="")] = Options()) -> None:
        print(table(benchmark(Ant(), options)))

    guarded(command, "How fast everything is, as ratios to what limits it.")


if __name__ == "__main__":
    main()
