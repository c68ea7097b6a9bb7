"""The rows of each robot, and their selection by name."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence

from experiments.benchmark.collecting import (
    acting,
    collecting,
    unrecorded,
    updating,
    walking,
    writing,
)
from experiments.benchmark.comparing import Row
from experiments.benchmark.evaluating import evaluating, retracing, tested
from experiments.benchmark.fitting import fitting, multiplying
from experiments.benchmark.others import baseline, envpool
from experiments.benchmark.replaying import generalizing
from experiments.benchmark.starting import starting
from experiments.benchmark.stepping import batch, limit, stepping
from genidm.agents.frozen import Frozen
from genidm.errors import BadInput
from genidm.paper.methods import (
    GE,
    HER_DE,
    HER_SP,
    LR,
    RL,
    RS,
    WALK,
    InverseDynamics,
    Method,
    by_name,
    without_mirror,
)


def _plain(method: InverseDynamics) -> InverseDynamics:
    """The method with the paper's agent and task, as other libraries have them."""
    return dataclasses.replace(method, agent=without_mirror(method.agent), task=WALK)


def _of_humanoid(name: str) -> InverseDynamics:
    method = by_name(name, "humanoid")
    assert isinstance(method, InverseDynamics)
    return _plain(method)


_P = functools.partial  # rows with the same partial object share its probe, which compiles once
_MJX = _P(stepping, engine="mjx")
# The limit of every row that steps the robot: its own engine alone.
_OWN, _OWN_WIDE = "own engine, raw", "own engine, raw, wide"
_STEERED = "own engine, raw, steered"
_RL = _plain(RL)
_PPO = _P(collecting, method=_RL)
_WALKER = _of_humanoid("RL")
assert isinstance(_WALKER.agent, Frozen)
_SAC: Method = dataclasses.replace(_WALKER, name="SAC", agent=_WALKER.agent.agent)


def _starts(name: str, what: str, unit: str) -> tuple[Row, Row]:
    """The rows of one of the numbers that `start` prints."""
    first, second = (_P(starting, second=second, what=what) for second in (False, True))
    base = Row(f"first start, {name}", unit, first, rounds=1)
    return base, Row(f"second start, {name}", unit, second, base.name, 1)


def _halves(method: Method) -> tuple[Row, Row, Row]:
    """The rows of an off-policy learner: updates alone, stepping alone, and both."""
    learning = Row(f"{method.name}'s learning alone", "steps/s", _P(updating, method=method))
    walk = Row(f"{method.name}'s stepping alone", "steps/s", _P(walking, method=method), _OWN)
    loop = Row(
        f"collecting, {method.name}", "steps/s", _P(collecting, method=method), learning.name
    )
    return learning, walk, loop


def _fits(method: InverseDynamics) -> tuple[Row, Row]:
    """The rows of a method's fit: its matrix products alone, and all of it."""
    name, settings = f"fit of {method.name}", method.fit
    products = Row(f"{name}, products alone", "updates/s", _P(multiplying, settings=settings))
    return products, Row(name, "updates/s", _P(fitting, settings=settings), products.name)


_STEPPING = (
    Row("raw mujoco.batch", "steps/s", _P(batch)),
    Row("raw mujoco.batch, wide", "steps/s", _P(batch, wide=True)),
    Row("raw mujoco.batch, one thread", "steps/s", _P(batch, threads=1)),
    Row(
        "raw mujoco.batch, two threads",
        "steps/s",
        _P(batch, threads=2),
        "raw mujoco.batch, one thread",
    ),
    Row("MuJoCo in C", "steps/s", _P(stepping, engine="mujoco"), "raw mujoco.batch"),
    Row(
        "MuJoCo in C, wide",
        "steps/s",
        _P(stepping, engine="mujoco", wide=True),
        "raw mujoco.batch, wide",
    ),
    Row("raw MJX", "steps/s", _MJX, "MuJoCo in C"),
    Row("raw MJX, wide", "steps/s", _P(stepping, engine="mjx", wide=True), "MuJoCo in C, wide"),
    Row("raw MJX, one device", "steps/s", _P(stepping, engine="mjx", count=1)),
    Row(
        "raw MJX, two devices",
        "steps/s",
        _P(stepping, engine="mjx", count=2),
        "raw MJX, one device",
    ),
    Row("raw MJX, all devices", "steps/s", _MJX, "raw MJX, one device"),
    Row(_OWN, "steps/s", _P(limit)),
    Row(_OWN_WIDE, "steps/s", _P(limit, wide=True)),
    Row("collecting, random actions", "steps/s", _P(collecting, method=RS), _OWN),
)
_RUNNING = (
    Row("𝒢", "steps/s", _P(generalizing), _OWN_WIDE),
    Row("𝒢, its program alone", "steps/s", _P(generalizing, program_alone=True), _OWN_WIDE),
    Row(_STEERED, "steps/s", retracing),
    Row("evaluation", "lane-steps/s", evaluating, _STEERED),
    Row("evaluation, all", "lane-steps", _P(tested, useful=False), rounds=1),
    Row("evaluation, useful", "lane-steps", _P(tested, useful=True), "evaluation, all", 1),
)
ANT: tuple[Row, ...] = (
    *_STEPPING,
    Row("EnvPool's Ant", "steps/s", _P(envpool), "MuJoCo in C"),
    Row("EnvPool's Ant, wide", "steps/s", _P(envpool, wide=True), "MuJoCo in C, wide"),
    Row("collecting, PPO", "steps/s", _PPO, _OWN),
    Row("collecting, PPO's stepping alone", "steps/s", _P(walking, method=_RL), _OWN),
    Row("PPO, record dropped", "steps/s", _P(unrecorded, method=_RL)),
    Row("PPO, record kept", "steps/s", _PPO, "PPO, record dropped"),
    Row("writing the record", "steps/s", writing, "collecting, PPO"),
    *_halves(HER_SP),
    *_halves(HER_DE),
    *_RUNNING,
    *_fits(LR),
    *_fits(GE),
    Row("PPO of Stable-Baselines3 on gymnasium's Ant-v5", "steps/s", baseline),
    Row("PPO", "steps/s", _PPO, "PPO of Stable-Baselines3 on gymnasium's Ant-v5"),
    *_starts("compiling", "seconds", "s"),
    *_starts("all", "wall", "s"),
    *_starts("compiled", "programs", "programs"),
)
HUMANOID: tuple[Row, ...] = (
    *_STEPPING,
    *_halves(_SAC),
    Row("SAC, learning", "steps/s", _P(collecting, method=_SAC), _OWN),
    Row("SAC, frozen", "steps/s", _P(acting, method=_WALKER), _OWN),
    *_RUNNING,
    *_fits(_of_humanoid("LR")),
    *_fits(_of_humanoid("GE")),
)
OTHERS: tuple[Row, ...] = (
    *_STEPPING,
    Row("collecting, PPO", "steps/s", _PPO, _OWN),
    *_RUNNING,
    *_fits(LR),
    *_fits(GE),
)
"""Rows of any other robot with a MuJoCo model."""
ROWS = {"ant": ANT, "humanoid": HUMANOID}
"""Robot → its rows, which depend on its agents and on the libraries to compare with."""


def choose(texts: Sequence[str], rows: Sequence[Row]) -> list[Row]:
    """Selects rows by name, with the rows that they are compared with.

    Args:
      texts: names of rows, or parts of names; empty: all rows.
      rows: the rows to select from.

    Raises:
      BadInput: no name contains one of the texts.
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
