"""The Minitaur in PyBullet: speed, gait and equivalence modulo orientation, by solver settings.

    python -m experiments.minitaur_physics         # minutes; docs/physics.md shows the results
    python -m experiments.minitaur_physics --num-envs 4

Speeds of one robot are in CPU time. `experiments.minitaur_processes` measures several processes.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.minitaur_processes import processes_table, vectorised
from experiments.physics import metres, table
from genidm import devices, files, symmetry
from genidm.errors import BadInput
from genidm.report.rows import made_now
from genidm.robots import Minitaur
from genidm.robots.minitaur import from_rows
from genidm.robots.minitaur_world import (
    ACTIONS,
    Simulation,
    Solver,
    has_fallen,
    parts,
    stepped,
)
from genidm.runs.command import run_cli

ORIGINAL = Solver(iterations=60, self_collision=True, cone=True)
OURS = Solver()
STEPS = 500
LOOK = (5, 10, 20, 50, 100, 200, 500)
# Random control steps before the gait, so that all robots walk differently.
SHAKEN = 5
# Repetitions of a timing; the shortest counts.
REPEATS = 10


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the measurement.

    Attributes:
      num_envs: number of robots; results are means or medians over them.
      seed: of random actions and yaws.
      out: the JSON file.
    """

    num_envs: int = 32
    seed: int = 0
    out: Path | str = Path("experiments/results/minitaur_physics.json")

    def check(self) -> None:
        """Raises BadInput if a setting is invalid."""
        if self.num_envs < 1:
            raise BadInput("--num-envs must be at least 1")


def gait() -> np.ndarray:
    """Actions `[STEPS, 8]` of a trot at 2 Hz; it walks at 0.2 m/s without a fall."""
    phase = 2 * np.pi * 2 * 0.01 * np.arange(STEPS)[:, None] + np.pi * np.array([0, 1, 1, 0])
    return np.concatenate([0.3 * np.sin(phase), 0.2 * np.cos(phase) - 0.3], axis=-1)


def shakes(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Random actions `[steps, 8]`, uniform in [−1, 1]."""
    return rng.uniform(-1, 1, (steps, ACTIONS))


# ── jobs for worker processes ───────────────────────────────────────────────────────────────


class OneByOne(Simulation):
    """Reads and commands the joints with one call per joint, as pybullet_envs does."""

    def _joints(self, joints: list[int]) -> np.ndarray:
        states = [self.bullet.getJointState(self.body, j)[:2] for j in joints]
        return np.array(states).T

    def _push(self, torques: np.ndarray) -> None:
        for joint, torque in zip(self.motors, torques, strict=True):
            self.bullet.setJointMotorControl2(
                self.body, joint, self.bullet.TORQUE_CONTROL, force=torque
            )


def hard(solver: Solver, yaw: float, actions: np.ndarray) -> np.ndarray:
    """o `[T, 3]` after each action, from a hard reset at `yaw`, without `set_state`."""
    simulation = Simulation(solver)
    simulation.reset(yaw)
    return np.array([live(simulation, action)[:3] for action in actions])


def placed(solver: Solver, row: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """o `[T, 3]` after each action, as in 𝒢: `set_state` in float32 before every step."""
    simulation, positions = Simulation(solver), []
    for action in actions:
        row = again(simulation, action, row)
        positions.append(row[:3])
    return np.array(positions)


def live(simulation: Simulation, action: np.ndarray) -> np.ndarray:
    """The row after a step from the simulation's current state."""
    simulation.step(action)
    return simulation.read()


def again(simulation: Simulation, action: np.ndarray, row: np.ndarray) -> np.ndarray:
    """The row after `set_state` to `row` and a step."""
    return stepped(simulation, np.concatenate([row, action]).astype(np.float32))


def settled(solver: Solver) -> np.ndarray:
    """The row of the settled initial state."""
    return Simulation(solver).read()


def walk(solver: Solver, anew: bool, seed: int) -> list[float]:
    """Walks once: metres ahead, mean height (m), mean pitch (rad), steps until a fall, ms per step.

    Args:
      solver: settings of Bullet.
      anew: whether the state is set before every step.
      seed: of the random steps before the gait.
    """
    simulation, rng = Simulation(solver), np.random.default_rng(seed)
    for action in 0.3 * shakes(rng, SHAKEN):
        simulation.step(action)
    row, heights, pitches = simulation.read(), [], []
    start, began = row[0], time.process_time()
    for action in gait():
        row = again(simulation, action, row) if anew else live(simulation, action)
        x = parts(row)
        if has_fallen(x["orientation"], x["position"][2]):
            break
        w, i, j, k = x["orientation"]
        heights.append(row[2])
        pitches.append(np.arcsin(2 * (w * j - k * i)))
    spent = 1e3 * (time.process_time() - began) / len(heights)
    return [row[0] - start, np.mean(heights), np.mean(pitches), len(heights), spent]


def cost(solver: Solver, batched: bool) -> float:
    """CPU time of a control step of a walking robot, ms; `batched`: one call for all joints."""
    simulation = (Simulation if batched else OneByOne)(solver)
    began = time.process_time()
    for action in gait()[:100]:
        simulation.step(action)
    return 1e3 * (time.process_time() - began) / 100


class Jobs:
    """Runs functions of this module on all cores, in worker processes."""

    def __init__(self) -> None:
        self._pool = ProcessPoolExecutor(devices.cores(), get_context("spawn"))

    def __enter__(self) -> Jobs:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()

    def __call__(self, job: Callable[..., Any], *columns: Any) -> np.ndarray:
        """Results `[n, ...]` of n jobs; each column holds one argument of all jobs."""
        return np.array(list(self._pool.map(job, *columns)))


# ── the tables ──────────────────────────────────────────────────────────────────────────────


def drift(jobs: Jobs, options: Options) -> list[dict[str, Any]]:
    """Distance of replays from rotated starts to rotated replays: a row per cone, start, action."""
    rng, rows = np.random.default_rng(options.seed), []
    yaw = rng.uniform(-np.pi, np.pi, options.num_envs)
    commands = {
        "trot": [gait()] * options.num_envs,
        "random": [shakes(rng, STEPS) for _ in range(options.num_envs)],
    }
    for cone in (False, True):
        solver = [dataclasses.replace(OURS, cone=cone)] * options.num_envs
        for start in ("hard reset", "placed"):
            for name, actions in commands.items():
                straight, turned = replays(jobs, start, solver, yaw, actions)
                exact = symmetry.rotate_vector(jnp.asarray(straight), jnp.asarray(yaw)[:, None])
                apart = np.linalg.norm(np.asarray(exact) - turned, axis=-1)[:, np.array(LOOK) - 1]
                rows.append(
                    {
                        "cone": cone, "start": start, "actions": name, "steps": LOOK,
                        "median": np.median(apart, axis=0), "p90": np.quantile(apart, 0.9, axis=0),
                    }
                )  # fmt: skip
    return rows


def replays(
    jobs: Jobs, start: str, solver: list[Solver], yaw: np.ndarray, actions: list[np.ndarray]
) -> Iterator[np.ndarray]:
    """o `[lanes, T, 3]` of two replays: from yaw 0 and from `yaw [lanes]`."""
    if start == "hard reset":
        return (jobs(hard, solver, way, actions) for way in (0 * yaw, yaw))
    row = jobs(settled, solver[:1])[0]
    physics = jax.tree.map(
        lambda x: jnp.tile(x, (len(yaw), 1)), from_rows(jnp.asarray(row, jnp.float32))
    )
    robot = Minitaur(solver[0])
    turned = (robot.rotate_physics(physics, jnp.asarray(way)) for way in (0 * yaw, yaw))
    starts = (np.concatenate(jax.tree.leaves(jax.device_get(p)), axis=-1) for p in turned)
    return (jobs(placed, solver, list(rows), actions) for rows in starts)


WALKERS = {
    "pybullet_envs' settings, live": (ORIGINAL, False),
    "the same, placed anew at each step": (ORIGINAL, True),
    "no self-collision, live": (dataclasses.replace(ORIGINAL, self_collision=False), False),
    "no self-collision, no cone, live": (OURS, False),
    "ours: the same, placed anew at each step": (OURS, True),
    "ours, 30 iterations": (dataclasses.replace(OURS, iterations=30), True),
    "ours, 20 iterations": (dataclasses.replace(OURS, iterations=20), True),
    "ours, 10 iterations": (dataclasses.replace(OURS, iterations=10), True),
}


def fidelity(jobs: Jobs, options: Options) -> list[dict[str, Any]]:
    """The same gait with different settings: mean and standard error over the lanes."""
    rows, names = [], ("ahead", "height", "pitch", "steps", "ms")
    seeds = [options.seed + lane for lane in range(options.num_envs)]
    for name, (solver, anew) in WALKERS.items():
        walks = jobs(walk, [solver] * len(seeds), [anew] * len(seeds), seeds)
        error = walks.std(0) / np.sqrt(len(walks))
        means = dict(zip(names, zip(walks.mean(0), error, strict=True), strict=True))
        rows.append({"setting": name, "solver": solver, "placed": anew, **means})
    return rows


def calls(jobs: Jobs) -> list[dict[str, Any]]:
    """CPU time (ms) of a control step, with and without batched calls and self-collision.

    The minimum over REPEATS alternating runs, one at a time, because other load only adds time.
    """
    kinds = [(collides, batched) for collides in (True, False) for batched in (False, True)]
    engines = [dataclasses.replace(OURS, self_collision=collides) for collides, _ in kinds]
    spent = [
        [
            jobs(cost, [solver], [batched])[0]
            for solver, (_, batched) in zip(engines, kinds, strict=True)
        ]
        for _ in range(REPEATS)
    ]
    return [
        {"self_collision": collides, "batched": batched, "ms": ms}
        for (collides, batched), ms in zip(kinds, np.min(spent, axis=0), strict=True)
    ]


# ── print ───────────────────────────────────────────────────────────────────────────────────


def drift_table(rows: list[dict[str, Any]]) -> str:
    """Markdown table of drift: median (90th percentile), metres."""
    lines = []
    for r in rows:
        cells = [f"{metres(m)} ({metres(p)})" for m, p in zip(r["median"], r["p90"], strict=True)]
        cone = "cone" if r["cone"] else "no cone"
        lines.append([f"{r['actions']}, {cone}, {r['start']}", *cells])
    return table(["metres after steps:", *(str(n) for n in LOOK)], lines)


def fidelity_table(rows: list[dict[str, Any]]) -> str:
    """Markdown table of gaits: means ± standard errors."""
    digits = {"ahead": 3, "height": 4, "pitch": 4, "steps": 0, "ms": 2}

    def cells(r: dict[str, Any]) -> list[str]:
        shown = [f"{r[n][0]:.{d}f} ± {r[n][1]:.{d}f}" for n, d in digits.items() if n != "ms"]
        return [r["setting"], *shown, f"{r['ms'][0]:.2f}"]

    head = ["setting", "ahead, m", "height, m", "pitch, rad", "steps of 500", "ms CPU a step"]
    return table(head, [cells(r) for r in rows])


def calls_table(rows: list[dict[str, Any]]) -> str:
    """Markdown table of CPU time, by kind of call."""
    word = {True: "on", False: "off"}
    lines = [[word[r["self_collision"]], word[r["batched"]], f"{r['ms']:.2f}"] for r in rows]
    return table(["self-collision", "batched calls", "ms CPU a step"], lines)


def minitaur_physics(options: Annotated[Options, tyro.conf.arg(name="")] = Options()) -> None:
    """Measures, prints the tables and writes the JSON."""
    options.check()
    Minitaur()  # raises BadInput if PyBullet is not installed
    before = os.getloadavg()[0]
    results = dict[str, Any]()
    with Jobs() as jobs:
        for name, rows, show in (
            ("processes", lambda: vectorised(gait()), processes_table),
            ("calls", lambda: calls(jobs), calls_table),
            ("fidelity", lambda: fidelity(jobs, options), fidelity_table),
            ("drift", lambda: drift(jobs, options), drift_table),
        ):
            results[name] = rows()
            print(show(results[name]), end="\n\n", flush=True)
    load = [before, os.getloadavg()[0]]
    files.save_json(
        options.out, {"options": options, "load": load, **results, "made": made_now(__name__)}
    )


if __name__ == "__main__":
    run_cli(minitaur_physics, "Speed, gait and equivalence modulo orientation of the Minitaur.")
