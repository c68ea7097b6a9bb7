"""Planners: where a robot goes now, on its way through waypoints (§5.3, Fig. 7)."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from genidm.checks import check, optional, positive
from genidm.symmetry import rotate_vector

# (o [B, 3], waypoints [B, W, 3], unreached [B, W] bool) → target [B, 3], metres, world frame;
# called at each step. A planner with an argument `heading` also gets the headings [B], radians.
Planner = Callable[..., jax.Array]

# Radians. An angle that rounding makes slightly negative is 0, and not a whole turn.
ROUNDING = 1e-4


def first_unreached(o: jax.Array, waypoints: jax.Array, unreached: jax.Array) -> jax.Array:
    """Plan straight to the first unreached waypoint; to the last if all are reached."""
    first = jnp.where(unreached.any(-1), jnp.argmax(unreached, axis=-1), waypoints.shape[1] - 1)
    return jnp.take_along_axis(waypoints, first[:, None, None], axis=1)[:, 0]


def with_heading(planner: Planner, heading: jax.Array) -> Planner:
    """Give headings `[B]` to a planner that has an argument `heading`; leave others as they are."""
    try:
        sees = "heading" in inspect.signature(planner).parameters
    except (TypeError, ValueError):  # some callables have no signature
        sees = False
    return functools.partial(planner, heading=heading) if sees else planner


class Turns(NamedTuple):
    """Paths of two pieces from the origin, at first towards +x.

    Attributes:
      curvature: `[..., 2]` of each piece, 1/m; positive to the left, 0 if straight.
      length: `[..., 2]` of each piece, metres; infinite if the path does not exist.
    """

    curvature: jax.Array
    length: jax.Array

    def at(self, distance: jax.Array) -> jax.Array:
        """The point `[..., 3]` (z = 0) at a distance `[...]` along the path, metres."""
        first = jnp.minimum(distance, self.length[..., 0])
        second = jnp.minimum(distance - first, self.length[..., 1])
        corner = _along(self.curvature[..., 0], first)
        rest = _along(self.curvature[..., 1], second)
        return corner + rotate_vector(rest, self.curvature[..., 0] * first)


@dataclasses.dataclass(frozen=True)
class ArcPlanner:
    """Plans the shortest path to the next waypoint for a robot with a least turning radius.

    This is Dubins' path with a free heading at its end (Dubins 1957; Boissonnat and Bui 1994): an
    arc of the least radius, then a straight line. If the waypoint lies inside the circle of that
    arc, the path is an arc to the other side, then an arc of more than half a circle. Each step
    plans again from the robot's position and heading; the target is the point `look_ahead` metres
    along the path. Its bearing from the heading is at most look_ahead / (2 turning_radius) radians.

    It is for robots that walk to where they face. One that also walks sideways, as the Ant does,
    reaches more waypoints without it.

    Attributes:
      turning_radius: metres; the least radius of a turn.
      look_ahead: metres along the path; None takes `turning_radius`.
    """

    turning_radius: float = 1.0
    look_ahead: float | None = None

    def __post_init__(self) -> None:
        check(self, turning_radius=positive(), look_ahead=optional(positive()))

    def __call__(
        self, o: jax.Array, waypoints: jax.Array, unreached: jax.Array, heading: jax.Array
    ) -> jax.Array:
        """Plan the target `[B, 3]`.

        Args:
          o: positions `[B, 3]`, metres.
          waypoints: `[B, W, 3]`, metres.
          unreached: `[B, W]` bool.
          heading: `[B]`, radians.
        """
        way = first_unreached(o, waypoints, unreached) - o
        goal = rotate_vector(way, -heading)
        path = shortest_turns(goal[..., 0], goal[..., 1], self.turning_radius)
        length = path.length.sum(-1)
        ahead = jnp.minimum(self.look_ahead or self.turning_radius, length)
        # The target rises as evenly as the way to the waypoint does.
        rise = way[..., 2] * ahead / jnp.maximum(length, 1e-6)
        return o + rotate_vector(path.at(ahead), heading).at[..., 2].set(rise)


def shortest_turns(x: jax.Array, y: jax.Array, radius: float) -> Turns:
    """The shortest path to a point, with any heading at its end (Boissonnat and Bui 1994).

    Args:
      x: `[...]` of the point, metres; the path begins at the origin towards +x.
      y: `[...]` of the point, metres.
      radius: of the tightest turn, metres.
    """
    paths = [
        path
        for side in (1.0, -1.0)
        for path in (_arc_and_line(x, y, radius, side), *_two_arcs(x, y, radius, side))
    ]
    every = jax.tree.map(lambda *parts: jnp.stack(parts), *paths)
    shortest = jnp.argmin(every.length.sum(-1), axis=0)[None, ..., None]
    return jax.tree.map(lambda part: jnp.take_along_axis(part, shortest, axis=0)[0], every)


def _arc_and_line(x: jax.Array, y: jax.Array, radius: float, side: float) -> Turns:
    """The path that turns to a side (1 left, −1 right) until it faces the point `[...]`."""
    across, squared = side * y - radius, x**2 + y**2 - 2 * radius * side * y
    # `squared` is the squared distance to the centre of the turn, less the squared radius.
    line = jnp.sqrt(jnp.maximum(squared, 0.0))
    arc = radius * _turn(jnp.arctan2(across, x) + jnp.arctan2(radius, line))
    exists = squared >= 0
    return _turns(side / radius, jnp.where(exists, arc, jnp.inf), 0.0, line)


def _two_arcs(x: jax.Array, y: jax.Array, radius: float, side: float) -> tuple[Turns, Turns]:
    """The two paths that turn to a side and then to the other one, through the point `[...]`.

    The centre of the first arc, that of the second (2 radii from it) and the point (a radius from
    the second) are a triangle, which two mirror images of each other solve.
    """
    across = side * y - radius
    apart = jnp.maximum(jnp.hypot(x, across), 1e-6)
    cosine = (apart**2 + 3 * radius**2) / (4 * radius * apart)
    corner = jnp.arccos(jnp.clip(cosine, -1.0, 1.0))

    def solved(corner: jax.Array) -> Turns:
        to_centre = jnp.arctan2(across, x) + corner
        left_x = x - 2 * radius * jnp.cos(to_centre)
        left_y = across - 2 * radius * jnp.sin(to_centre)
        first = radius * _turn(to_centre + jnp.pi / 2)
        second = radius * _turn(to_centre + jnp.pi - jnp.arctan2(left_y, left_x))
        exists = jnp.where(cosine <= 1, first, jnp.inf)
        return _turns(side / radius, exists, -side / radius, second)

    return solved(corner), solved(-corner)


def _turns(curvature: float, length: jax.Array, then: float, rest: jax.Array) -> Turns:
    bends = jnp.stack([jnp.full_like(length, curvature), jnp.full_like(length, then)], axis=-1)
    return Turns(bends, jnp.stack([length, rest], axis=-1))


def _turn(angle: jax.Array) -> jax.Array:
    """The angle in [0, 2π)."""
    return jnp.maximum(jnp.mod(angle + ROUNDING, 2 * jnp.pi) - ROUNDING, 0.0)


def _along(curvature: jax.Array, length: jax.Array) -> jax.Array:
    """The point `[..., 3]` at a length `[...]` along a curve from the origin towards +x."""
    half = curvature * length / 2
    chord = length * jnp.sinc(half / jnp.pi)
    return jnp.stack([chord * jnp.cos(half), chord * jnp.sin(half), jnp.zeros_like(half)], axis=-1)
