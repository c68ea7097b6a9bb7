"""Experience (Def. 1): the recorded steps of a robot that learns another task."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import flax.serialization
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from genidm import files
from genidm.errors import BadInput
from genidm.files import Corrupt
from genidm.robots.base import Robot
from genidm.tasks import Transition

# Metres; at larger distances, float32 rounds a position by more than 0.01 mm.
FAR = 100.0
# Fields that a log may lack.
OPTIONAL = {"physics", "intended", "forward"}


class Experience(flax.struct.PyTreeNode):
    """Recorded transitions: T steps of B lanes, in time order.

    Attributes:
      s: `[T, B, S]`, state before the step.
      o: `[T, B, 3]`, position before the step, metres, world frame.
      o_next: `[T, B, 3]`, position after the step, before any reset.
      a: `[T, B, A]`, action in [−1, 1].
      first: `[T, B]` bool, the first step of an episode.
      last: `[T, B]` bool, the last step of an episode.
      valid: `[T, B]` bool, False where the physics diverged in the step.
      physics: tree `[T, B, ...]`, physics before the step; None for a log without physics,
        which can be rotated (`Generalize(mode="rotate")`), but not replayed.
      intended: `[T, B, A]`, the action that the agent chose before it added exploration; None for
        a log without it.
      forward: `[T, B]`, radians, direction in the world that the agent saw as +x; None: always +x.
    """

    s: Any
    o: Any
    o_next: Any
    a: Any
    first: Any
    last: Any
    valid: Any
    physics: Any = None
    intended: Any = None
    forward: Any = None

    @property
    def interactions(self) -> int:
        """Number of recorded transitions."""
        return self.first.shape[0] * self.first.shape[1]

    def part(self, fraction: float, skip: float = 0.0) -> Experience:
        """A part of the record in time.

        Args:
          fraction: length of the part, as a fraction of the record, in (0, 1].
          skip: fraction of the record before the part, in [0, 1 − fraction].
        """
        steps = self.first.shape[0]
        begin, length = round(steps * skip), max(1, round(steps * fraction))
        begin = min(begin, steps - length)
        return jax.tree.map(lambda x: x[begin : begin + length], self)

    def first_half(self) -> Experience:
        """The first half of the record, from which GE and LR learn (A.1.2)."""
        return self.part(0.5)

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Write the record as a directory of arrays, without pickle.

        Raises:
          BadInput: the path exists, and `overwrite` is False; the arrays have different [T, B];
            or a valid step holds NaN or infinity.
        """
        made = jax.tree.map(_as_numpy, _lists_as_arrays(self))
        shape = made.first.shape
        if any(x.shape[:2] != shape for x in jax.tree.leaves(made)):
            raise BadInput(f"experience: not all arrays begin with the shape {shape} of first")
        _check_finite(_zero_invalid(made))
        tree = flax.serialization.to_state_dict(made)
        arrays = {name: x for name, x in tree.items() if x is not None}
        files.save_arrays(path, arrays, {}, overwrite)

    @property
    def ends(self) -> np.ndarray:
        """`[T, B]` bool, the last step of an episode: `last`, or the next step is `first`."""
        last, first = np.asarray(self.last), np.asarray(self.first)
        return last | np.concatenate([first[1:], np.zeros_like(first[:1])])

    @property
    def begins(self) -> np.ndarray:
        """`[T, B]` bool, the first step of an episode or of the record."""
        ends = self.ends
        return np.concatenate([np.ones_like(ends[:1]), ends[:-1]])

    def prepared(self, robot: Robot) -> Experience:
        """Check the record and convert it for 𝒢 and a fit: NumPy arrays with the canonical s.

        Steps that are not `valid` are not checked, and become zero. In a log without physics,
        large positions (UTM) become relative to the start of their episode, before the conversion
        to float32.

        Raises:
          BadInput: the shapes do not fit each other or the robot, or a valid step is impossible:
            NaN or infinity, an action outside [−1, 1], an invalid orientation, a position that
            jumps, or `first` without `last` in the step before; or a log has neither.
        """
        if isinstance(self, Prepared) and self.robot == robot.name:
            return self
        made = _as_floats(jax.tree.map(_as_numpy, _lists_as_arrays(self)))
        _check_shapes(made, robot)
        clean = _zero_invalid(made)
        _check_finite(clean)
        _check_ranges(clean, robot)
        _check_continuous(clean, robot)
        _check_orientation(clean, robot)
        if clean.far_away:
            clean = clean.centred()
        narrow = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, clean)
        s = np.asarray(robot.observation.canonical(jnp.asarray(narrow.s)))
        fields = {f.name: getattr(narrow, f.name) for f in dataclasses.fields(Experience)}
        return Prepared(**fields | {"s": s.astype(np.float32, copy=False)}, robot=robot.name)

    @property
    def far_away(self) -> bool:
        """Whether positions are too large for float32, and there is no physics to replay."""
        return self.physics is None and bool(np.abs(np.asarray(self.o)[self.valid]).max() > FAR)

    def centred(self) -> Experience:
        """The record with horizontal positions relative to the start of each episode."""
        o = np.asarray(self.o, np.float64)
        rows = np.arange(len(o))[:, None]
        start = np.maximum.accumulate(np.where(self.begins, rows, 0), axis=0)
        # Use the first valid step of the episode, because invalid steps hold no position.
        valid = np.where(np.asarray(self.valid), rows, len(o) - 1)
        valid = np.minimum.accumulate(valid[::-1], axis=0)[::-1]
        first = np.take_along_axis(valid, start, axis=0)
        origin = np.take_along_axis(o, first[..., None], axis=0) * [1, 1, 0]
        return self.replace(o=o - origin, o_next=np.asarray(self.o_next) - origin)


class Prepared(Experience):
    """The result of `Experience.prepared`, which is not checked a second time.

    Attributes:
      robot: name of the robot that the record was checked for.
    """

    robot: str = flax.struct.field(pytree_node=False, default="")


def _changed(prepared: Prepared, **changes: Any) -> Experience:
    """Replace fields; the result is an Experience, so that it is checked again."""
    fields = {f.name: getattr(prepared, f.name) for f in dataclasses.fields(Experience)}
    return Experience(**fields | changes)


# Set after the class body, because flax then adds its own `replace`.
setattr(Prepared, "replace", _changed)  # noqa: B010  mypy rejects a plain assignment


def _as_numpy(x: Any) -> np.ndarray:
    """Convert an array to a numeric NumPy array with this machine's byte order."""
    if isinstance(x, np.ma.MaskedArray):
        if np.ma.is_masked(x):
            raise BadInput("experience: an array is masked: set valid = False for the masked steps")
        x = x.data
    try:
        array = np.asarray(x)
        if array.dtype == object:
            array = np.asarray(array.tolist(), np.float64)
    except (TypeError, ValueError):
        raise BadInput("experience: an array holds something other than numbers") from None
    if array.dtype.kind not in "biuf":
        raise BadInput(f"experience: an array has dtype {array.dtype}, not numbers")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _as_floats(made: Experience) -> Experience:
    """Convert integers and half floats to float64, because their arithmetic is not exact enough."""
    wide = {
        name: x.astype(np.float64)
        for name in ("s", "o", "o_next", "a", "intended", "forward")
        if (x := getattr(made, name)) is not None and x.dtype not in (np.float32, np.float64)
    }
    return made.replace(**wide)


def _lists_as_arrays(experience: Experience) -> Experience:
    """Convert lists to arrays, because jax treats lists as trees."""
    arrays = {
        f.name: np.asarray(x) if isinstance(x, list | tuple) else x
        for f in dataclasses.fields(Experience)
        if (x := getattr(experience, f.name)) is not None or f.name in OPTIONAL
    }
    return experience.replace(**arrays)


def _zero_invalid(made: Experience) -> Experience:
    """Set all numbers of invalid steps to zero."""
    valid = made.valid
    if valid.all():
        return made

    def clear(x: np.ndarray) -> np.ndarray:
        mask = valid.reshape(valid.shape + (1,) * (x.ndim - 2))
        return x if x.dtype == bool else np.where(mask, x, np.zeros_like(x))

    return jax.tree.map(clear, made)


def _check_shapes(made: Experience, robot: Robot) -> None:
    """Raise BadInput if shapes or dtypes do not fit each other or the robot."""
    steps_lanes = made.first.shape
    if len(steps_lanes) != 2:
        raise BadInput(f"experience: first has shape {steps_lanes}, expected [steps, lanes]")
    if 0 in steps_lanes:
        raise BadInput(f"experience: the record is empty: first has shape {steps_lanes}")
    state, action = (robot.observation.size,), (robot.action.size,)
    sizes: dict[str, tuple[int, ...]] = {
        "s": state, "o": (3,), "o_next": (3,), "a": action, "last": (), "valid": (),
        "intended": action, "forward": (),
    }  # fmt: skip
    for name, size in sizes.items():
        if (field := getattr(made, name)) is None and name in OPTIONAL:
            continue
        shape = np.shape(field)
        if shape != (*steps_lanes, *size):
            expected = (*steps_lanes, *size)
            raise BadInput(f"experience: {name} has shape {shape}, expected {expected}")
    for name in ("first", "last", "valid"):
        if getattr(made, name).dtype != bool:
            raise BadInput(
                f"experience: {name} has dtype {getattr(made, name).dtype}, expected bool"
            )
    if any(x.shape[:2] != steps_lanes for x in jax.tree.leaves(made.physics)):
        raise BadInput(f"experience: physics does not begin with the shape {steps_lanes} of first")
    if not made.valid.any():
        raise BadInput("experience: no step is valid")


def _check_finite(clean: Experience) -> None:
    for name in ("s", "o", "o_next", "a", *sorted(OPTIONAL)):
        for x in jax.tree.leaves(getattr(clean, name)):
            if not np.isfinite(x).all():
                t, lane = np.argwhere(~np.isfinite(x))[0][:2]
                raise BadInput(f"experience: {name} holds NaN or infinity, first in [{t}, {lane}]")


def _check_ranges(clean: Experience, robot: Robot) -> None:
    """Raise BadInput for actions and states that the robot cannot have."""
    if np.abs(clean.a).max() > 1 + 1e-6:
        t, lane = np.argwhere(np.abs(clean.a) > 1 + 1e-6)[0][:2]
        raise BadInput(f"experience: a lies outside [−1, 1], first in [{t}, {lane}]")
    lane_by_lane = clean.s.swapaxes(0, 1)[clean.valid.T]
    for invalid in robot.observation.invalid_fields(lane_by_lane):
        raise BadInput(f"experience: {invalid} (s)")


def _check_continuous(clean: Experience, robot: Robot) -> None:
    """Raise BadInput if `first` and `last` contradict each other, or a position jumps."""
    both = clean.valid[1:] & clean.valid[:-1]
    for wrong, what in (
        (both & clean.first[1:] & ~clean.last[:-1], "first, but the step before it is not last"),
        (both & ~clean.first[1:] & clean.last[:-1], "not first, but the step before it is last"),
    ):
        if wrong.any():
            t, lane = np.argwhere(wrong)[0]
            raise BadInput(f"experience: step [{t + 1}, {lane}] is {what}")
    if clean.physics is not None:  # only logs have measured positions, which can jump
        return
    if not (clean.first | clean.last).any():
        raise BadInput("experience: no step is marked as the first or the last of an episode")
    step = np.linalg.norm(clean.o_next - clean.o, axis=-1)
    # Not the maximum: if a position is corrected every second, 2 % of the steps are jumps.
    usual = np.quantile(step[clean.valid], 0.9)
    most = max(10 * usual, 5.0 * robot.dt)
    gap, steps = _gaps(clean)
    for name, jump, allowed in (("o_next", step, most), ("o", gap, most * steps)):
        beyond = np.where(jump > allowed, jump, 0)
        if beyond.any():
            t, lane = np.unravel_index(beyond.argmax(), jump.shape)
            raise BadInput(
                f"experience: the position jumps by {beyond.max():.3g} m to {name} [{t}, {lane}], "
                f"but 90 % of the steps are below {usual:.2g} m. End the episode there, or set "
                "valid = False for the step"
            )


def _gaps(clean: Experience) -> tuple[np.ndarray, np.ndarray]:
    """Metres `[T, B]` from the previous valid step's o_next to o, and how many steps ago it was.

    Without a previous valid step in the episode, the distance is 0.
    """
    rows = np.arange(len(clean.o))[:, None]
    previous = np.maximum.accumulate(np.where(clean.valid, rows, -1), axis=0)
    previous = np.concatenate([np.full_like(previous[:1], -1), previous[:-1]])
    episode = np.cumsum(clean.begins, axis=0)
    at = np.maximum(previous, 0)
    same = (previous >= 0) & (np.take_along_axis(episode, at, axis=0) == episode) & clean.valid
    o_next = np.take_along_axis(clean.o_next, at[..., None], axis=0)
    return np.linalg.norm(clean.o - o_next, axis=-1) * same, rows - previous


def _check_orientation(clean: Experience, robot: Robot) -> None:
    """Raise BadInput if headings fit the motion only in another unit or quaternion order.

    The numbers alone do not show it: slow turns in degrees can look like radians, and (x, y, z, w)
    of a robot that leans to one side can look like (w, x, y, z). But most robots walk in the
    direction of their heading.
    """
    displacement = (clean.o_next - clean.o)[clean.valid]
    distance = np.linalg.norm(displacement[:, :2], axis=-1)
    moves = distance > 0.1 * distance.max()
    course = np.arctan2(displacement[:, 1], displacement[:, 0])[moves]
    for field, part in zip(
        robot.observation.fields, robot.observation.parts(clean.s[clean.valid][moves]), strict=True
    ):
        if field.otherwise is None or field.yaw is None or not len(course):
            continue
        convert, words = field.otherwise
        other = convert(part)
        if other is None:
            continue
        as_given, converted = (
            np.cos(np.asarray(field.yaw(jnp.asarray(x))) - course).mean() for x in (part, other)
        )
        if as_given < 0.5 and converted > 0.9:
            raise BadInput(f"experience: {field.name!r} fits the robot's motion only {words} (s)")


def record(step: Transition, intended: jax.Array | None = None) -> Experience:
    """Convert one transition of B lanes to Experience, arrays `[B, ...]`.

    Args:
      step: the transition.
      intended: `[B, A]`, the actions before exploration.
    """
    return Experience(
        s=step.before.observation,
        o=step.before.position,
        o_next=step.after.position,
        a=step.action,
        first=step.first,
        last=step.last,
        valid=~step.after.diverged,
        physics=step.before.physics,
        intended=intended,
        forward=step.view.forward,
    )


def concatenate(parts: list[Experience]) -> Experience:
    """Join records along time, on the host."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(p) for p in x]), *parts)


def load(path: Path | str, robot: Robot) -> Experience:
    """Load a record that `Experience.save` wrote.

    Raises:
      BadInput: the directory is corrupt, or the record does not fit the robot.
    """
    tree, _ = files.load_arrays(path)
    if tree.keys() | OPTIONAL != {f.name for f in dataclasses.fields(Experience)}:
        raise BadInput(f"{path} does not hold an experience")
    experience = Experience(**tree)
    _check_shapes(experience, robot)
    if experience.physics is None:
        return experience
    try:
        physics = flax.serialization.from_state_dict(robot.physics, experience.physics)
    except ValueError:
        raise BadInput(f"{path} holds the physics of another robot, not {robot.name}") from None
    return experience.replace(physics=physics)


def load_chunks(directory: Path, robot: Robot, interactions: int | None = None) -> Experience:
    """Load the record that `collect` wrote in chunks.

    Args:
      directory: the directory of the chunks.
      robot: the robot of the record.
      interactions: expected number of interactions; None: any number.

    Raises:
      BadInput: a chunk is corrupt, or missing.
    """
    chunks = [load(path, robot) for path in sorted(directory.glob("chunk_*"))]
    found = sum(chunk.interactions for chunk in chunks)
    if interactions is not None and found != interactions:
        raise Corrupt(
            f"{directory} holds {found} of {interactions} interactions: a chunk is missing. "
            f"Delete {directory.parent} to make it anew"
        )
    return concatenate(chunks)


def goal_step(last: jax.Array, goal_horizon: int) -> tuple[jax.Array, jax.Array]:
    """Index of the step `goal_horizon` − 1 later; its o_next is the intermediate goal o' (Def. 1).

    A step has no goal if its episode, or the record, ends earlier. So no action that leads to a
    fall within the goal horizon becomes a sample.

    Args:
      last: `[T, B]` bool, the last step of an episode.
      goal_horizon: steps, at least 1; 1 is the paper's "next position".

    Returns:
      the indices `[T, B]` in the first dimension, and whether the goal exists, `[T, B]` bool.
    """
    steps = last.shape[0]
    time = jnp.arange(steps)[:, None]
    end = jax.lax.cummin(jnp.where(last, time, steps - 1), axis=0, reverse=True)
    goal = time + goal_horizon - 1
    return jnp.minimum(goal, end), goal <= end
