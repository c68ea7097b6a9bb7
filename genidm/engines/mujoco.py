"""MuJoCo in C, through `mujoco.batch`: the fastest engine where there is no accelerator.

Jitted programs call it with `jax.pure_callback`. MuJoCo computes in float64; the rows that enter
and leave a control step are float32, so each control step rounds position, velocity and warm
start once. docs/physics.md measures the effect on 𝒢. Rows of float64, under `jax.enable_x64`,
are not rounded.
"""

from __future__ import annotations

import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from genidm.devices import cores
from genidm.engines.base import Engine, Physics, Stepped

# Warnings after which a simulation has failed: MuJoCo has reset it or set its controls to 0.
_W = mujoco.mjtWarning
LOST = [
    x.value for x in (_W.mjWARN_BADQPOS, _W.mjWARN_BADQVEL, _W.mjWARN_BADQACC, _W.mjWARN_BADCTRL)
]


class MuJoCo(Engine):
    """Steps lanes with MuJoCo in C on several threads; their number does not change the bits.

    Args:
      spec: the model. The engine adds an accelerometer to a copy of it, because MuJoCo computes
        contact wrenches only for a sensor that needs them.
      frame_skip: physics steps per control step.
      threads: number of threads; default: one for each core that this process may use.

    Raises:
      ValueError: the model has actuators with a state of their own.
    """

    name = "mujoco"
    label = "C float32 rows"
    segment = 50

    def __init__(self, spec: mujoco.MjSpec, frame_skip: int, threads: int | None = None):
        measured = spec.copy()
        site = measured.worldbody.first_body().add_site(name="genidm")
        measured.add_sensor(
            type=mujoco.mjtSensor.mjSENS_ACCELEROMETER,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=site.name,
        )
        self._model = measured.compile()
        if self._model.na or mujoco.mj_stateSize(
            self._model, mujoco.mjtState.mjSTATE_HISTORY.value
        ):
            raise ValueError("the model has actuators with a state, which Physics does not hold")
        self._frame_skip = frame_skip
        self.threads = threads or cores()
        self._rows: dict[int, _Rows] = {}
        # Only one Python thread at a time may use a Batch, and jax may run two programs at once.
        self._lock = threading.Lock()

    def __str__(self) -> str:
        return f"MuJoCo in C on {self.threads} thread{'s' if self.threads > 1 else ''}"

    def step(self, physics: Physics, action: jax.Array) -> Stepped:
        m = self._model
        action = jnp.clip(action, -1.0, 1.0).astype(physics.qpos.dtype)
        rows = jnp.concatenate([physics.qpos, physics.qvel, physics.warmstart, action], axis=-1)
        width = m.nq + 2 * m.nv + 6 * m.nbody
        size = jax.ShapeDtypeStruct((len(rows), width), rows.dtype)
        after = jax.pure_callback(self._step_rows, size, rows)
        ends = np.cumsum([m.nq, m.nv, m.nv])
        *parts, wrenches = jnp.split(after, ends, axis=-1)
        return Stepped(Physics(*parts), wrenches.reshape(len(rows), m.nbody, 6))

    def _step_rows(self, rows: jax.Array) -> np.ndarray:
        # No jax operations here: the program that waits for this callback would deadlock.
        given = np.asarray(rows)
        with self._lock:
            if len(given) not in self._rows:
                self._rows[len(given)] = _Rows(self._model, len(given), self.threads)
            return self._rows[len(given)].step(given, self._frame_skip)


class _Rows:
    """A `Batch` of n simulations as a function of rows.

    An input row holds qpos, qvel, warm start and control; an output row holds qpos, qvel, warm
    start and wrenches.
    """

    def __init__(self, model: mujoco.MjModel, count: int, threads: int):
        self._batch = Batch(model, count, nthread=min(threads, count))
        self._wrenches = self._batch.bind("cfrc_ext").reshape(count, -1)
        self._time = self._batch.bind("time")
        # MuJoCo's own row holds, in this order: time, qpos, qvel, warm start, control.
        self._kept = model.nq + 2 * model.nv
        self._given = self._batch.state[:, 1 : 1 + self._kept + model.nu]

    def step(self, rows: np.ndarray, frame_skip: int) -> np.ndarray:
        batch, kept = self._batch, self._kept
        self._time[:], self._given[:] = 0.0, rows
        batch.warning[:] = 0
        lost = np.zeros(len(rows), bool)
        # Without a handler, MuJoCo writes warnings to a file in the working directory.
        handler = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(_ignore)
        try:
            batch.step(nstep=frame_skip)
        except SimulationError as error:
            lost[error.ids] = True
        finally:
            mujoco.set_mju_user_warning(handler)
        if batch.warning[..., 1].any():
            lost |= batch.warning[:, LOST, 1].any(1)
        answers = np.empty((len(rows), kept + self._wrenches.shape[1]), rows.dtype)
        answers[:, :kept] = self._given[:, :kept]
        answers[:, kept:] = self._wrenches
        answers[lost] = np.nan
        return answers


def _ignore(message: str) -> None:
    """Drops a warning: a failed simulation is already reported as a lane of NaN."""
