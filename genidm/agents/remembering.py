"""Checkpoints that write each row of a replay buffer only once.

A buffer is far larger than the rest of a learner, and only few of its rows are new at each
checkpoint. So the new rows are saved as a separate part. A checkpoint lists the parts of its
buffer. A part is deleted when the buffer holds none of its rows any more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from genidm.agents.buffer import Buffer, newest
from genidm.checkpoints import Checkpoints


class Remembering:
    """`Checkpoints` for a tree that holds at most one Buffer."""

    def __init__(self, checkpoints: Checkpoints):
        self.checkpoints = checkpoints
        self._parts: list[str] = []

    def save(self, step: int, tree: Any) -> None:
        """See `Checkpoints.save`; of the buffer, write only the rows since the last checkpoint."""
        for buffer in buffers(tree):
            self.append(buffer)
        self.checkpoints.save(step, emptied(tree), self._parts)

    def append(self, buffer: Buffer) -> None:
        written, max_replay_size = int(buffer.written), buffer.rows.last.shape[0]
        since = max(written - max_replay_size, _span(self._parts[-1])[1] if self._parts else 0)
        self._parts = [part for part in self._parts if _span(part)[1] > written - max_replay_size]
        if since < written:
            rows = newest(buffer, written - since)
            name = f"{since:010d}_{written:010d}"
            arrays = {field: x for field, x in vars(rows).items() if x is not None}
            self.checkpoints.save_part(name, arrays)
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
        """Load the rows of an emptied buffer from its parts."""
        rows = jax.tree.map(lambda x: np.zeros(x.shape[1:], x.dtype), buffer.rows)
        for part in self._parts:
            at = np.arange(*_span(part)) % len(rows.last)
            for field, x in self.checkpoints.load_part(part).items():
                getattr(rows, field)[at] = x
        return buffer.replace(rows=rows)


def _span(part: str) -> tuple[int, int]:
    """Numbers of the first row of a part and of the row after its last, since the start."""
    first, end = part.split("_")
    return int(first), int(end)


def _is_buffer(x: Any) -> bool:
    return isinstance(x, Buffer)


def buffers(tree: Any) -> list[Buffer]:
    """The replay buffers in a tree."""
    return [x for x in jax.tree.leaves(tree, is_leaf=_is_buffer) if _is_buffer(x)]


def emptied(tree: Any) -> Any:
    """The tree with arrays `[0, T, B, ...]` as rows of its buffers: they keep only the shapes."""
    return _exchanged(tree, lambda b: b.replace(rows=jax.tree.map(_no_elements, b.rows)))


def _no_elements(x: Any) -> np.ndarray:
    return np.zeros((0, *x.shape), x.dtype)


def _exchanged(tree: Any, new: Callable[[Buffer], Buffer]) -> Any:
    return jax.tree.map(lambda x: new(x) if _is_buffer(x) else x, tree, is_leaf=_is_buffer)
