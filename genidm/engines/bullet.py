"""PyBullet in local worker processes; a `Pool` carries the rows."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from genidm.engines.base import Engine, Stepped
from genidm.engines.pool import Pool

# Robots per process and step. A step then takes 2 % longer than its slowest process; with 16
# robots 3 %, with 4 robots 12 %. More robots gain nothing.
KEEP_BUSY = 32


class Bullet(Engine):
    """Steps physics that is rows `[B, width]` of float32; there are no readings.

    Args:
      command: the program that a worker runs, and its arguments.
      width: numbers in a row of physics.
      processes: number of workers; default: one for each core that this process may use.
      patience: seconds that a worker may take for one request.

    Attributes:
      pool: the workers.
    """

    name = "bullet"
    label = "Bullet float32 rows"

    def __init__(self, command: Sequence[str], width: int, processes: int | None, patience: float):
        self.width = width
        self.pool = Pool(command, width, processes, patience)

    def __str__(self) -> str:
        count = self.pool.workers
        return f"PyBullet in {count} process{'es' if count > 1 else ''}"

    def max_parallel_envs(self, lanes: int) -> int:
        """At most what keeps the processes busy: finished lanes cost physics steps, too."""
        return min(lanes, KEEP_BUSY * self.pool.workers)

    def step(self, physics: jax.Array, action: jax.Array) -> Stepped:
        rows = jnp.concatenate([physics, action.astype(physics.dtype)], axis=-1)
        size = jax.ShapeDtypeStruct((len(rows), self.width), jnp.float32)
        after = jax.pure_callback(self._step_rows, size, rows.astype(jnp.float32))
        return Stepped(after.astype(rows.dtype), ())

    def _step_rows(self, rows: jax.Array) -> np.ndarray:
        return self.pool.map(np.asarray(rows))
