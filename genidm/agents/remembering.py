"""Checkpoints of a learner that may hold a replay buffer, whose rows are written once.

A buffer is far larger than all else that a learner is, and little of it is new from one
checkpoint to the next. So what is new lies beside the checkpoints in parts, each the rows of one
stretch of time; a checkpoint names the parts that make up its buffer, and a part goes when all
its rows have been written over.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from genidm.agents.buffer import Buffer, newest
from genidm.checkpoints import Checkpoints


class Remembering:
    """What `Checkpoints` does, for a tree that holds one Buffer at most."""

    def __init__(self, checkpoints: Checkpoints):
        self.checkpoints = checkpoints
        self._parts: list[str] = []

    def save(self, step: int, tree: Any) -> None:
        """See `Checkpoints.save`; of the buffer only what is new since the last one is written."""
        for buffer in buffers(tree):
            self._append(buffer)
        self.checkpoints.save(step, emptied(tree), self._parts)

    def _append(self, buffer: Buffer) -> None:
        written, max_replay_size = int(buffer.written), buffer.rows.last.shape[0]
        since = max(written - max_replay_size, _span(self._parts[-1])[1] if self._parts else 0)
        self._parts = [part for part in self._parts if _span(part)[1] > written - max_replay_size]
        if since < written:
            rows = newest(buffer, written - since)
            name = f"{since:010d}_{written:010d}"
            there = {field: x for field, x in vars(rows).items() if x is not None}
            self.checkpoints.save_part(name, there)
            self._parts.append(name)

    def latest(self, like: Any) -> tuple[int, Any] | None:
        """See `Checkpoints.latest`."""
        found = self.checkpoints.latest(emptied(like))
        if found is None:
            return None
        step, tree = found
        self._parts = list(self.checkpoints.parts(step))
        return step, _exchanged(tree, self._filled)

    def _filled(self, buffer: Buffer) -> Buffer:
        """An emptied buffer with its rows."""
        rows = jax.tree.map(lambda x: np.zeros(x.shape[1:], x.dtype), buffer.rows)
        for part in self._parts:
            at = np.arange(*_span(part)) % len(rows.last)
            for field, x in self.checkpoints.load_part(part).items():
                getattr(rows, field)[at] = x
        return buffer.replace(rows=rows)


def _span(part: str) -> tuple[int, int]:
    """The first row of a part, and the one after its last, of all that were ever written."""
    first, end = part.split("_")
    return int(first), int(end)


def _is_buffer(x: Any) -> bool:
    return isinstance(x, Buffer)


def buffers(tree: Any) -> list[Buffer]:
    """The replay buffers in a tree."""
    return [x for x in jax.tree.leaves(tree, is_leaf=_is_buffer) if _is_buffer(x)]


def emptied(tree: Any) -> Any:
    """The tree with `[0, T, B, ...]` for the rows of its buffers: their shapes and no more."""
    return _exchanged(tree, lambda b: b.replace(rows=jax.tree.map(_no_elements, b.rows)))


def _no_elements(x: Any) -> np.ndarray:
    return np.zeros((0, *x.shape), x.dtype)


def _exchanged(tree: Any, new: Callable[[Buffer], Buffer]) -> Any:
    return jax.tree.map(lambda x: new(x) if _is_buffer(x) else x, tree, is_leaf=_is_buffer)
