"""How stable, how fast and how turnable a robot's physics is, by solver settings.

    python -m experiments.physics                  # minutes; what it says is in docs/physics.md
    python -m experiments.physics --robot humanoid
    python -m experiments.physics --steps 20000    # a glance

Robots are shaken: every torque is at full strength, forwards or backwards at random, drawn
anew for each control step. A blow-up is a number that is not finite, a velocity beyond 1000
(m/s or rad/s), or a reset that MuJoCo in C makes by itself.
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from mujoco.rollout import Rollout

from genidm import devices, files, symmetry
from genidm.config import environment
from genidm.engines import Physics
from genidm.errors import BadInput
from genidm.experiment import guarded
from genidm.progress import Progress, compiled
from genidm.robots import Ant, Humanoid, State
from genidm.robots.base import select
from genidm.robots.mujoco import MujocoRobot, Solver

ROBOTS = {"ant": Ant, "humanoid": Humanoid}

OURS = Solver(iterations=4, line_search=8, elliptic=True)
SETTINGS = (
    Solver(iterations=1, line_search=4, elliptic=False),  # Brax's own
    Solver(iterations=4, line_search=8, elliptic=False),
    Solver(iterations=2, line_search=6, elliptic=True),
    OURS,
)
# Of the steps asked for, the share that settings other than ours are given.
OTHERS = 0.128
EPISODE = 200
TOO_FAST = 1e3
# Control steps before a replay begins, and after which it is compared.
WARM_UP = 20
LOOK = (5, 10, 20, 30, 50, 100, 200)


@dataclasses.dataclass(frozen=True)
class Options:
    """What is measured.

    Attributes:
      robot: by its name.
      steps: control steps of elliptic 4/8; the other settings are given 0.128 of them.
      lanes: robots at once; a multiple of the number of devices.
      threads: of MuJoCo in C; as many as jax has devices, unless given.
      seed: of starts, actions and yaws.
      out: the JSON file; under experiments/results, unless given.
    """

    robot: Literal["ant", "humanoid"] = "ant"
    steps: int = 1_000_000
    lanes: int = 128
    threads: int | None = None
    seed: int = 0
    out: Path | None = None

    def check(self) -> None:
        """Raises BadInput for what cannot be measured."""
        if min(self.steps, self.lanes, self.pool) < 1:
            raise BadInput("--steps, --lanes and --threads must be at least 1")
        if self.lanes % jax.device_count():
            raise BadInput(f"--lanes must be a multiple of {jax.device_count()}, one a device")

    @property
    def pool(self) -> int:
        """Threads of MuJoCo in C."""
        return jax.device_count() if self.threads is None else self.threads

    def with_solver(self, solver: Solver) -> MujocoRobot:
        """The robot, under these settings of the solver."""
        return ROBOTS[self.robot](solver)

    def episodes(self, solver: Solver) -> int:
        """Episodes of every lane: the steps asked for, rounded up."""
        steps = self.steps if solver == OURS else OTHERS * self.steps
        return math.ceil(steps / (self.lanes * EPISODE))


def cone(solver: Solver) -> str:
    """The friction cone, in a word."""
    return "elliptic" if solver.elliptic else "pyramidal"


# ── MuJoCo in C ─────────────────────────────────────────────────────────────────────────────


class InC:
    """Lanes in MuJoCo's C engine, in float64, on a pool of threads."""

    def __init__(self, robot: MujocoRobot, threads: int = 1):
        self.model, self.frames = robot.mj_model, robot.frames
        self._pool = Rollout(nthread=threads)
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        # Blow-ups are counted here, not written to a log file in the working directory.
        mujoco.set_mju_user_warning(lambda message: None)

    def held(self, actions: np.ndarray) -> np.ndarray:
        """Actions `[T, B, A]` as controls `[B, T × frames, A]`."""
        return np.repeat(actions.swapaxes(0, 1), self.frames, axis=1)

    def roll(self, physics: Physics, controls: np.ndarray) -> np.ndarray:
        """Time, qpos and qvel `[B, T × frames, 1 + nq + nv]` after each physics step.

        Where the engine gives a warning it resets itself; the lane then stays as it is.
        """
        clock = np.zeros((len(controls), 1))
        start = np.concatenate([clock, physics.qpos, physics.qvel], axis=-1)
        warm = np.asarray(physics.warmstart, np.float64)
        states, _ = self._pool.rollout(
            self.model, self._data, start, controls, initial_warmstart=warm
        )
        return states

    def positions(self, physics: Physics, actions: np.ndarray) -> np.ndarray:
        """o `[T, B, 3]` after each of the actions `[T, B, A]`."""
        states = self.roll(physics, self.held(actions))
        return states[:, self.frames - 1 :: self.frames, 1:4].swapaxes(0, 1)


def strong(rng: np.random.Generator, steps: int, lanes: int, size: int) -> np.ndarray:
    """Actions `[T, B, A]`, each −1 or 1."""
    return rng.choice([-1.0, 1.0], (steps, lanes, size))


# ── stability and speed ─────────────────────────────────────────────────────────────────────


def endure_in_c(robot: MujocoRobot, name: str, episodes: int, options: Options) -> dict[str, float]:
    """Shakes lanes in C; one that blows up sits out the rest of its episode.

    Returns:
      `steps` before blow-ups, `blow_ups` counted, `seconds` that the engine took.
    """
    engine, reset = InC(robot, options.pool), jax.jit(robot.reset)
    rng = np.random.default_rng(options.seed)
    clock = robot.mj_model.opt.timestep * np.arange(1, EPISODE * robot.frames + 1)
    steps = blow_ups = 0
    seconds = 0.0
    with Progress(name, episodes * EPISODE * options.lanes, "steps") as bar:
        for key in jax.random.split(jax.random.key(options.seed), episodes):
            starts = reset(jax.random.split(key, options.lanes), jnp.zeros(options.lanes))
            controls = engine.held(strong(rng, EPISODE, options.lanes, robot.action.size))
            began = time.perf_counter()
            states = engine.roll(starts.physics, controls)
            seconds += time.perf_counter() - began
            # An engine that has reset itself has set back its clock, too.
            lost = ~np.isclose(states[..., 0], clock)
            lost |= ~(np.abs(states[..., 1 + robot.mj_model.nq :]) <= TOO_FAST).all(-1)
            whole = np.where(lost.any(1), lost.argmax(1), len(clock)) // robot.frames
            steps += int(whole.sum())
            blow_ups += int(lost.any(1).sum())
            bar.advance(EPISODE * options.lanes)
    return {"steps": steps, "blow_ups": blow_ups, "seconds": seconds}


def endure_in_mjx(
    robot: MujocoRobot, name: str, episodes: int, options: Options
) -> dict[str, float]:
    """Shakes lanes sharded over the devices; one that blows up starts afresh at once.

    Returns:
      `steps` made, `blow_ups` counted, `seconds` taken.
    """
    mesh = devices.mesh()
    seeds = jax.random.split(jax.random.key(options.seed), episodes)
    lanes = [devices.put(jax.random.split(seed, options.lanes), mesh) for seed in seeds]
    program = jax.jit(devices.over_lanes(shaken(robot), mesh, [0], 0))
    run = compiled(f"{name} {jax.device_count()} devices", program, lanes[0])
    run(lanes[0]).block_until_ready()  # the first call also touches fresh memory
    blow_ups, began = 0, time.perf_counter()
    with Progress(name, episodes * EPISODE * options.lanes, "steps") as bar:
        for keys in lanes:
            blow_ups += int(run(keys).sum())
            bar.advance(EPISODE * options.lanes)
    seconds = time.perf_counter() - began
    return {"steps": episodes * EPISODE * options.lanes, "blow_ups": blow_ups, "seconds": seconds}


def shaken(robot: MujocoRobot) -> Any:
    """A function of keys `[B]`: blow-ups `[B]` in an episode from fresh starts."""

    def action(key: jax.Array) -> jax.Array:
        return jax.random.rademacher(key, (robot.action.size,), dtype=jnp.float32)

    def step(state: State, keys: jax.Array) -> tuple[State, jax.Array]:
        after = robot.step(state, jax.vmap(action)(keys))
        lost = after.diverged | (jnp.abs(after.physics.qvel) > TOO_FAST).any(-1)
        return select(lost, robot.reset(keys, jnp.zeros(keys.shape)), after), lost

    def episode(keys: jax.Array) -> jax.Array:
        streams = jax.vmap(lambda key: jax.random.split(key, EPISODE + 1))(keys)
        start = robot.reset(streams[:, 0], jnp.zeros(keys.shape))
        return jax.lax.scan(step, start, streams[:, 1:].T)[1].sum(0)

    return episode


def stability(options: Options) -> list[dict[str, Any]]:
    """A row for each setting and engine."""
    rows = []
    for solver in SETTINGS:
        robot, episodes = options.with_solver(solver), options.episodes(solver)
        for engine, endure in (("MJX float32", endure_in_mjx), ("C float64", endure_in_c)):
            setting = f"{cone(solver)} {solver.iterations}/{solver.line_search}"
            row = endure(robot, f"{setting} {engine}", episodes, options)
            speed = row["steps"] / row["seconds"]
            rows.append({"setting": setting, "engine": engine, **row, "steps_per_second": speed})
    return rows


# ── what is left of equivalence modulo orientation ──────────────────────────────────────────


def starts(options: Options) -> Physics:
    """Physics `[B, ...]` of robots that have been shaken for a second, in float32's numbers."""
    robot, rng = options.with_solver(OURS), np.random.default_rng(options.seed)
    keys = jax.random.split(jax.random.key(options.seed), options.lanes)
    fresh = robot.reset(keys, jnp.zeros(options.lanes)).physics
    engine = InC(robot)
    actions = strong(rng, WARM_UP, options.lanes, robot.action.size)
    last = engine.roll(fresh, engine.held(actions))[:, -1].astype(np.float32)
    qpos, qvel = last[:, 1 : 1 + robot.mj_model.nq], last[:, 1 + robot.mj_model.nq :]
    return Physics(qpos, qvel, np.zeros_like(qvel))


def drift_in_c(
    robot: MujocoRobot, start: Physics, yaw: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """Metres `[T, B]` between the turned replay and the replay, turned; in float64."""
    engine = InC(robot)
    with jax.enable_x64(True):  # the turns, too
        start = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), start)
        turn = jnp.asarray(yaw)
        turned = jax.tree.map(np.asarray, robot.turn_physics(start, turn))
        exact = symmetry.turn_vector(jnp.asarray(engine.positions(start, actions)), turn)
        return np.linalg.norm(engine.positions(turned, actions) - np.asarray(exact), axis=-1)


def drift_in_mjx(
    robot: MujocoRobot, start: Physics, yaw: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """The same in MJX and float32, as 𝒢 does it."""

    def positions(physics: Physics, yaw: jax.Array, actions: jax.Array) -> jax.Array:
        def step(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = robot.step(state, action)
            return state, state.position

        return jax.lax.scan(step, robot.place(physics, yaw), actions)[1]

    run = jax.jit(devices.over_lanes(positions, devices.mesh(), [0, 0, 1], 1))
    turn, a = jnp.asarray(yaw, jnp.float32), jnp.asarray(actions, jnp.float32)
    exact = symmetry.turn_vector(run(start, jnp.zeros_like(turn), a), turn)
    return np.linalg.norm(run(start, turn, a) - exact, axis=-1)


def drift(options: Options) -> list[dict[str, Any]]:
    """A row for each cone and engine: median and 90th percentile over the lanes."""
    start, rng = starts(options), np.random.default_rng(options.seed + 1)
    yaw = rng.uniform(-np.pi, np.pi, options.lanes)
    rows = []
    for solver in (s for s in SETTINGS if s.iterations == OURS.iterations):
        robot, shakes = options.with_solver(solver), np.random.default_rng(options.seed + 2)
        actions = strong(shakes, max(LOOK), options.lanes, robot.action.size)
        for engine, replay in (("MJX float32", drift_in_mjx), ("C float64", drift_in_c)):
            apart = replay(robot, start, yaw, actions)[np.array(LOOK) - 1]
            rows.append(
                {
                    "setting": f"{cone(solver)} {solver.iterations}/{solver.line_search}",
                    "engine": engine,
                    "steps": LOOK,
                    "median": np.median(apart, axis=-1),
                    "p90": np.quantile(apart, 0.9, axis=-1),
                }
            )
    return rows


# ── the tables ──────────────────────────────────────────────────────────────────────────────


def table(head: list[str], rows: list[list[str]]) -> str:
    """Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def stability_table(rows: list[dict[str, Any]]) -> str:
    """Blow-ups and speed."""
    head = ["cone, iterations/line searches", "engine", "env steps", "blow-ups", "env steps/s"]
    numbers = ("steps", "blow_ups", "steps_per_second")
    return table(
        head, [[r["setting"], r["engine"], *(f"{r[n]:,.0f}" for n in numbers)] for r in rows]
    )


def drift_table(rows: list[dict[str, Any]]) -> str:
    """Median (90th percentile), metres."""

    def cells(row: dict[str, Any]) -> list[str]:
        pairs = zip(row["median"], row["p90"], strict=True)
        return [f"{metres(m)} ({metres(p)})" for m, p in pairs]

    return table(
        ["metres after steps:", *(str(n) for n in LOOK)],
        [[f"{r['setting']}, {r['engine']}", *cells(r)] for r in rows],
    )


def metres(x: float) -> str:
    """Two digits where they can be seen, the order of magnitude where not."""
    return f"{x:.2g}" if x >= 0.01 else f"{x:.0e}"


def physics(options: Annotated[Options, tyro.conf.arg(name="")] = Options()) -> None:
    """Measures, prints the tables and writes the JSON."""
    options.check()
    before = os.getloadavg()[0]
    stable, turned = stability(options), drift(options)
    results = {
        "options": options,
        "threads": options.pool,
        # Timings of a machine that does other things beside are only indicative.
        "load": [before, os.getloadavg()[0]],
        "stability": stable,
        "drift": turned,
        **environment(),
    }
    out = options.out or Path(f"experiments/results/{options.robot}_physics.json")
    files.save_json(out, results)
    print(f"{stability_table(stable)}\n\n{drift_table(turned)}")


if __name__ == "__main__":
    guarded(physics, "Stability, speed and turnability of a robot's physics.")
