"""A robot with known answers: a point that goes where it is told.

Everything it does has a closed form, so that what is built on the Robot contract can be
compared with it, and a program of it compiles in a second.
"""

from __future__ import annotations

import math
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp

from genidm import symmetry
from genidm.controller import direction
from genidm.robots.base import Robot, State, select
from genidm.symmetry import Layout

TURN_RATE = 2.0  # rad/s at full action


class Physics(flax.struct.PyTreeNode):
    """Where a point is: position `[B, 3]`, metres, and orientation `[B, 4]`, a turn about z."""

    position: jax.Array
    orientation: jax.Array


class Point(Robot):
    """A point on wheels that no friction holds back.

    The action `[3]` is its velocity ahead and to the left, as shares of `speed`, which is
    its greatest in any direction, and the rate at which it turns. It goes first, and turns
    then. Its velocity and the speeds of its two wheels are readings: only a step gives
    them, and no step needs them.

    Args:
      speed: metres a second at full action.
      frame: "own": the action is in the point's own frame, and 𝒢 is exact. "world": it is
        in the world's, so that no two actions are e.m.o. and 𝒢 is wrong.
      falls_at: metres from the origin; it falls beyond.
      diverges_at: metres from the origin; its physics is NaN beyond.
    """

    name = "point"
    dt = 0.05
    standing_height = 0.5
    target_distance = (2.0, 5.0)
    healthy_reward = 1.0
    paper_interactions = 2048
    control_cost = 0.05

    def __init__(
        self,
        speed: float = 1.0,
        frame: Literal["own", "world"] = "own",
        falls_at: float = math.inf,
        diverges_at: float = math.inf,
    ):
        self.speed, self.frame = speed, frame
        self.falls_at, self.diverges_at = falls_at, diverges_at
        self.settings = dict(
            name=self.name,
            speed=speed,
            frame=frame,
            falls_at=falls_at,
            diverges_at=diverges_at,
        )
        self.observation = Layout(
            (
                symmetry.invariant("height", unit="m"),
                symmetry.quaternion("orientation"),
                symmetry.vector("velocity", "m/s"),
                symmetry.joints("wheels", [1, 0], [1, 1], "of full speed"),
            )
        )
        self.physics = Physics(
            Layout((symmetry.vector("position"),)), Layout((symmetry.quaternion("orientation"),))
        )
        self.action = Layout((symmetry.joints("drive", [0, 1, 2], [1, -1, -1], "of full speed"),))

    def reset(self, keys: jax.Array, yaw: jax.Array) -> State:
        """Starts within 0.1 m of the standing origin, and within half a radian of +x."""
        noise = jax.vmap(lambda key: jax.random.uniform(key, (4,), minval=-1.0))(keys)
        standing = jnp.asarray([[0.0, 0.0, self.standing_height]])
        physics = Physics(standing + 0.1 * noise[:, :3], upright(0.5 * noise[:, 3]))
        return self.set_state(physics, yaw)

    def step(self, state: State, action: jax.Array) -> State:
        action = jnp.clip(action, -1.0, 1.0)
        ahead, left, turn = action[:, 0], action[:, 1], action[:, 2]
        velocity = self.speed * jnp.stack([ahead, left, jnp.zeros_like(turn)], axis=-1)
        velocity /= jnp.maximum(jnp.hypot(ahead, left), 1.0)[:, None]
        if self.frame == "own":
            velocity = symmetry.rotate_vector(velocity, state.heading)
        position = state.position + self.dt * velocity
        lost = symmetry.horizontal_norm(position) > self.diverges_at
        position = jnp.where(lost[:, None], jnp.nan, position)
        turned = symmetry.rotate_quaternion(state.physics.orientation, self.dt * TURN_RATE * turn)
        wheels = jnp.stack([ahead - turn, ahead + turn], axis=-1)
        after = self._state(Physics(position, turned), velocity, wheels)
        return select(lost, state.replace(diverged=lost), after)

    def set_state(self, physics: Physics, yaw: jax.Array) -> State:
        turned = self.rotate_physics(physics, yaw)
        still = jnp.zeros_like(turned.position)
        state = self._state(turned, still, still[:, :2])
        return state.replace(fallen=jnp.zeros_like(state.fallen))

    def cost(self, state: State, action: jax.Array) -> jax.Array:
        return self.control_cost * jnp.sum(action**2, axis=-1)

    def _state(self, physics: Physics, velocity: jax.Array, wheels: jax.Array) -> State:
        height = physics.position[:, 2:]
        fallen = symmetry.horizontal_norm(physics.position) > self.falls_at
        return State(
            physics=physics,
            observation=jnp.concatenate([height, physics.orientation, velocity, wheels], axis=-1),
            position=physics.position,
            heading=symmetry.yaw_of(physics.orientation),
            fallen=fallen,
            diverged=jnp.zeros_like(fallen),
        )


def upright(yaw: jax.Array) -> jax.Array:
    """Orientations `[B, 4]` of headings `[B]`."""
    zero = jnp.zeros_like(yaw)
    return symmetry.canonical_quaternion(
        jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)], axis=-1)
    )


class Straight(flax.struct.PyTreeNode):
    """Steers a Point straight at the target, at `pace` times its speed; turning all the while.

    Attributes:
      pace: share of full speed; below 0 it flees.
      robot: the point.
    """

    pace: jax.Array
    robot: Point = flax.struct.field(pytree_node=False)

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        level = direction(relative_goal * jnp.asarray([[1.0, 1.0, 0.0]]))
        ahead = symmetry.rotate_vector(level, -self.robot.observation.yaw(s))
        return (self.pace * ahead).at[:, 2].set(0.3)
