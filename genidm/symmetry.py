"""Yaw and mirror symmetry: what a turn of the world, or its reflection, does to numbers.

Everything a robot reports (its state s, its physics, its actions) is a tuple of named
fields, a `Layout`. Each field says how it transforms when the world is turned by a yaw
about the vertical (Def. 3, equivalence modulo orientation) and when it is reflected in
the plane y = 0. All functions are pure and act on arrays `[..., n]`.

The frame is right-handed with z up; angles are in radians; quaternions are (w, x, y, z).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from genidm.checks import printable
from genidm.errors import BadInput

Array = jax.Array


def rotate_vector(v: Array, yaw: Array) -> Array:
    """Vectors `[..., 3]` turned about the vertical by `yaw [...]`."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    ahead, left = c * x - s * y, s * x + c * y
    return jnp.stack([ahead, left, jnp.broadcast_to(z, ahead.shape)], axis=-1)


def rotate_quaternion(q: Array, yaw: Array) -> Array:
    """Orientations `[..., 4]` after the world is turned by `yaw [...]`; w ≥ 0."""
    c, s = jnp.cos(yaw / 2), jnp.sin(yaw / 2)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return canonical_quaternion(
        jnp.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)
    )


def canonical_quaternion(q: Array) -> Array:
    """The one of q and −q, the same orientation, that has w ≥ 0."""
    return jnp.where(q[..., :1] < 0, -q, q)


def wrap(angle: Array) -> Array:
    """Angles brought into [−π, π)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def yaw_of(q: Array) -> Array:
    """Heading `[...]`, in radians, of orientations `[..., 4]`: where the body's x axis points."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def euler_of(q: Array) -> Array:
    """Roll, pitch and yaw `[..., 3]`, in radians, of orientations `[..., 4]`."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    return jnp.stack([roll, pitch, yaw_of(q)], axis=-1)


def horizontal_norm(v: Array) -> Array:
    """Length `[...]` of the horizontal part of vectors `[..., 3]`."""
    return jnp.hypot(v[..., 0], v[..., 1])


Rotate = Callable[[Array, Array], Array]
Mirror = Callable[[Array], Array]


@dataclasses.dataclass(frozen=True)
class Field:
    """A named run of `size` numbers and how it transforms.

    Attributes:
      name: what the numbers are; unique in a layout.
      size: how many there are.
      kind: how they transform, in a word, for the docs.
      unit: SI unit of each number.
      rotate: (x [..., size], yaw [...]) → x after the world is turned by yaw.
      mirror: x [..., size] → x after the reflection y → −y.
      yaw: x [..., size] → heading [...], for a field that holds one.
      invalid: x [..., size] on the host → why it cannot be such numbers; None if it can.
      canonical: x [..., size] → the one that stands for it, where several mean the same.
      otherwise: x [..., size] → what x stands for if it was given in another unit or order, None
        if it cannot have been; and the words for that. Of a field with a heading.
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

    def __post_init__(self) -> None:
        if why := printable(self.name):
            raise BadInput(f"the name of a field {why}, not {self.name!r:.60}")


def _signed(signs: Sequence[float], permutation: Sequence[int] | None = None) -> Mirror:
    factors = np.asarray(signs, np.float32)
    if permutation is None:
        return lambda x: x * factors
    order = np.asarray(permutation)
    return lambda x: x[..., order] * factors


def _across(name: str, permutation: Sequence[int]) -> None:
    """Refuses what does not send each of them to one, and back."""
    order = list(permutation)
    if sorted(order) != list(range(len(order))) or [order[i] for i in order] != sorted(order):
        raise BadInput(f"{name!r}: each has one mirror image, which it is of; not {order}")


def _keep(x: Array, yaw: Array) -> Array:
    return x


def invariant(name: str, size: int = 1, unit: str = "1") -> Field:
    """Numbers that neither a turn nor a reflection changes (a height)."""
    return Field(name, size, "invariant", unit, _keep, lambda x: x)


def vector(name: str, unit: str = "m") -> Field:
    """A vector in the world frame (a position, a linear velocity, a force)."""
    return Field(name, 3, "vector", unit, rotate_vector, _signed([1, -1, 1]))


def pseudovector(name: str, unit: str = "rad/s") -> Field:
    """A pseudovector in the world frame (an angular velocity)."""
    return Field(name, 3, "pseudovector", unit, rotate_vector, _signed([-1, 1, -1]))


def body_pseudovector(name: str, unit: str = "rad/s") -> Field:
    """A pseudovector in the body's own frame (MuJoCo's angular velocity of a free joint)."""
    return Field(name, 3, "pseudovector in the body frame", unit, _keep, _signed([-1, 1, -1]))


def quaternion(name: str) -> Field:
    """An orientation (w, x, y, z) with w ≥ 0: q and −q are one orientation but two inputs.

    ROS, PyBullet and scipy have (x, y, z, w).
    """
    mirror = _signed([1, -1, 1, -1])
    rolled = (_w_last, "where it is read as (x, y, z, w): the order is (w, x, y, z)")
    return Field(
        name,
        4,
        "quaternion",
        "1",
        rotate_quaternion,
        mirror,
        yaw_of,
        _no_quaternion,
        canonical_quaternion,
        rolled,
    )


def _w_last(q: np.ndarray) -> np.ndarray | None:
    """(x, y, z, w) as (w, x, y, z), if what stands first may be an x: that of a slight lean."""
    return np.roll(q, 1, axis=-1) if (np.abs(q[..., 0]) < 0.2).all() else None


def _no_quaternion(q: np.ndarray) -> str | None:
    """Why `[..., 4]` are no orientations (w, x, y, z) of a robot that stands upright at times."""
    if (np.abs(np.linalg.norm(q, axis=-1) - 1) > 1e-3).any() or (q[..., 0] < 0).any():
        return "is not of length 1 with w ≥ 0 everywhere"
    if not q.size:
        return None
    never_upright = (1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2) <= 0).all()
    if never_upright or (q[..., 0] < 1e-3).all():
        return "is upside down throughout: the order is (w, x, y, z), not (x, y, z, w)"
    return None


def heading_vector(name: str, unit: str = "m") -> Field:
    """A vector seen along the heading: x ahead, y to the left, z up."""
    return Field(name, 3, "vector in the heading frame", unit, _keep, _signed([1, -1, 1]))


def euler(name: str) -> Field:
    """An orientation as roll, pitch and yaw (about the world's x, then y, then z), in radians.

    A turn changes the yaw alone. An angle and the same angle a full turn on are one
    orientation: networks are fed the one in [−π, π).
    """

    def rotate(x: Array, yaw: Array) -> Array:
        return x.at[..., 2].set(wrap(x[..., 2] + yaw))

    mirror, yaw = _signed([-1, 1, -1]), lambda x: x[..., 2]
    degrees = (_in_degrees, "where it is read as degrees: the unit is the radian")
    return Field(name, 3, "Euler angles", "rad", rotate, mirror, yaw, _no_euler, wrap, degrees)


def _in_degrees(angles: np.ndarray) -> np.ndarray | None:
    """Degrees as radians, if they may be: more than a full turn."""
    return np.radians(angles) if (np.abs(angles[..., 2]) > 2 * np.pi).any() else None


def _no_euler(angles: np.ndarray) -> str | None:
    """Why `[..., 3]` cannot be roll, pitch and yaw in radians; a yaw may count full turns."""
    roll, pitch = np.abs(angles[..., 0]), np.abs(angles[..., 1])
    if (roll > np.pi + 0.01).any() or (pitch > np.pi / 2 + 0.01).any():
        return "has a roll beyond ±π or a pitch beyond ±π/2: the unit is the radian"
    yaw = angles[..., 2]
    jumps = np.abs(np.diff(yaw, axis=0)) if yaw.ndim else np.zeros(0)
    if (np.abs(yaw) < 361).all() and ((jumps > 340) & (jumps < 361)).any():
        return "has a yaw that jumps by 360: the unit is the radian"
    return None


def joints(name: str, permutation: Sequence[int], signs: Sequence[float], unit: str) -> Field:
    """One number a joint: a turn leaves it, a reflection gives it to the joint across.

    Args:
      name: what the numbers are.
      permutation: for each joint the index of its mirror image.
      signs: for each joint the sign that the number takes on.
      unit: of each number.

    Raises:
      BadInput: the permutation is none, or the signs are not as many.
    """
    _across(name, permutation)
    if len(signs) != len(permutation):
        raise BadInput(f"{name!r} has {len(permutation)} joints, but {len(signs)} signs")
    mirror = _signed(signs, permutation)
    return Field(name, len(permutation), "joints", unit, _keep, mirror)


def wrenches(name: str, permutation: Sequence[int]) -> Field:
    """Torque (3) and force (3), in the world frame, on each of several bodies.

    Args:
      name: what the numbers are.
      permutation: for each body the index of its mirror image.

    Raises:
      BadInput: the permutation is none.
    """
    _across(name, permutation)
    count, order = len(permutation), np.asarray(permutation)
    signs = np.asarray([-1, 1, -1, 1, -1, 1], np.float32)

    def rotate(x: Array, yaw: Array) -> Array:
        parts = x.reshape(*x.shape[:-1], 2 * count, 3)
        return rotate_vector(parts, jnp.asarray(yaw)[..., None]).reshape(x.shape)

    def mirror(x: Array) -> Array:
        return (x.reshape(*x.shape[:-1], count, 6)[..., order, :] * signs).reshape(x.shape)

    return Field(name, 6 * count, "wrenches", "N·m, N", rotate, mirror)


@dataclasses.dataclass(frozen=True)
class Layout:
    """What an array `[..., n]` holds, field by field, and so how it transforms.

    Attributes:
      fields: in the order of the numbers.
    """

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        names = [f.name for f in self.fields]
        if len(set(names)) != len(names):
            raise ValueError(f"a layout names a field twice: {names}")

    @property
    def size(self) -> int:
        """Length of the last dimension."""
        return sum(f.size for f in self.fields)

    @property
    def _edges(self) -> np.ndarray:
        """Where each field but the first begins."""
        return np.cumsum([f.size for f in self.fields])[:-1]

    def _split(self, x: Array) -> list[Array]:
        if x.shape[-1] != self.size:
            raise ValueError(f"expected {self.size} numbers, not {x.shape[-1]}")
        return jnp.split(x, self._edges, axis=-1)

    def part(self, x: Array, name: str) -> Array:
        """The field `name` of x `[..., n]`."""
        return dict(zip((f.name for f in self.fields), self._split(x), strict=True))[name]

    def parts(self, x: np.ndarray) -> list[np.ndarray]:
        """The fields of x `[..., n]` on the host, one after another."""
        return np.split(x, self._edges, axis=-1)

    def invalid_fields(self, x: np.ndarray) -> list[str]:
        """What is wrong with x `[..., n]` on the host, a sentence a field: none if it is sound.

        Where the first dimension is time, jumps from one row to the next are seen, too.
        """
        parts = zip(self.fields, self.parts(x), strict=True)
        said = [(f.name, f.invalid(part) if f.invalid else None) for f, part in parts]
        return [f"{name!r} {invalid}" for name, invalid in said if invalid]

    def canonical(self, x: Array) -> Array:
        """x `[..., n]` with w ≥ 0 in its quaternions and its Euler angles in [−π, π)."""
        if all(f.canonical is None for f in self.fields):
            return x
        parts = zip(self.fields, self._split(x), strict=True)
        return jnp.concatenate([f.canonical(p) if f.canonical else p for f, p in parts], axis=-1)

    def rotate(self, x: Array, yaw: Array) -> Array:
        """x `[..., n]` after the world is turned by `yaw [...]` about the origin's vertical."""
        parts = zip(self.fields, self._split(x), strict=True)
        return jnp.concatenate([f.rotate(part, yaw) for f, part in parts], axis=-1)

    def mirror(self, x: Array) -> Array:
        """x `[..., n]` after the reflection y → −y."""
        parts = zip(self.fields, self._split(x), strict=True)
        return jnp.concatenate([f.mirror(part) for f, part in parts], axis=-1)

    def yaw(self, x: Array) -> Array:
        """The heading `[...]` that x `[..., n]` holds.

        Raises:
          ValueError: no field of the layout holds a heading.
        """
        for f, part in zip(self.fields, self._split(x), strict=True):
            if f.yaw is not None:
                return f.yaw(part)
        raise ValueError("no field of this layout holds a heading")

    def listed(self) -> list[list[str | int]]:
        """Name, kind, size and unit of each field, as files keep them."""
        return [[f.name, f.kind, f.size, f.unit] for f in self.fields]

    def describe(self) -> str:
        """A Markdown table of the fields."""
        rows, start = ["| numbers | field | unit | transforms as |", "|---|---|---|---|"], 0
        for f in self.fields:
            rows.append(f"| {start}–{start + f.size - 1} | {f.name} | {f.unit} | {f.kind} |")
            start += f.size
        return "\n".join(rows)
