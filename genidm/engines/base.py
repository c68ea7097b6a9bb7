"""The Engine contract: how physics is stepped, for a robot that says what it is.

An engine is pure as seen from jax: physics rows and actions in, rows and readings out, and
nothing is kept between two steps. So any state can be set, lanes can be refilled, records can
be replayed (𝒢), and a run that was killed goes on with the same bits.

To add an engine (MuJoCo Warp, say), write one file with a subclass of `Engine`, and name it in
`genidm.engines.ENGINES`; docs/extending.md shows one. It has to do five things:

1. `__init__(spec, frame_skip)`: take a MuJoCo model and the number of physics steps in a control
   step. `Physics` is what it is given and gives back.
2. `step(physics, action)`: make one control step of every lane. It is called inside jitted
   programs, so it is either made of jax operations or a `jax.pure_callback`. A lane whose
   physics leaves the finite numbers, or that the engine resets by itself, comes back as NaN;
   the other lanes are not touched by it.
3. Say the moment of its readings: contact wrenches belong to the start of the last physics
   step, as in `mj_step`.
4. Say how long 𝒢's segments may be (`segment`), measured as `experiments.physics` does.
5. Say where it runs best: `on_accelerator`, and `one_device` if it has threads or processes of
   its own.

`tests/test_engines.py` holds every engine in `ENGINES` against MuJoCo in C, number by number.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple

import flax.struct
import jax
from jax.sharding import Mesh

from genidm import devices


class Physics(flax.struct.PyTreeNode):
    """All of a MuJoCo simulation that its next step depends on.

    Attributes:
      qpos: `[B, nq]`; base position (m) and quaternion, then joint angles (rad).
      qvel: `[B, nv]`; base velocity (m/s, rad/s), then joint velocities (rad/s).
      warmstart: `[B, nv]`; accelerations that the constraint solver starts from.
    """

    qpos: Any
    qvel: Any
    warmstart: Any


class Stepped(NamedTuple):
    """What an engine makes of one control step.

    Attributes:
      physics: tree `[B, ...]`, after the step; NaN in a lane that was lost.
      readings: what only a step can measure. Engines of MuJoCo models give the contact wrench on
        every body `[B, nbody, 6]` (torque N·m, force N; world frame, about the centre of mass
        of the robot), at the start of the last physics step.
    """

    physics: Any
    readings: Any


class Engine(abc.ABC):
    """Steps a batch of lanes.

    Attributes:
      name: as `--engine` takes it.
      label: what tables call it, with the precision of its rows.
      on_accelerator: whether it is the one to choose where jax has an accelerator.
      segment: control steps that a turned replay stays within millimetres of the record for
        (docs/physics.md): the segments of 𝒢, unless the user gives their length.
      one_device: whether all lanes lie on one jax device, because the engine shares them among
        threads or processes of its own.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    on_accelerator: ClassVar[bool] = False
    one_device: ClassVar[bool] = True
    segment: ClassVar[int] = 20

    @abc.abstractmethod
    def step(self, physics: Any, action: jax.Array) -> Stepped:
        """One control step of physics `[B, ...]` under actions `[B, A]` in [−1, 1]."""

    @abc.abstractmethod
    def __str__(self) -> str:
        """What it is and what it runs on, as it is printed at the start of a command."""

    def mesh(self) -> Mesh:
        """The devices that share the lanes."""
        return devices.mesh(jax.devices()[:1]) if self.one_device else devices.mesh()

    def max_parallel_envs(self, lanes: int) -> int:
        """Largest batch to step together for a caller that asks for `lanes`."""
        return lanes
