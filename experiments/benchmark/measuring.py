"""Repeated measurements of one number, alternating with other numbers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np

T = TypeVar("T")


class Skip(Exception):
    """A row cannot be measured here; the message gives the reason."""


class Probe(NamedTuple):
    """A repeatable measurement of one number.

    Attributes:
      sample: measures the number once, in the given seconds.
      note: sizes and devices, shown after the row's name.
    """

    sample: Callable[[float], float]
    note: str


def timed(call: Callable[[], object], amount: float) -> Callable[[float], float]:
    """Makes a function that measures the work per second of `call`, in the given seconds.

    Args:
      call: does `amount` of work, and returns when it is done.
      amount: work per call.
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
    """Makes a call that applies `step` to the result of the previous call."""

    def call() -> None:
        nonlocal carry
        carry = jax.block_until_ready(step(carry))

    return call


def interleave(probes: Sequence[Probe], seconds: float, rounds: int) -> np.ndarray:
    """Samples `[rounds, probes]`: every probe once per round.

    Every second round has the reverse order, so that a steady drift affects all probes equally.
    The first round always runs; later rounds start only within the given seconds.
    """
    began, table = time.perf_counter(), list[list[float]]()
    share = seconds / (rounds * len(probes))
    while len(table) < rounds and (not table or time.perf_counter() - began < seconds):
        turn = 1 if len(table) % 2 == 0 else -1
        table.append([probe.sample(share) for probe in probes[::turn]][::turn])
    return np.asarray(table)
