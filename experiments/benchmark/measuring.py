"""One number, measured again and again, in turns with another."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np

T = TypeVar("T")


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
