"""Experience (Def. 1): what a robot did while it learned something else."""

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

# Metres; farther off, float32 rounds a position by more than 0.01 mm.
FAR = 100.0


class Experience(flax.struct.PyTreeNode):
    """Recorded transitions, T steps of B lanes, in the order they happened.

    Attributes:
      s: `[T, B, S]`, state before the step.
      o: `[T, B, 3]`, position before the step, metres, world frame.
      o_next: `[T, B, 3]`, position after it, before any reset.
      a: `[T, B, A]`, action in [−1, 1].
      first: `[T, B]` bool, the first step of an episode.
      last: `[T, B]` bool, the last step of an episode.
      valid: `[T, B]` bool, False where the physics diverged in the step.
      physics: tree `[T, B, ...]`, physics before the step, or None for a log that has
        none: it can be rotated exactly (`Generalize(mode="rotate")`), but not replayed.
    """

    s: Any
    o: Any
    o_next: Any
    a: Any
    first: Any
    last: Any
    valid: Any
    physics: Any = None

    @property
    def interactions(self) -> int:
        """Number of recorded transitions."""
        return self.first.shape[0] * self.first.shape[1]

    def first_fraction(self, fraction: float) -> Experience:
        """The earliest `fraction` of the record, in (0, 1]."""
        steps = max(1, round(self.first.shape[0] * fraction))
        return jax.tree.map(lambda x: x[:steps], self)

    def first_half(self) -> Experience:
        """What GE and LR learn from (A.1.2)."""
        return self.first_fraction(0.5)

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Writes the record as a directory of arrays, without pickle.

        Raises:
          BadInput: there is a record already, and `overwrite` is not set; or one of its valid
            steps holds what is not finite.
        """
        made = jax.tree.map(_plain, _named(self))
        lanes = made.first.shape
        if any(x.shape[:2] != lanes for x in jax.tree.leaves(made)):
            raise BadInput(f"experience: not all arrays are of {lanes} steps and lanes")
        _finite(_cleared(made))
        tree = flax.serialization.to_state_dict(made)
        there = {name: x for name, x in tree.items() if x is not None}
        files.save_arrays(path, there, {}, overwrite)

    @property
    def ends(self) -> np.ndarray:
        """`[T, B]` bool, where an episode ends: it says so, or the next step begins one."""
        last, first = np.asarray(self.last), np.asarray(self.first)
        return last | np.concatenate([first[1:], np.zeros_like(first[:1])])

    @property
    def begins(self) -> np.ndarray:
        """`[T, B]` bool, where an episode begins, or the record does."""
        ends = self.ends
        return np.concatenate([np.ones_like(ends[:1]), ends[:-1]])

    def prepared(self, robot: Robot) -> Experience:
        """The record as 𝒢 and a fit can use it: NumPy arrays, and s as controllers are fed it.

        Steps that are not `valid` are not looked at: what they hold is set to zero. Positions
        that float32 would round (UTM), without physics to be replayed from, count from the start
        of each episode; that is subtracted in the precision that they come in.

        Raises:
          BadInput: the shapes do not fit together or the robot, or what a valid step holds cannot
            be: numbers that are not finite, actions outside [−1, 1], an orientation that is none,
            positions that jump, episodes that begin where none has ended.
        """
        if isinstance(self, Prepared) and self.robot == robot.name:
            return self
        made = _numbers(jax.tree.map(_plain, _named(self)))
        _fitting(made, robot)
        clean = _cleared(made)
        _finite(clean)
        _possible(clean, robot)
        _continuous(clean, robot)
        _read_otherwise(clean, robot)
        if clean.far_away:
            clean = clean.centred()
        narrow = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, clean)
        s = np.asarray(robot.observation.canonical(jnp.asarray(narrow.s)))
        fields = {f.name: getattr(narrow, f.name) for f in dataclasses.fields(Experience)}
        return Prepared(**fields | {"s": s.astype(np.float32, copy=False)}, robot=robot.name)

    @property
    def far_away(self) -> bool:
        """Whether positions are to be counted from the start of each episode."""
        return self.physics is None and bool(np.abs(np.asarray(self.o)[self.valid]).max() > FAR)

    def centred(self) -> Experience:
        """Positions that count from the start of each episode, horizontally."""
        o = np.asarray(self.o, np.float64)
        rows = np.arange(len(o))[:, None]
        start = np.maximum.accumulate(np.where(self.begins, rows, 0), axis=0)
        # The first step that is valid: what others hold is nothing to count from.
        valid = np.where(np.asarray(self.valid), rows, len(o) - 1)
        valid = np.minimum.accumulate(valid[::-1], axis=0)[::-1]
        first = np.take_along_axis(valid, start, axis=0)
        origin = np.take_along_axis(o, first[..., None], axis=0) * [1, 1, 0]
        return self.replace(o=o - origin, o_next=np.asarray(self.o_next) - origin)


class Prepared(Experience):
    """What `Experience.prepared` returns: it is checked once, however often it is prepared.

    Attributes:
      robot: name of the robot that it was checked for.
    """

    robot: str = flax.struct.field(pytree_node=False, default="")


def _changed(prepared: Prepared, **changes: Any) -> Experience:
    """An Experience with changes, which has to be checked again."""
    fields = {f.name: getattr(prepared, f.name) for f in dataclasses.fields(Experience)}
    return Experience(**fields | changes)


# flax gives each class a `replace` of its own, after its body.
setattr(Prepared, "replace", _changed)  # noqa: B010  mypy takes no assignment to a method


def _plain(x: Any) -> np.ndarray:
    """An array as NumPy computes with it, of this machine's byte order."""
    if isinstance(x, np.ma.MaskedArray):
        if np.ma.is_masked(x):
            raise BadInput("experience: an array is masked: mark those steps as not valid")
        x = x.data
    try:
        array = np.asarray(x)
        if array.dtype == object:
            array = np.asarray(array.tolist(), np.float64)
    except (TypeError, ValueError):
        raise BadInput("experience: an array holds something else than numbers") from None
    if array.dtype.kind not in "biuf":
        raise BadInput(f"experience: an array holds {array.dtype}, not numbers")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _numbers(made: Experience) -> Experience:
    """The record with floats of 32 or 64 bits: integers and half floats reckon otherwise."""
    wide = {
        name: x.astype(np.float64)
        for name in ("s", "o", "o_next", "a")
        if (x := getattr(made, name)).dtype not in (np.float32, np.float64)
    }
    return made.replace(**wide)


def _named(experience: Experience) -> Experience:
    """The record with lists, which are trees to jax, as arrays."""
    lists = {
        f.name: np.asarray(x) if isinstance(x, list | tuple) else x
        for f in dataclasses.fields(Experience)
        if (x := getattr(experience, f.name)) is not None or f.name == "physics"
    }
    return experience.replace(**lists)


def _cleared(made: Experience) -> Experience:
    """The record with zeros in the steps that are not valid."""
    valid = made.valid
    if valid.all():
        return made

    def clear(x: np.ndarray) -> np.ndarray:
        there = valid.reshape(valid.shape + (1,) * (x.ndim - 2))
        return x if x.dtype == bool else np.where(there, x, np.zeros_like(x))

    return jax.tree.map(clear, made)


def _fitting(made: Experience, robot: Robot) -> None:
    """Refuses shapes and flags that do not fit together, or the robot."""
    lanes = made.first.shape
    if len(lanes) != 2:
        raise BadInput(f"experience: first has shape {lanes}, not that of [steps, lanes]")
    if 0 in lanes:
        raise BadInput(f"experience: the record is empty: it has {lanes} steps and lanes")
    sizes = {"s": (robot.observation.size,), "o": (3,), "o_next": (3,), "a": (robot.action.size,)}
    for name, size in (sizes | {"last": (), "valid": ()}).items():
        shape = getattr(made, name).shape
        if shape != (*lanes, *size):
            raise BadInput(f"experience: {name} has shape {shape}, not {(*lanes, *size)}")
    for name in ("first", "last", "valid"):
        if getattr(made, name).dtype != bool:
            raise BadInput(f"experience: {name} is of {getattr(made, name).dtype}, not bool")
    if any(x.shape[:2] != lanes for x in jax.tree.leaves(made.physics)):
        raise BadInput(f"experience: physics is not of {lanes} steps and lanes")
    if not made.valid.any():
        raise BadInput("experience: no step is valid")


def _finite(clean: Experience) -> None:
    for name in ("s", "o", "o_next", "a", "physics"):
        for x in jax.tree.leaves(getattr(clean, name)):
            if not np.isfinite(x).all():
                t, lane = np.argwhere(~np.isfinite(x))[0][:2]
                raise BadInput(f"experience: {name} holds NaN or infinity, first in [{t}, {lane}]")


def _possible(clean: Experience, robot: Robot) -> None:
    """Refuses actions and states that the robot cannot have."""
    if np.abs(clean.a).max() > 1 + 1e-6:
        t, lane = np.argwhere(np.abs(clean.a) > 1 + 1e-6)[0][:2]
        raise BadInput(f"experience: a lies outside [−1, 1], first in [{t}, {lane}]")
    lane_by_lane = clean.s.swapaxes(0, 1)[clean.valid.T]
    for invalid in robot.observation.invalid_fields(lane_by_lane):
        raise BadInput(f"experience: {invalid} (s)")


def _continuous(clean: Experience, robot: Robot) -> None:
    """Refuses flags and positions that contradict each other, or a robot that is carried away."""
    both = clean.valid[1:] & clean.valid[:-1]
    for wrong, what in (
        (both & clean.first[1:] & ~clean.last[:-1], "begins an episode, where none has ended"),
        (both & ~clean.first[1:] & clean.last[:-1], "begins none, where one has ended"),
    ):
        if wrong.any():
            t, lane = np.argwhere(wrong)[0]
            raise BadInput(f"experience: step [{t + 1}, {lane}] {what} (first, last)")
    if clean.physics is not None:  # a simulation knows where its robots are
        return
    if not (clean.first | clean.last).any():
        raise BadInput("experience: no step is marked as the first or the last of an episode")
    step = np.linalg.norm(clean.o_next - clean.o, axis=-1)
    # Not all of the steps: where a position is put right each second, two in a hundred are jumps.
    usual = np.quantile(step[clean.valid], 0.9)
    most = max(10 * usual, 5.0 * robot.dt)
    gap, steps = _gaps(clean)
    for name, jump, allowed in (("o_next", step, most), ("o", gap, most * steps)):
        beyond = np.where(jump > allowed, jump, 0)
        if beyond.any():
            t, lane = np.unravel_index(beyond.argmax(), jump.shape)
            raise BadInput(
                f"experience: the position jumps by {beyond.max():.3g} m to {name} [{t}, {lane}], "
                f"where 90 % of the steps are below {usual:.2g} m: end the episode there, or mark "
                "the step as not valid"
            )


def _gaps(clean: Experience) -> tuple[np.ndarray, np.ndarray]:
    """Metres from where the step before ended `[T, B]`, and how many steps before that was.

    The step before is the last valid one of the episode; without one the distance is 0.
    """
    rows = np.arange(len(clean.o))[:, None]
    before = np.maximum.accumulate(np.where(clean.valid, rows, -1), axis=0)
    before = np.concatenate([np.full_like(before[:1], -1), before[:-1]])
    episode = np.cumsum(clean.begins, axis=0)
    at = np.maximum(before, 0)
    same = (before >= 0) & (np.take_along_axis(episode, at, axis=0) == episode) & clean.valid
    there = np.take_along_axis(clean.o_next, at[..., None], axis=0)
    return np.linalg.norm(clean.o - there, axis=-1) * same, rows - before


def _read_otherwise(clean: Experience, robot: Robot) -> None:
    """Refuses an orientation that fits the way that a robot goes only where it is read otherwise.

    Degrees that turn slowly, or (x, y, z, w) of a robot that leans to one side, are numbers that
    radians and (w, x, y, z) might be. A robot that faces where it goes tells them apart.
    """
    way = (clean.o_next - clean.o)[clean.valid]
    moves = np.linalg.norm(way[:, :2], axis=-1)
    moves = moves > 0.1 * moves.max()
    course = np.arctan2(way[:, 1], way[:, 0])[moves]
    for field, part in zip(
        robot.observation.fields, robot.observation.parts(clean.s[clean.valid][moves]), strict=True
    ):
        if field.otherwise is None or field.yaw is None or not len(course):
            continue
        read, words = field.otherwise
        other = read(part)
        if other is None:
            continue
        here, there = (
            np.cos(np.asarray(field.yaw(jnp.asarray(x))) - course).mean() for x in (part, other)
        )
        if here < 0.5 and there > 0.9:
            raise BadInput(f"experience: {field.name!r} fits the way of the robot {words} (s)")


def record(step: Transition) -> Experience:
    """The experience in one transition of B lanes, arrays `[B, ...]`."""
    return Experience(
        s=step.before.observation,
        o=step.before.position,
        o_next=step.after.position,
        a=step.action,
        first=step.first,
        last=step.last,
        valid=~step.after.diverged,
        physics=step.before.physics,
    )


def concatenate(parts: list[Experience]) -> Experience:
    """Records that follow one another in time, as one, on the host."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(p) for p in x]), *parts)


def load(path: Path | str, robot: Robot) -> Experience:
    """A record that `Experience.save` wrote.

    Raises:
      BadInput: the directory is corrupt, or the record is another robot's.
    """
    tree, _ = files.load_arrays(path)
    if tree.keys() | {"physics"} != {f.name for f in dataclasses.fields(Experience)}:
        raise BadInput(f"{path} holds no experience")
    experience = Experience(**tree)
    _fitting(experience, robot)
    if experience.physics is None:
        return experience
    try:
        physics = flax.serialization.from_state_dict(robot.physics, experience.physics)
    except ValueError:
        raise BadInput(f"{path} holds the physics of another robot than {robot.name}") from None
    return experience.replace(physics=physics)


def load_chunks(directory: Path, robot: Robot, interactions: int | None = None) -> Experience:
    """The record that `collect` wrote in chunks.

    Args:
      directory: where they lie.
      robot: whose record it is.
      interactions: how many there must be; as many as there are, unless given.

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
    """Where the intermediate goal o' of each step (Def. 1) lies: `goal_horizon` − 1 steps later.

    A step whose episode, or record, ends before that has no such goal. So what led to a fall
    within the goal horizon is not taken for a way to go anywhere.

    Args:
      last: `[T, B]` bool, the last step of an episode.
      goal_horizon: steps, at least 1; 1 is the paper's "next position".

    Returns:
      the step `[T, B]` whose outcome is o', and whether there is one, `[T, B]` bool.
    """
    steps = last.shape[0]
    time = jnp.arange(steps)[:, None]
    end = jax.lax.cummin(jnp.where(last, time, steps - 1), axis=0, reverse=True)
    goal = time + goal_horizon - 1
    return jnp.minimum(goal, end), goal <= end
