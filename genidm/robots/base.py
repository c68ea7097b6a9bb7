"""The Robot contract: a batch of lanes, with one robot in each lane.

Agents, 𝒢 and the evaluator use robots only through this contract. The methods of a robot are
pure functions of the state, so the caller may jit, scan, shard or replay them.
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
    """The state of B robots, after `reset`, `step` or `set_state`.

    Attributes:
      physics: tree of arrays `[B, ...]`: everything that the next step depends on.
      observation: s `[B, S]`.
      position: o `[B, 3]`, of the base, metres, world frame.
      heading: `[B]`, yaw of the body's x axis, radians.
      fallen: `[B]` bool; the robot has fallen, and the episode ends.
      diverged: `[B]` bool; the physics was not finite after this step, and the episode ends. The
        other fields repeat the state before the step.
    """

    physics: Any
    observation: jax.Array
    position: jax.Array
    heading: jax.Array
    fallen: jax.Array
    diverged: jax.Array


class Robot(abc.ABC):
    """A robot in simulation: resets, steps, costs, and how its numbers transform.

    Every argument of a subclass has a default; a subclass with `engines` takes `engine=`
    (`genidm.robots.by_name`).

    Attributes:
      name: name in paths and on the command line, lower case.
      observation: layout of s `[S]`.
      physics: tree of layouts, shaped like `State.physics`.
      action: layout of a `[A]`, in [−1, 1].
      dt: seconds per control step.
      standing_height: metres; height of the base of a standing robot, and of targets.
      target_distance: metres; least and greatest target distance of the paper's test (A.1.3).
      healthy_reward: reward of a step without a fall.
      paper_interactions: environment steps that the paper collects (A.1.2).
      engines: names of the engines that can step the robot; empty if it steps itself.
      engine: the engine that steps the robot; None if it steps itself.
      settings: its name and the arguments that it was made with. They enter the names of run
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
        """Draws initial states near the origin, a different one in every lane.

        Args:
          keys: `[B]`, one per lane.
          yaw: `[B]`, radians by which the initial state is rotated about the vertical.
        """

    @abc.abstractmethod
    def step(self, state: State, action: jax.Array) -> State:
        """Makes one control step under actions `[B, A]`."""

    @abc.abstractmethod
    def set_state(self, physics: Any, yaw: jax.Array) -> State:
        """The state with this physics, rotated by `yaw [B]` about the vertical through the origin.

        Readings that only a step can measure (contact forces) are zero until the next step.
        """

    @abc.abstractmethod
    def cost(self, state: State, action: jax.Array) -> jax.Array:
        """Costs `[B]` (control, contacts) of the step that led to `state` under `action`."""

    def check_inputs(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """Checks a controller's inputs; returns s with w ≥ 0 in its quaternions.

        Args:
          s: `[..., S]`, the observation.
          relative_goal: `[..., 3]`, metres.

        Raises:
          BadInput: their shapes do not fit the robot or each other; or, outside of jitted
            programs, a number is not finite.
        """
        state, goal = jnp.shape(s), jnp.shape(relative_goal)
        if state[-1:] != (self.observation.size,) or goal != (*state[:-1], 3):
            wanted = f"s [..., {self.observation.size}] and a relative goal [..., 3] in metres"
            raise BadInput(f"the {self.name} takes {wanted}, got {list(state)} and {list(goal)}")
        for x, name in ((s, "s"), (relative_goal, "the relative goal")):
            if not isinstance(x, jax.core.Tracer) and not np.isfinite(np.asarray(x)).all():
                raise BadInput(f"{name} of the {self.name} holds NaN or infinity")
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
        """Name of the engine, the value of `--engine`; None if the robot steps itself."""
        return self.engine.name if self.engine else None

    @property
    def engine_in_names(self) -> list[str]:
        """The engine's name, for names of files of several engines; empty if there is only one."""
        return [self.engine.name] if self.engine and len(self.engines) > 1 else []

    def mesh(self) -> Mesh:
        """The jax devices that share the lanes by default."""
        return self.engine.mesh() if self.engine else devices.mesh()

    def visual_model(self) -> mujoco.MjSpec:
        """A new MuJoCo model of the robot's appearance; the caller may change it.

        `genidm.video` sets its pose and renders it, and never steps it; a robot on another engine
        returns a model of the same shape. `genidm.video` adds floor, lights and sky.

        Raises:
          BadInput: the robot has no visual model.
        """
        raise BadInput(f"the {self.name} cannot be rendered: it has no visual model")

    def visual_qpos(self, physics: Any) -> np.ndarray:
        """qpos `[..., nq]` of the visual model for `physics [...]`, metres and radians.

        It runs on the host, on recorded physics, so it need not be traceable.

        Raises:
          BadInput: as for `visual_model`.
        """
        raise BadInput(f"the {self.name} cannot be rendered: it has no visual model")

    def rotate_physics(self, physics: Any, yaw: jax.Array) -> Any:
        """Physics after the world is rotated by `yaw [B]` about the vertical."""
        return jax.tree.map(lambda layout, x: layout.rotate(x, yaw), self.physics, physics)

    @property
    def can_turn_body(self) -> bool:
        """Whether the body has four equal sides: its layouts declare a quarter turn."""
        return self.observation.can_turn and self.action.can_turn

    def turn_body_physics(self, physics: Any) -> Any:
        """Physics after a quarter turn of the body's own axes: the same motion."""
        return jax.tree.map(lambda layout, x: layout.turn_body(x), self.physics, physics)

    def mirror_physics(self, physics: Any) -> Any:
        """Physics after the reflection y → −y."""
        return jax.tree.map(lambda layout, x: layout.mirror(x), self.physics, physics)


def select(mask: jax.Array, yes: Any, no: Any) -> Any:
    """Selects lane by lane from two trees: `yes` where `mask [B]` holds, `no` elsewhere."""

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            return jnp.where(mask, a, b)
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(pick, yes, no)
