"""Yaw and mirror symmetry: how numbers transform under a rotation or reflection of the world.

All data of a robot (its state s, its physics, its actions) is a tuple of named fields, a
`Layout`. Each field defines its transformation under a rotation of the world by a yaw about
the vertical (equivalence modulo orientation, Def. 3) and under the reflection in the plane
y = 0; and, for a body with four equal sides, under a quarter turn of the body's own axes. All
functions are pure and act on arrays `[..., n]`.

The frame is right-handed with z up; angles are in radians; quaternions are (w, x, y, z).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from genidm.checks import printable
from genidm.errors import BadInput

Array = jax.Array


def rotate_vector(v: Array, yaw: Array) -> Array:
    """Rotate vectors `[..., 3]` by `yaw [...]` about the vertical."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    rotated_x, rotated_y = c * x - s * y, s * x + c * y
    return jnp.stack([rotated_x, rotated_y, jnp.broadcast_to(z, rotated_x.shape)], axis=-1)


def rotate_quaternion(q: Array, yaw: Array) -> Array:
    """Rotate orientations `[..., 4]` by `yaw [...]` about the vertical; the result has w ≥ 0."""
    c, s = jnp.cos(yaw / 2), jnp.sin(yaw / 2)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return canonical_quaternion(
        jnp.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)
    )


def canonical_quaternion(q: Array) -> Array:
    """Choose from q and −q, which are the same orientation, the quaternion with w ≥ 0."""
    return jnp.where(q[..., :1] < 0, -q, q)


def wrap(angle: Array) -> Array:
    """Map angles to [−π, π)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def yaw_of(q: Array) -> Array:
    """Heading `[...]` of orientations `[..., 4]`: direction of the body's x axis, radians."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def euler_of(q: Array) -> Array:
    """Roll, pitch and yaw `[..., 3]` of orientations `[..., 4]`, radians."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    return jnp.stack([roll, pitch, yaw_of(q)], axis=-1)


def turn_axes(v: Array) -> Array:
    """Coordinates of vectors `[..., 3]` after the axes turn by +90° about z: (y, −x, z)."""
    return jnp.stack([v[..., 1], -v[..., 0], v[..., 2]], axis=-1)


def turn_quaternion(q: Array) -> Array:
    """Orientations `[..., 4]` after the body's axes turn by +90° about its own z axis."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return canonical_quaternion(jnp.stack([w - z, x + y, y - x, z + w], axis=-1) * math.sqrt(0.5))


def horizontal_norm(v: Array) -> Array:
    """Length `[...]` of the horizontal part of vectors `[..., 3]`."""
    return jnp.hypot(v[..., 0], v[..., 1])


Rotate = Callable[[Array, Array], Array]
Mirror = Callable[[Array], Array]


@dataclasses.dataclass(frozen=True)
class Field:
    """`size` consecutive numbers of a layout, and how they transform.

    Attributes:
      name: what the numbers are; unique in a layout.
      size: number of numbers.
      kind: short description of the transformation, for files and docs.
      unit: SI unit of each number.
      rotate: (x [..., size], yaw [...]) → x after a rotation of the world by yaw.
      mirror: x [..., size] → x after the reflection y → −y.
      yaw: x [..., size] → heading [...]; None if the field has no heading.
      invalid: x [..., size] on the host → why x is invalid; None if x is valid.
      canonical: x [..., size] → the representative of equivalent values (w ≥ 0 of q and −q).
      otherwise: for fields with a heading: x [..., size] → x converted from another unit or
        order (degrees; w last), or None if x cannot be in it; and a phrase for messages.
      turn_body: x [..., size] → x after the body's axes turn by +90° about its z axis, so that its
        left becomes its front; None if the body has no such symmetry.
    """

    name: str
    size: int
    kind: str
    unit: str
    rotate: Rotate
    mirror: Mirror
    yaw: Callable[[Array], Array] | None = None
    invalid: Callable[[np.ndarray], str | None] | None = None
    canonical: Callable[[Array], Array] | None = None
    otherwise: tuple[Callable[[np.ndarray], np.ndarray | None], str] | None = None
    turn_body: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        if why := printable(self.name):
            raise BadInput(f"the name of a field {why}, not {self.name!r:.60}")


def _signed(signs: Sequence[float], permutation: Sequence[int] | None = None) -> Mirror:
    factors = np.asarray(signs, np.float32)
    if permutation is None:
        return lambda x: x * factors
    order = np.asarray(permutation)
    return lambda x: x[..., order] * factors


def _check_involution(name: str, permutation: Sequence[int]) -> None:
    """Refuse a list that is not a permutation, or is not its own inverse."""
    order = list(permutation)
    if sorted(order) != list(range(len(order))) or [order[i] for i in order] != sorted(order):
        raise BadInput(f"{name!r}: permutation must be its own inverse, not {order}")


def _same(x: Array) -> Array:
    return x


def _keep(x: Array, yaw: Array) -> Array:
    return x


def invariant(name: str, size: int = 1, unit: str = "1") -> Field:
    """Numbers that do not change under rotation or reflection (a height)."""
    return Field(name, size, "invariant", unit, _keep, _same, turn_body=_same)


def vector(name: str, unit: str = "m") -> Field:
    """A vector in the world frame (a position, a linear velocity, a force)."""
    mirror = _signed([1, -1, 1])
    return Field(name, 3, "vector", unit, rotate_vector, mirror, turn_body=_same)


def pseudovector(name: str, unit: str = "rad/s") -> Field:
    """A pseudovector in the world frame (an angular velocity)."""
    mirror = _signed([-1, 1, -1])
    return Field(name, 3, "pseudovector", unit, rotate_vector, mirror, turn_body=_same)


def body_pseudovector(name: str, unit: str = "rad/s") -> Field:
    """A pseudovector in the body's own frame (MuJoCo's angular velocity of a free joint)."""
    kind, mirror = "pseudovector in the body frame", _signed([-1, 1, -1])
    return Field(name, 3, kind, unit, _keep, mirror, turn_body=turn_axes)


def quaternion(name: str) -> Field:
    """An orientation (w, x, y, z) with w ≥ 0: q and −q are one orientation but two inputs.

    ROS, PyBullet and scipy use (x, y, z, w).
    """
    mirror = _signed([1, -1, 1, -1])
    w_last = (_from_w_last, "only if it is read as (x, y, z, w): the order is (w, x, y, z)")
    return Field(
        name,
        4,
        "quaternion",
        "1",
        rotate_quaternion,
        mirror,
        yaw_of,
        _invalid_quaternion,
        canonical_quaternion,
        w_last,
        turn_quaternion,
    )


def _from_w_last(q: np.ndarray) -> np.ndarray | None:
    """Convert (x, y, z, w) to (w, x, y, z); None if the first number is too large for x."""
    return np.roll(q, 1, axis=-1) if (np.abs(q[..., 0]) < 0.2).all() else None


def _invalid_quaternion(q: np.ndarray) -> str | None:
    """Why `[..., 4]` are not (w, x, y, z) of a robot that is upright in some rows, or None."""
    if (np.abs(np.linalg.norm(q, axis=-1) - 1) > 1e-3).any() or (q[..., 0] < 0).any():
        return "is not of length 1 with w ≥ 0 everywhere"
    if not q.size:
        return None
    never_upright = (1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2) <= 0).all()
    if never_upright or (q[..., 0] < 1e-3).all():
        return "is upside down in all rows: the order is (w, x, y, z), not (x, y, z, w)"
    return None


def heading_vector(name: str, unit: str = "m") -> Field:
    """A vector in the heading frame: x ahead, y to the left, z up."""
    return Field(name, 3, "vector in the heading frame", unit, _keep, _signed([1, -1, 1]))


def euler(name: str) -> Field:
    """An orientation as roll, pitch and yaw (about the world's x, then y, then z), in radians.

    A rotation changes the yaw only. Angles that differ by 2π are the same orientation: networks
    see the angle in [−π, π).
    """

    def rotate(x: Array, yaw: Array) -> Array:
        return x.at[..., 2].set(wrap(x[..., 2] + yaw))

    mirror, yaw = _signed([-1, 1, -1]), lambda x: x[..., 2]
    degrees = (_from_degrees, "only if it is read as degrees: the unit is the radian")
    return Field(name, 3, "Euler angles", "rad", rotate, mirror, yaw, _invalid_euler, wrap, degrees)


def _from_degrees(angles: np.ndarray) -> np.ndarray | None:
    """Convert degrees to radians; None if no yaw exceeds 2π, so that x may be radians."""
    return np.radians(angles) if (np.abs(angles[..., 2]) > 2 * np.pi).any() else None


def _invalid_euler(angles: np.ndarray) -> str | None:
    """Why `[..., 3]` are not roll, pitch and yaw in radians, or None; a yaw may exceed ±π."""
    roll, pitch = np.abs(angles[..., 0]), np.abs(angles[..., 1])
    if (roll > np.pi + 0.01).any() or (pitch > np.pi / 2 + 0.01).any():
        return "has a roll beyond ±π or a pitch beyond ±π/2: the unit is the radian"
    yaw = angles[..., 2]
    jumps = np.abs(np.diff(yaw, axis=0)) if yaw.ndim else np.zeros(0)
    if (np.abs(yaw) < 361).all() and ((jumps > 340) & (jumps < 361)).any():
        return "has a yaw that jumps by 360: the unit is the radian"
    return None


def joints(
    name: str,
    permutation: Sequence[int],
    signs: Sequence[float],
    unit: str,
    quarter: tuple[Sequence[int], Sequence[float]] | None = None,
) -> Field:
    """One number per joint: invariant to rotation; a reflection moves it to the mirrored joint.

    Args:
      name: what the numbers are.
      permutation: index of the mirror image of each joint.
      signs: sign (1 or −1) that a reflection gives to each joint's number.
      unit: unit of each number.
      quarter: index of the joint that each joint becomes by a quarter turn of the body's axes,
        and signs; None if the body has no such symmetry.

    Raises:
      BadInput: `permutation` is not its own inverse, or `signs` has another length.
    """
    _check_involution(name, permutation)
    if len(signs) != len(permutation):
        raise BadInput(f"{name!r} has {len(permutation)} joints, but {len(signs)} signs")
    mirror = _signed(signs, permutation)
    turn = None if quarter is None else _signed(quarter[1], quarter[0])
    return Field(name, len(permutation), "joints", unit, _keep, mirror, turn_body=turn)


def wrenches(name: str, permutation: Sequence[int], quarter: Sequence[int] | None = None) -> Field:
    """Torque (3) and force (3) on each of several bodies, in the world frame.

    Args:
      name: what the numbers are.
      permutation: index of the mirror image of each body.
      quarter: index of the body that each body becomes by a quarter turn of the body's axes; None
        if there is no such symmetry.

    Raises:
      BadInput: `permutation` is not its own inverse.
    """
    _check_involution(name, permutation)
    count, order = len(permutation), np.asarray(permutation)
    signs = np.asarray([-1, 1, -1, 1, -1, 1], np.float32)

    def rotate(x: Array, yaw: Array) -> Array:
        parts = x.reshape(*x.shape[:-1], 2 * count, 3)
        return rotate_vector(parts, jnp.asarray(yaw)[..., None]).reshape(x.shape)

    def mirror(x: Array) -> Array:
        return (x.reshape(*x.shape[:-1], count, 6)[..., order, :] * signs).reshape(x.shape)

    def turn(x: Array) -> Array:
        return x.reshape(*x.shape[:-1], count, 6)[..., np.asarray(quarter), :].reshape(x.shape)

    kind, unit, turn_body = "wrenches", "N·m, N", None if quarter is None else turn
    return Field(name, 6 * count, kind, unit, rotate, mirror, turn_body=turn_body)


@dataclasses.dataclass(frozen=True)
class Layout:
    """The fields of an array `[..., n]`, which define how it transforms.

    Attributes:
      fields: fields in the order of the numbers.
    """

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        names = [f.name for f in self.fields]
        if len(set(names)) != len(names):
            raise ValueError(f"two fields of a layout have the same name: {names}")

    @property
    def size(self) -> int:
        """Length of the last dimension."""
        return sum(f.size for f in self.fields)

    @property
    def _edges(self) -> np.ndarray:
        """Start index of each field except the first."""
        return np.cumsum([f.size for f in self.fields])[:-1]

    def _split(self, x: Array) -> list[Array]:
        if x.shape[-1] != self.size:
            raise ValueError(f"expected {self.size} numbers, got {x.shape[-1]}")
        return jnp.split(x, self._edges, axis=-1)

    def part(self, x: Array, name: str) -> Array:
        """Select the field `name` of x `[..., n]`."""
        return dict(zip((f.name for f in self.fields), self._split(x), strict=True))[name]

    def parts(self, x: np.ndarray) -> list[np.ndarray]:
        """Split x `[..., n]`, on the host, into its fields."""
        return np.split(x, self._edges, axis=-1)

    def invalid_fields(self, x: np.ndarray) -> list[str]:
        """Describe the invalid fields of x `[..., n]` on the host, one sentence per field.

        If the first dimension is time, this also checks jumps between rows.
        """
        parts = zip(self.fields, self.parts(x), strict=True)
        found = [(f.name, f.invalid(part) if f.invalid else None) for f, part in parts]
        return [f"{name!r} {why}" for name, why in found if why]

    def canonical(self, x: Array) -> Array:
        """Make w ≥ 0 in the quaternions of x `[..., n]`, and map its Euler angles to [−π, π)."""
        if all(f.canonical is None for f in self.fields):
            return x
        parts = zip(self.fields, self._split(x), strict=True)
        return jnp.concatenate([f.canonical(p) if f.canonical else p for f, p in parts], axis=-1)

    def rotate(self, x: Array, yaw: Array) -> Array:
        """Rotate x `[..., n]` by `yaw [...]` about the vertical through the origin (Def. 3)."""
        parts = zip(self.fields, self._split(x), strict=True)
        return jnp.concatenate([f.rotate(part, yaw) for f, part in parts], axis=-1)

    def mirror(self, x: Array) -> Array:
        """Reflect x `[..., n]`: y → −y."""
        parts = zip(self.fields, self._split(x), strict=True)
        return jnp.concatenate([f.mirror(part) for f, part in parts], axis=-1)

    @property
    def can_turn(self) -> bool:
        """Whether every field has a quarter turn of the body."""
        return all(f.turn_body for f in self.fields)

    def turn_body(self, x: Array) -> Array:
        """Turn the body's axes by +90° in x `[..., n]`: the same motion of a body with four sides.

        Raises:
          ValueError: a field has no quarter turn.
        """
        if not self.can_turn:
            raise ValueError("this body is not its own image after a quarter turn")
        parts = zip(self.fields, self._split(x), strict=True)
        return jnp.concatenate([f.turn_body(p) for f, p in parts if f.turn_body], axis=-1)

    def turn_body_by(self, x: Array, quarters: Array) -> Array:
        """Turn the body's axes in x `[..., n]` by `quarters [...]` (integers) quarter turns."""
        turned = [x]
        for _ in range(3):
            turned.append(self.turn_body(turned[-1]))
        which = jnp.mod(quarters, 4)[..., None]
        return jnp.select([which == n for n in range(4)], turned)

    def yaw(self, x: Array) -> Array:
        """Read the heading `[...]` from x `[..., n]`, radians.

        Raises:
          ValueError: no field of the layout holds a heading.
        """
        for f, part in zip(self.fields, self._split(x), strict=True):
            if f.yaw is not None:
                return f.yaw(part)
        raise ValueError("no field of this layout holds a heading")

    def listed(self) -> list[list[str | int]]:
        """List name, kind, size and unit of each field, as in files."""
        return [[f.name, f.kind, f.size, f.unit] for f in self.fields]

    def describe(self) -> str:
        """Make a Markdown table of the fields."""
        rows, start = ["| numbers | field | unit | transforms as |", "|---|---|---|---|"], 0
        for f in self.fields:
            rows.append(f"| {start}–{start + f.size - 1} | {f.name} | {f.unit} | {f.kind} |")
            start += f.size
        return "\n".join(rows)


def quarters_to(angle: Array, heading: Array) -> Array:
    """Quarter turns `[...]` of the body's axes after which its front is nearest to `angle [...]`.

    Both angles are in radians, in the world; afterwards the heading is within ±45° of `angle`.
    """
    return jnp.round(wrap(angle - heading) / (jnp.pi / 2)).astype(jnp.int32)
