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
from genidm.robots.base import Robot
from genidm.tasks import Step


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

    def first_share(self, share: float) -> Experience:
        """The earliest `share` of the record, in (0, 1]."""
        steps = max(1, round(self.first.shape[0] * share))
        return jax.tree.map(lambda x: x[:steps], self)

    def first_half(self) -> Experience:
        """What GE and LR learn from (A.1.2)."""
        return self.first_share(0.5)

    def save(self, path: Path) -> None:
        """Writes the record as a directory of arrays, without pickle."""
        tree = flax.serialization.to_state_dict(self)
        there = {name: x for name, x in tree.items() if x is not None}
        files.save_arrays(path, there, {}, overwrite=True)

    def check(self, robot: Robot) -> None:
        """Refuses a record that cannot be learned from.

        Raises:
          BadInput: the shapes do not fit together or the robot, numbers are not finite, actions
            lie outside [−1, 1], a quaternion in s is none with w ≥ 0, or flags are not bool.
        """
        lanes = np.shape(self.first)
        if len(lanes) != 2:
            raise BadInput(f"experience: first has shape {lanes}, not that of [steps, lanes]")
        state, action = robot.observation, robot.action
        sizes = {"s": (state.size,), "o": (3,), "o_next": (3,), "a": (action.size,)}
        for name, size in (sizes | {"last": (), "valid": ()}).items():
            shape = np.shape(getattr(self, name))
            if shape != (*lanes, *size):
                raise BadInput(f"experience: {name} has shape {shape}, not {(*lanes, *size)}")
        for name in (*sizes, "physics"):
            if not all(np.isfinite(x).all() for x in jax.tree.leaves(getattr(self, name))):
                raise BadInput(f"experience: {name} holds NaN or infinity")
        for name in ("first", "last", "valid"):
            if getattr(self, name).dtype != bool:
                raise BadInput(f"experience: {name} is of {getattr(self, name).dtype}, not bool")
        if np.abs(self.a).max(initial=0.0) > 1 + 1e-6:
            raise BadInput("experience: a lies outside [−1, 1]")
        for field in state.unsound(np.asarray(self.s)):
            raise BadInput(f"experience: {field!r} in s is not of length 1 with w ≥ 0 everywhere")
        if any(x.shape[:2] != lanes for x in jax.tree.leaves(self.physics)):
            raise BadInput(f"experience: physics is not of {lanes} steps and lanes")


def record(step: Step) -> Experience:
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


def load(path: Path, robot: Robot) -> Experience:
    """A record that `Experience.save` wrote.

    Raises:
      BadInput: the directory is torn, or the record is another robot's.
    """
    tree, _ = files.load_arrays(path)
    if tree.keys() | {"physics"} != {f.name for f in dataclasses.fields(Experience)}:
        raise BadInput(f"{path} holds no experience")
    experience = Experience(**tree)
    experience.check(robot)
    if experience.physics is None:
        return experience
    try:
        physics = flax.serialization.from_state_dict(robot.physics, experience.physics)
    except ValueError:
        raise BadInput(f"{path} holds the physics of another robot than {robot.name}") from None
    return experience.replace(physics=physics)


def load_chunks(directory: Path, robot: Robot) -> Experience:
    """The record that `collect` wrote in chunks."""
    return concatenate([load(path, robot) for path in sorted(directory.glob("chunk_*"))])


def goal_step(last: jax.Array, look_ahead: int) -> tuple[jax.Array, jax.Array]:
    """Where the intermediate goal o' of each step (Def. 1) lies: `look_ahead` − 1 steps later.

    A step whose episode, or record, ends before that has no such goal. So what led to a fall
    within the look-ahead is not taken for a way to go anywhere.

    Args:
      last: `[T, B]` bool, the last step of an episode.
      look_ahead: steps, at least 1; 1 is the paper's "next position".

    Returns:
      the step `[T, B]` whose outcome is o', and whether there is one, `[T, B]` bool.
    """
    steps = last.shape[0]
    time = jnp.arange(steps)[:, None]
    end = jax.lax.cummin(jnp.where(last, time, steps - 1), axis=0, reverse=True)
    goal = time + look_ahead - 1
    return jnp.minimum(goal, end), goal <= end
