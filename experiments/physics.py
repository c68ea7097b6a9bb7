"""Stability, speed and equivalence modulo orientation of a robot's physics, by solver settings.

    python -m experiments.physics                  # minutes; docs/physics.md shows the results
    python -m experiments.physics --robot humanoid
    python -m experiments.physics --steps 20000    # a quick look

Actions are random: every torque is at full strength, with a new random sign in every control step.
A blow-up is a number that is not finite, a velocity beyond 1000 (m/s or rad/s), or an automatic
reset by MuJoCo in C. A robot is reset after a blow-up.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from genidm import devices, files, symmetry
from genidm.engines import ENGINES, Physics
from genidm.engines.mujoco import MuJoCo
from genidm.errors import BadInput
from genidm.progress import Progress, compile_ahead
from genidm.report.rows import made_now
from genidm.robots import ROBOTS, State
from genidm.robots.base import select
from genidm.robots.mujoco import MujocoRobot, Solver
from genidm.runs.command import run_cli

OURS = Solver(iterations=4, line_search=8, elliptic=True)
SETTINGS = (
    Solver(iterations=1, line_search=4, elliptic=False),  # Brax's own
    Solver(iterations=4, line_search=8, elliptic=False),
    Solver(iterations=2, line_search=6, elliptic=True),
    OURS,
)


class Precision(NamedTuple):
    """An engine, and the dtype of its physics between control steps.

    Attributes:
      name: name in the tables.
      engine: name of the engine.
      dtype: of position, velocity and warm start between control steps.
    """

    name: str
    engine: str
    dtype: str


UNROUNDED = Precision("C float64 rows", MuJoCo.name, "float64")

# The share of `Options.steps` for settings other than OURS.
OTHERS = 0.128
EPISODE = 200  # control steps
TOO_FAST = 1e3  # m/s or rad/s
# Control steps before a replay starts, and after which the replays are compared.
WARM_UP = 20
LOOK = (5, 10, 20, 30, 50, 100, 200)


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the measurement.

    Attributes:
      robot: name of a robot with a MuJoCo model.
      steps: control steps with the setting elliptic 4/8; the other settings get 0.128 of them.
      num_envs: number of robots; a multiple of the number of devices.
      seed: of initial states, actions and yaws.
      out: the JSON file; default: experiments/results/ROBOT_physics.json.
    """

    robot: str = "ant"
    steps: int = 1_000_000
    num_envs: int = 128
    seed: int = 0
    out: Path | str | None = None

    def check(self) -> None:
        """Raises BadInput if a setting is invalid."""
        modelled = [name for name, kind in ROBOTS.items() if issubclass(kind, MujocoRobot)]
        if self.robot not in modelled:
            raise BadInput(f"--robot must be {', '.join(modelled)}, not {self.robot!r}")
        if min(self.steps, self.num_envs) < 1:
            raise BadInput("--steps and --num-envs must be at least 1")
        if self.num_envs % (count := jax.device_count()):
            raise BadInput(f"--num-envs must be a multiple of {count}, the number of devices")

    def with_solver(self, solver: Solver, engine: str) -> MujocoRobot:
        """Makes the robot with this engine and these solver settings."""
        kind: Any = ROBOTS[self.robot]
        return kind(solver=solver, engine=engine)

    def episodes(self, solver: Solver) -> int:
        """Episodes per lane for a setting: its share of `steps`, rounded up."""
        steps = self.steps if solver == OURS else OTHERS * self.steps
        return math.ceil(steps / (self.num_envs * EPISODE))


def as_run() -> list[Precision]:
    """Every engine, with float32 between control steps, as in all experiments."""
    return [Precision(engine.label, name, "float32") for name, engine in ENGINES.items()]


def setting(solver: Solver) -> str:
    """Text for solver settings: friction cone, iterations and line searches, as "elliptic 4/8"."""
    cone = "elliptic" if solver.elliptic else "pyramidal"
    return f"{cone} {solver.iterations}/{solver.line_search}"


def full_torques(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Random actions `[..., A]`, each −1 or 1."""
    return jax.random.rademacher(key, shape, dtype=jnp.float32)


# ── stability and speed ─────────────────────────────────────────────────────────────────────


def endure(robot: MujocoRobot, name: str, episodes: int, options: Options) -> dict[str, float]:
    """Steps a robot with random actions and counts blow-ups, on the engine's own devices.

    Returns:
      `steps` (control steps), `blow_ups` (their number) and `seconds` (wall time).
    """
    mesh = robot.mesh()
    seeds = jax.random.split(jax.random.key(options.seed), episodes)
    lanes = [devices.put(jax.random.split(seed, options.num_envs), mesh) for seed in seeds]
    program = jax.jit(devices.over_lanes(shaken(robot), mesh, [0], 0))
    run = compile_ahead(name, program, lanes[0])
    run(lanes[0]).block_until_ready()  # not timed, because the first call allocates memory
    blow_ups, began = 0, time.perf_counter()
    with Progress(name, episodes * EPISODE * options.num_envs, "steps") as bar:
        for keys in lanes:
            blow_ups += int(run(keys).sum())
            bar.advance(EPISODE * options.num_envs)
    seconds = time.perf_counter() - began
    return {
        "steps": episodes * EPISODE * options.num_envs,
        "blow_ups": blow_ups,
        "seconds": seconds,
    }


def shaken(robot: MujocoRobot) -> Callable[[jax.Array], jax.Array]:
    """A function that maps keys `[B]` to the number of blow-ups `[B]` in an episode."""

    def step(state: State, keys: jax.Array) -> tuple[State, jax.Array]:
        after = robot.step(state, jax.vmap(full_torques, (0, None))(keys, (robot.action.size,)))
        lost = after.diverged | (jnp.abs(after.physics.qvel) > TOO_FAST).any(-1)
        return select(lost, robot.reset(keys, jnp.zeros(keys.shape)), after), lost

    def episode(keys: jax.Array) -> jax.Array:
        streams = jax.vmap(lambda key: jax.random.split(key, EPISODE + 1))(keys)
        start = robot.reset(streams[:, 0], jnp.zeros(keys.shape))
        return jax.lax.scan(step, start, streams[:, 1:].T)[1].sum(0)

    return episode


def stability(options: Options) -> list[dict[str, Any]]:
    """Measures stability and speed: a row for each setting and engine."""
    rows = []
    for solver in SETTINGS:
        for precision in as_run():
            robot = options.with_solver(solver, precision.engine)
            name = f"{setting(solver)} {precision.name}"
            row = endure(robot, name, options.episodes(solver), options)
            speed = row["steps"] / row["seconds"]
            what = {"setting": setting(solver), "engine": precision.name}
            rows.append({**what, **row, "steps_per_second": speed})
    return rows


# ── equivalence modulo orientation ──────────────────────────────────────────────────────────


def walked(
    robot: MujocoRobot, physics: Physics, yaw: jax.Array, actions: jax.Array
) -> tuple[Physics, jax.Array]:
    """Physics `[B, ...]` after actions `[T, B, A]` from a rotated state, and o `[T, B, 3]`."""

    def step(state: State, action: jax.Array) -> tuple[State, jax.Array]:
        state = robot.step(state, action)
        return state, state.position

    state, positions = jax.lax.scan(step, robot.set_state(physics, yaw), actions)
    return state.physics, positions


def starts(options: Options) -> Physics:
    """Physics `[B, ...]` after WARM_UP random control steps, in float32."""
    robot = options.with_solver(OURS, MuJoCo.name)
    fresh, shakes = jax.random.split(jax.random.key(options.seed))
    still = jnp.zeros(options.num_envs)
    state = robot.reset(jax.random.split(fresh, options.num_envs), still)
    actions = full_torques(shakes, (WARM_UP, options.num_envs, robot.action.size))
    shake = jax.jit(functools.partial(walked, robot))
    return jax.tree.map(np.asarray, shake(state.physics, still, actions)[0])


def drift(
    robot: MujocoRobot, dtype: str, start: Physics, yaw: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """Metres `[T, B]` between the replay from the rotated start and the rotated replay."""

    def walk(physics: Physics, yaw: jax.Array, actions: jax.Array) -> jax.Array:
        return walked(robot, physics, yaw, actions)[1]

    run = jax.jit(devices.over_lanes(walk, robot.mesh(), [0, 0, 1], 1))
    with jax.enable_x64(dtype == "float64"):
        start, turn, a = jax.tree.map(lambda x: jnp.asarray(x, dtype), (start, yaw, actions))
        exact = symmetry.rotate_vector(run(start, jnp.zeros_like(turn), a), turn)
        return np.linalg.norm(run(start, turn, a) - exact, axis=-1)


def drifts(options: Options) -> list[dict[str, Any]]:
    """Measures drift: for each cone and precision, median and 90th percentile over the lanes."""
    start, rng = starts(options), np.random.default_rng(options.seed + 1)
    yaw = rng.uniform(-np.pi, np.pi, options.num_envs)
    rows = []
    for solver in (s for s in SETTINGS if s.iterations == OURS.iterations):
        for precision in (*as_run(), UNROUNDED):
            robot = options.with_solver(solver, precision.engine)
            shape = (max(LOOK), options.num_envs, robot.action.size)
            actions = np.asarray(full_torques(jax.random.key(options.seed + 2), shape))
            apart = drift(robot, precision.dtype, start, yaw, actions)[np.array(LOOK) - 1]
            rows.append(
                {
                    "setting": setting(solver),
                    "engine": precision.name,
                    "steps": LOOK,
                    "median": np.median(apart, axis=-1),
                    "p90": np.quantile(apart, 0.9, axis=-1),
                }
            )
    return rows


# ── the tables ──────────────────────────────────────────────────────────────────────────────


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def stability_table(rows: list[dict[str, Any]]) -> str:
    """Markdown table of blow-ups and speed."""
    head = ["cone, iterations/line searches", "engine", "env steps", "blow-ups", "env steps/s"]
    numbers = ("steps", "blow_ups", "steps_per_second")
    return table(
        head, [[r["setting"], r["engine"], *(f"{r[n]:,.0f}" for n in numbers)] for r in rows]
    )


def drift_table(rows: list[dict[str, Any]]) -> str:
    """Markdown table of drift: median (90th percentile), metres."""

    def cells(row: dict[str, Any]) -> list[str]:
        pairs = zip(row["median"], row["p90"], strict=True)
        return [f"{metres(m)} ({metres(p)})" for m, p in pairs]

    return table(
        ["metres after steps:", *(str(n) for n in LOOK)],
        [[f"{r['setting']}, {r['engine']}", *cells(r)] for r in rows],
    )


def metres(x: float) -> str:
    """Formats metres: two digits from 0.01 m on, below it one digit and an exponent."""
    return f"{x:.2g}" if x >= 0.01 else f"{x:.0e}"


def physics(options: Annotated[Options, tyro.conf.arg(name="")] = Options()) -> None:
    """Measures, prints the tables and writes the JSON."""
    options.check()
    before = os.getloadavg()[0]
    stable, turned = stability(options), drifts(options)
    results = {
        "options": options,
        "engines": {p.name: str(options.with_solver(OURS, p.engine).engine) for p in as_run()},
        # Under other load the timings are only indicative.
        "load": [before, os.getloadavg()[0]],
        "stability": stable,
        "drift": turned,
        "made": made_now(__name__, "genidm.engines.mjx", "genidm.engines.mujoco"),
    }
    out = options.out or Path(f"experiments/results/{options.robot}_physics.json")
    files.save_json(out, results)
    print(f"{stability_table(stable)}\n\n{drift_table(turned)}")


if __name__ == "__main__":
    run_cli(physics, "Stability, speed and equivalence modulo orientation of a robot's physics.")
