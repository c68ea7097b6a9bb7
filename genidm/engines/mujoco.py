"""MuJoCo in C, through `mujoco.batch`: the fastest engine where there is no accelerator.

Jitted programs call it with `jax.pure_callback`. What is rounded, and when: MuJoCo computes in
float64; the rows that enter and leave a control step are float32, so each control step rounds
position, velocity and warm start once. docs/physics.md says what that costs 𝒢. Rows of float64,
under `jax.enable_x64`, stay as they are.
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

# Warnings of a simulation that is lost: MuJoCo has reset it, or has set its controls to 0.
_W = mujoco.mjtWarning
LOST = [
    x.value for x in (_W.mjWARN_BADQPOS, _W.mjWARN_BADQVEL, _W.mjWARN_BADQACC, _W.mjWARN_BADCTRL)
]


class MuJoCo(Engine):
    """All lanes on one jax device, shared among threads; bits do not depend on their number.

    Args:
      spec: the model. A copy of it is given an accelerometer: MuJoCo computes contact
        wrenches only for a sensor that needs them.
      frame_skip: physics steps a control step.
      threads: that step lanes; one for each core that this process may use, unless given.
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
            raise ValueError("actuators with a state of their own are not part of Physics")
        self._frame_skip = frame_skip
        self.threads = threads or cores()
        self._rows: dict[int, _Rows] = {}
        # A Batch is for one Python thread at a time, and jax may run two programs at once.
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
        # No jax in here: a program that waits for this callback would wait for itself.
        given = np.asarray(rows)
        with self._lock:
            if len(given) not in self._rows:
                self._rows[len(given)] = _Rows(self._model, len(given), self.threads)
            return self._rows[len(given)].step(given, self._frame_skip)


class _Rows:
    """A `Batch` of n simulations, as a function of rows.

    A row is qpos, qvel, warm start and control; an answer qpos, qvel, warm start and wrenches.
    """

    def __init__(self, model: mujoco.MjModel, count: int, threads: int):
        self._batch = Batch(model, count, nthread=min(threads, count))
        self._wrenches = self._batch.bind("cfrc_ext").reshape(count, -1)
        self._time = self._batch.bind("time")
        # Neighbours in MuJoCo's own row: time, qpos, qvel, warm start and control.
        self._kept = model.nq + 2 * model.nv
        self._given = self._batch.state[:, 1 : 1 + self._kept + model.nu]

    def step(self, rows: np.ndarray, frame_skip: int) -> np.ndarray:
        batch, kept = self._batch, self._kept
        self._time[:], self._given[:] = 0.0, rows
        batch.warning[:] = 0
        lost = np.zeros(len(rows), bool)
        # MuJoCo writes warnings to a file in the working directory, unless somebody hears them.
        hearer = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(_ignore)
        try:
            batch.step(nstep=frame_skip)
        except SimulationError as error:
            lost[error.ids] = True
        finally:
            mujoco.set_mju_user_warning(hearer)
        if batch.warning[..., 1].any():
            lost |= batch.warning[:, LOST, 1].any(1)
        answers = np.empty((len(rows), kept + self._wrenches.shape[1]), rows.dtype)
        answers[:, :kept] = self._given[:, :kept]
        answers[:, kept:] = self._wrenches
        answers[lost] = np.nan
        return answers


def _ignore(message: str) -> None:
    """Lanes that are lost are counted and reported as such."""
