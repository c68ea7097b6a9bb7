"""The Engine contract: an engine steps the physics of a batch of robots.

For jax an engine is a pure function: physics and actions in, physics and readings out. It keeps
nothing between two steps. So any state can be set, lanes can be refilled, records can be
replayed (𝒢), and a killed run resumes with the same bits.

To add an engine (MuJoCo Warp, for example), write one file with a subclass of `Engine` and add it
to `genidm.engines.ENGINES`, or register it; docs/extending.md shows one. An engine has five duties:

1. `__init__(spec, frame_skip)` takes a MuJoCo model and the number of physics steps per control
   step. `step` takes and returns `Physics`.
2. `step(physics, action)` makes one control step in every lane. Jitted programs call it, so it
   uses jax operations or `jax.pure_callback`. It returns NaN in a lane whose physics is no longer
   finite, or that the engine has reset by itself; the other lanes are not affected.
3. Its readings are those of `mj_step`: contact wrenches at the start of the last physics step.
4. `segment` is the length of 𝒢's segments, measured as `experiments.physics` does.
5. `on_accelerator` and `one_device` say where it runs best.

`tests/test_engines.py` compares every engine in `ENGINES` with MuJoCo in C, number by number.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple

import flax.struct
import jax
from jax.sharding import Mesh

from genidm import devices


class Physics(flax.struct.PyTreeNode):
    """The part of a MuJoCo simulation's state that its next step depends on.

    Attributes:
      qpos: `[B, nq]`; base position (m) and quaternion, then joint angles (rad).
      qvel: `[B, nv]`; base velocity (m/s, rad/s), then joint velocities (rad/s).
      warmstart: `[B, nv]`; accelerations (m/s², rad/s²) at which the constraint solver starts.
    """

    qpos: Any
    qvel: Any
    warmstart: Any


class Stepped(NamedTuple):
    """The result of one control step.

    Attributes:
      physics: tree `[B, ...]`, after the step; NaN in a lane whose simulation failed.
      readings: quantities that only a step can measure. Engines of MuJoCo models return the
        contact wrench on every body `[B, nbody, 6]` (torque N·m, force N; world frame, about the
        centre of mass of the robot), at the start of the last physics step.
    """

    physics: Any
    readings: Any


class Engine(abc.ABC):
    """Steps a batch of lanes.

    Attributes:
      name: the value of `--engine`.
      label: name in tables, with the precision of its physics between control steps.
      on_accelerator: whether it is the default where jax has an accelerator (else: on a CPU).
      segment: control steps for which a rotated replay stays within millimetres of the record
        (docs/physics.md); the default length of 𝒢's segments.
      one_device: whether all lanes are on one jax device, because the engine distributes them
        over its own threads or processes.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    on_accelerator: ClassVar[bool] = False
    one_device: ClassVar[bool] = True
    segment: ClassVar[int] = 20

    @abc.abstractmethod
    def step(self, physics: Any, action: jax.Array) -> Stepped:
        """Makes one control step of physics `[B, ...]` under actions `[B, A]` in [−1, 1]."""

    @abc.abstractmethod
    def __str__(self) -> str:
        """The engine and its hardware, as commands print them at their start."""

    def mesh(self) -> Mesh:
        """The jax devices that share the lanes."""
        return devices.mesh(jax.devices()[:1]) if self.one_device else devices.mesh()

    def max_parallel_envs(self, lanes: int) -> int:
        """Largest batch to step together for a caller that asks for `lanes`."""
        return lanes
