"""The Robot contract: a batch of lanes, each with one robot in it.

Agents, 𝒢 and the evaluator know robots through this alone. A robot is pure: state in,
state out, so the caller may jit, scan, shard or replay it at will.
"""

from __future__ import annotations

import abc
from collections.abc import Collection
from typing import Any, ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.sharding import Mesh

from genidm import devices
from genidm.checks import check_value, label
from genidm.engines.base import Engine
from genidm.errors import BadInput
from genidm.symmetry import Layout


class State(flax.struct.PyTreeNode):
    """B robots after a reset, a step, or a placing.

    Attributes:
      physics: tree of arrays `[B, ...]`: all that the next step depends on.
      observation: s `[B, S]`.
      position: o `[B, 3]`, of the base, metres, world frame.
      heading: yaw `[B]`, radians: where the body's x axis points.
      fallen: `[B]` bool; the episode ends here.
      diverged: `[B]` bool; the physics left the finite numbers in this step. The other
        fields then repeat the state before it, and the episode ends here.
    """

    physics: Any
    observation: jax.Array
    position: jax.Array
    heading: jax.Array
    fallen: jax.Array
    diverged: jax.Array


class Robot(abc.ABC):
    """What can be walked.

    A robot is made without arguments, and takes `engine=` if it has `engines`
    (`genidm.robots.by_name`).

    Attributes:
      name: lower case, as it stands in paths and on the command line.
      observation: layout of s `[S]`.
      physics: tree of layouts, shaped like `State.physics`.
      action: layout of a `[A]`, in [−1, 1].
      dt: seconds a step.
      standing_height: metres; height of the base of a standing robot, and so of targets.
      target_distance: metres, least and greatest, of the paper's test (A.1.3).
      healthy_reward: reward of a step without a fall.
      paper_interactions: steps that the paper collects (A.1.2).
      engines: names of the engines that can step it; none if it steps itself.
      engine: the one that does; None if it steps itself.
      settings: its name, and what it was made with, argument by argument: they name run
        directories, and `genidm.robots.remade` makes the robot again from them.
    """

    name: ClassVar[str]
    dt: ClassVar[float]
    standing_height: ClassVar[float]
    target_distance: ClassVar[tuple[float, float]]
    healthy_reward: ClassVar[float]
    paper_interactions: ClassVar[int]
    engines: ClassVar[Collection[str]] = ()
    engine: Engine | None = None
    settings: dict[str, Any]
    observation: Layout
    physics: Any
    action: Layout

    def __init_subclass__(cls, **given: Any) -> None:
        super().__init_subclass__(**given)
        if "name" in vars(cls):
            check_value("the name of a robot", cls.name, label)

    @abc.abstractmethod
    def reset(self, keys: jax.Array, yaw: jax.Array) -> State:
        """Fresh starts, all different, near the origin.

        Args:
          keys: `[B]`, one a lane.
          yaw: `[B]`, radians, that the start is turned by.
        """

    @abc.abstractmethod
    def step(self, state: State, action: jax.Array) -> State:
        """One control step under actions `[B, A]`."""

    @abc.abstractmethod
    def set_state(self, physics: Any, yaw: jax.Array) -> State:
        """Recorded physics, turned by `yaw [B]` about the vertical through the origin.

        Readings that only a step can give (contact forces) are zero until one is made.
        """

    @abc.abstractmethod
    def cost(self, state: State, action: jax.Array) -> jax.Array:
        """Control and contact costs `[B]` of the step that led to `state` under `action`."""

    def check_inputs(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """s `[..., S]` as its controllers were taught it, with w ≥ 0 in its quaternions.

        Args:
          s: of whoever asks for an action.
          relative_goal: `[..., 3]`, the way that it asks for.

        Raises:
          BadInput: their shapes do not fit the robot, or each other; or, outside of jitted
            programs, a number is not finite.
        """
        state, way = jnp.shape(s), jnp.shape(relative_goal)
        if state[-1:] != (self.observation.size,) or way != (*state[:-1], 3):
            wanted = f"s [..., {self.observation.size}] and a way [..., 3] in metres"
            raise BadInput(f"the {self.name} is told {wanted}, not {state} and {way}")
        for x, name in ((s, "s"), (relative_goal, "the way")):
            if not isinstance(x, jax.core.Tracer) and not np.isfinite(np.asarray(x)).all():
                raise BadInput(f"{name} holds NaN or infinity: nothing steers the {self.name} so")
        return self.observation.canonical(jnp.asarray(s))

    def max_parallel_envs(self, lanes: int) -> int:
        """Largest batch to step together for a caller that asks for `lanes`.

        For callers whose results do not depend on the number.
        """
        return (
            self.engine.max_parallel_envs(lanes)
            if self.engine
            else devices.max_parallel_envs(lanes)
        )

    @property
    def engine_name(self) -> str | None:
        """As `--engine` takes it; None if the robot steps itself."""
        return self.engine.name if self.engine else None

    def mesh(self) -> Mesh:
        """The jax devices that share its lanes, unless the caller names others."""
        return self.engine.mesh() if self.engine else devices.mesh()

    def visual_model(self) -> mujoco.MjSpec:
        """A MuJoCo model that shows what the robot looks like, the caller's to change.

        It is posed and looked at (`genidm.video`), never stepped; a robot on another engine
        gives one that has its shape. Floor, lights and sky are the video's.

        Raises:
          BadInput: nobody has said what the robot looks like.
        """
        raise BadInput(f"there is nothing to render: the {self.name} has no visual model")

    def visual_qpos(self, physics: Any) -> np.ndarray:
        """qpos `[..., nq]` in which the visual model shows `physics [...]`, metres and radians.

        It is asked on the host, for recorded physics: it need not be traceable.

        Raises:
          BadInput: as for `visual_model`.
        """
        raise BadInput(f"there is nothing to render: the {self.name} has no visual model")

    def rotate_physics(self, physics: Any, yaw: jax.Array) -> Any:
        """Physics after the world is turned by `yaw [B]`."""
        return jax.tree.map(lambda layout, x: layout.rotate(x, yaw), self.physics, physics)

    def mirror_physics(self, physics: Any) -> Any:
        """Physics after the reflection y → −y."""
        return jax.tree.map(lambda layout, x: layout.mirror(x), self.physics, physics)


def select(mask: jax.Array, yes: Any, no: Any) -> Any:
    """Lane by lane, the tree `yes` where `mask [B]` holds and `no` elsewhere."""

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            return jnp.where(mask, a, b)
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(pick, yes, no)
