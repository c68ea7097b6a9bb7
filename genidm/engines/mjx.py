"""MJX: MuJoCo's physics as jax operations, in float32, on the devices of jax."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco

from genidm import devices
from genidm.engines.base import Engine, Physics, Stepped
from genidm.quiet import mjx


class MJX(Engine):
    """Steps lanes with MJX, each jax device its own lanes; programs compile in 8 to 40 s.

    Args:
      spec: the model.
      frame_skip: physics steps per control step.
    """

    name = "mjx"
    label = "MJX float32"
    on_accelerator = True
    one_device = False

    def __init__(self, spec: mujoco.MjSpec, frame_skip: int):
        devices.spread()
        model = spec.compile()
        self._frame_skip = frame_skip
        self._model = mjx.put_model(model, impl="jax")
        self._template = mjx.make_data(model, impl="jax")

    def __str__(self) -> str:
        kind, count = jax.devices()[0].device_kind, jax.device_count()
        return f"MJX on {count} jax device{'s' if count > 1 else ''} ({kind})"

    def max_parallel_envs(self, lanes: int) -> int:
        """At least `lanes`; on an accelerator more, because small batches leave it idle."""
        return devices.max_parallel_envs(lanes)

    def step(self, physics: Physics, action: jax.Array) -> Stepped:
        return jax.vmap(self._step)(physics, action)

    def _step(self, physics: Physics, action: jax.Array) -> Stepped:
        data = self._template.replace(
            qpos=physics.qpos,
            qvel=physics.qvel,
            qacc_warmstart=physics.warmstart,
            ctrl=jnp.clip(action, -1.0, 1.0).astype(physics.qpos.dtype),
        )
        data = jax.lax.fori_loop(0, self._frame_skip, lambda _, d: mjx.step(self._model, d), data)
        wrenches = mjx.rne_postconstraint(self._model, data)._impl.cfrc_ext
        return Stepped(Physics(data.qpos, data.qvel, data.qacc_warmstart), wrenches)
