"""Pairs: G = E ∪ 𝒢(E) (Def. 4), in samples of equivalent views of one action (Def. 3, Eq. 2)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from genidm import symmetry
from genidm.checks import check_value, count
from genidm.errors import BadInput
from genidm.experience import Experience, goal_step
from genidm.paper.replaying import RotatedReplay
from genidm.robots.base import Robot

# A warning is shown if less than this fraction of the record can be learned from.
FEW = 0.25
# Fraction of the samples that a fit does not see, so that its error can be measured on them.
HELD_OUT = 0.02
# Samples to turn at once.
AT_ONCE = 1 << 17
Labels = Literal["performed", "intended"]
# d rotates and mirrors by the same rules as the fields of a layout.
DIRECTION = symmetry.vector("direction", unit="1")


class Pairs(flax.struct.PyTreeNode):
    """G = E ∪ 𝒢(E), sample by sample: N samples in V = 1 + copies equivalent views.

    View 0 is the record. All views of a sample are equivalent modulo orientation (e.m.o.)
    and share its action (Def. 3, Eq. 2).

    Attributes:
      s: states `[V, N, S]`.
      d: unit vectors o → o' `[V, N, 3]` (Remark 2).
      a: actions `[N, A]`.
    """

    s: Any
    d: Any
    a: Any

    def part(self, which: slice) -> Pairs:
        """Select samples, in all their views."""
        return Pairs(self.s[:, which], self.d[:, which], self.a[which])


def pairs(
    robot: Robot,
    experience: Experience,
    turned: RotatedReplay | None = None,
    *,
    goal_horizon: int = 100,
    mirror: bool = False,
    labels: Labels = "performed",
    nearest_side: bool = False,
) -> Pairs:
    """Make the samples of a fit: the record, its rotated copies, and their reflections.

    Args:
      robot: robot of the record; its layouts define how s and a transform.
      experience: E, `[T, B, ...]`.
      turned: 𝒢(E), or None for the record only.
      goal_horizon: h, steps to the intermediate goal o' (Def. 1); 1 is the paper's "next
        position". Steps whose episode ends earlier are left out. If o' lies after the end
        of a replayed segment, the rotated o' of the record is used.
      mirror: add the reflection y → −y of every sample, in every view.
      labels: the actions of the samples: "performed", or "intended", before exploration.
      nearest_side: see `with_nearest_side`.

    Raises:
      BadInput: goal_horizon is not a whole number ≥ 1, or is longer than every episode, or
        the record is invalid, or it has no intended actions.
    """
    record = _usable(robot, experience, turned, goal_horizon, labels)
    return _samples(robot, record, record.usable, mirror, nearest_side)


def split_pairs(
    robot: Robot,
    experience: Experience,
    turned: RotatedReplay | None = None,
    *,
    goal_horizon: int = 100,
    mirror: bool = False,
    labels: Labels = "performed",
    nearest_side: bool = False,
) -> tuple[Pairs, Pairs]:
    """Make `pairs`, and keep those of a few episodes apart, to measure the error of the fit.

    Whole episodes are drawn at random that hold up to 2 % of the samples together. An episode
    with more than 2 % (a short log) counts as several, of consecutive samples. Records with the
    same usable steps have the same held-out ones, so that their fits can be compared.

    Args:
      robot: robot of the record.
      experience: E, `[T, B, ...]`.
      turned: 𝒢(E), or None for the record only.
      goal_horizon: h, as in `pairs`.
      mirror: add the reflection of every sample.
      labels: the actions of the samples.
      nearest_side: see `with_nearest_side`.

    Returns:
      the samples of the fit, and the held-out samples, with their copies and reflections. If the
      record has one sample only, nothing is held out, and N is 0.

    Raises:
      BadInput: as in `pairs`.
    """
    record = _usable(robot, experience, turned, goal_horizon, labels)
    held_out = _held_out(record.begins, record.usable)
    fitted = _samples(robot, record, record.usable & ~held_out, mirror, nearest_side)
    return fitted, _samples(robot, record, held_out, mirror, nearest_side)


class _Usable(NamedTuple):
    """A record before its samples are selected.

    Attributes:
      views: (s `[T, B, S]`, o' − o `[T, B, 3]`) of each view.
      a: actions `[T, B, A]`.
      begins: `[T, B]` bool, the first step of an episode.
      usable: `[T, B]` bool, whether the step is a sample.
    """

    views: list[tuple[np.ndarray, np.ndarray]]
    a: np.ndarray
    begins: np.ndarray
    usable: np.ndarray


def _usable(
    robot: Robot,
    experience: Experience,
    turned: RotatedReplay | None,
    goal_horizon: int,
    labels: Labels,
) -> _Usable:
    check_value("goal_horizon", goal_horizon, count())
    experience = experience.prepared(robot)
    goal, exists = map(np.asarray, goal_step(jnp.asarray(experience.ends), goal_horizon))
    recorded = np.take_along_axis(experience.o_next, goal[..., None], axis=0)
    views = [(experience.s, recorded - experience.o)]
    _warn_of_invalid_steps(experience)
    # The position after an invalid step is not used as a goal, either.
    valid = experience.valid & exists & np.take_along_axis(experience.valid, goal, axis=0)
    for copy in _copies(turned):
        views.append((copy.s, _goal(copy, goal, recorded) - copy.o))
        valid = valid & copy.valid
    _check_enough(goal_horizon, exists, valid)
    for _, move in views:
        valid = valid & (np.linalg.norm(move, axis=-1) > 1e-6)
    if not valid.any():
        raise BadInput("no sample can be learned from: no valid step moves the robot")
    return _Usable(views, _labels(experience, labels), experience.begins, valid)


def _check_enough(goal_horizon: int, exists: np.ndarray, valid: np.ndarray) -> None:
    """Warn if few steps can be learned from; raise BadInput if all episodes are too short."""
    if 0 < valid.mean() < FEW:
        said = (
            f"goal_horizon {goal_horizon} leaves {valid.sum()} of {valid.size} steps to learn from"
        )
        warnings.warn(f"{said}: the episodes of the other steps end earlier", stacklevel=4)
    if not exists.any():
        raise BadInput(
            f"no episode lasts goal_horizon = {goal_horizon} steps: reduce it "
            "(--method.goal-horizon), or collect more (--scale)"
        )


def _labels(experience: Experience, labels: Labels) -> np.ndarray:
    a = experience.a if labels == "performed" else experience.intended
    if a is None:
        raise BadInput('this record has no intended actions: use the labels "performed"')
    return np.asarray(a)


def _warn_of_invalid_steps(experience: Experience) -> None:
    """Warn about the invalid steps of a log; a simulation reports its own."""
    if experience.physics is None and not experience.valid.all():
        invalid = ~experience.valid
        t, lane = np.argwhere(invalid)[0]
        said = f"{invalid.sum()} of {invalid.size} steps are not valid and left out"
        warnings.warn(f"{said}, first [{t}, {lane}]", stacklevel=4)


def _copies(turned: RotatedReplay | None) -> Iterator[RotatedReplay]:
    """Yield the copies of a replay, arrays `[T, B, ...]` on the host."""
    if turned is not None:
        host = jax.tree.map(np.asarray, turned)
        start = np.broadcast_to(host.start, host.yaw.shape)
        for copy in range(host.yaw.shape[0]):
            yield jax.tree.map(lambda x, n=copy: x[n], host.replace(start=start))


def _goal(copy: RotatedReplay, goal: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """o' `[T, B, 3]` of a copy: replayed if in the same segment, else the record's, rotated."""
    replayed = np.take_along_axis(copy.o_next, goal[..., None], axis=0)
    exact = np.asarray(symmetry.rotate_vector(jnp.asarray(recorded), jnp.asarray(copy.yaw)))
    same_segment = np.take_along_axis(copy.start, goal, axis=0) == copy.start
    same_segment &= np.take_along_axis(copy.valid, goal, axis=0)
    return np.where(same_segment[..., None], replayed, exact)


def _held_out(begins: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Draw the held-out samples `[T, B]` bool: whole episodes, or parts of long ones."""
    lane, time = np.nonzero(usable.T)
    most = math.ceil(HELD_OUT * len(time))
    episode = np.cumsum(begins, axis=0)[time, lane]
    starts = np.append(True, (np.diff(lane) != 0) | (np.diff(episode) != 0))
    sample = np.arange(len(time))
    within = sample - np.maximum.accumulate(np.where(starts, sample, 0))
    group = np.cumsum(within % most == 0) - 1
    sizes = np.bincount(group)
    order = np.random.default_rng(0).permutation(len(sizes))
    drawn = max(1, np.count_nonzero(np.cumsum(sizes[order]) <= most))
    out = np.zeros_like(usable)
    out[time, lane] = np.isin(group, order[:drawn]) & (len(sizes) > 1)
    return out


def _samples(
    robot: Robot, record: _Usable, keep: np.ndarray, mirror: bool, nearest_side: bool
) -> Pairs:
    """Pairs of the steps of a record that `keep [T, B]` selects."""
    moves = np.stack([move[keep] for _, move in record.views])
    d = moves / np.linalg.norm(moves, axis=-1, keepdims=True)
    out = Pairs(np.stack([s[keep] for s, _ in record.views]), d, record.a[keep])
    if nearest_side:
        out = with_nearest_side(robot, out)
    return with_reflection(robot, out) if mirror else out


def with_nearest_side(robot: Robot, samples: Pairs) -> Pairs:
    """Turn the body's axes in every sample, so that the side nearest to d is its front.

    This uses the symmetry of a body with four equal sides (the Ant): d is then within ±45° of the
    heading in all samples. All views of a sample turn by the same quarters.

    Raises:
      BadInput: the robot has no such body.
    """
    if not robot.can_turn_body:
        raise BadInput(f"nearest_side needs a body with four equal sides, not the {robot.name}")
    yaw, state, action = robot.observation.yaw, robot.observation, robot.action

    @jax.jit
    def turn(part: Pairs) -> Pairs:
        angle = jnp.arctan2(part.d[0, :, 1], part.d[0, :, 0])
        quarters = symmetry.quarters_to(angle, yaw(part.s[0]))
        s = state.turn_body_by(part.s, jnp.broadcast_to(quarters, part.s.shape[:2]))
        return Pairs(s, part.d, action.turn_body_by(part.a, quarters))

    # In parts, because all samples at once would need five times their memory.
    edges = range(0, len(samples.a), AT_ONCE)
    parts = [turn(samples.part(slice(i, i + AT_ONCE))) for i in edges]
    s, a = [np.asarray(p.s) for p in parts], [np.asarray(p.a) for p in parts]
    return Pairs(np.concatenate(s, axis=1), samples.d, np.concatenate(a))


def with_reflection(robot: Robot, samples: Pairs) -> Pairs:
    """Add the reflection y → −y of every sample: 2N samples."""
    s = np.asarray(robot.observation.mirror(samples.s))
    d = np.asarray(DIRECTION.mirror(samples.d))
    a = np.asarray(robot.action.mirror(samples.a))
    return Pairs(
        s=np.concatenate([samples.s, s], axis=1),
        d=np.concatenate([samples.d, d], axis=1),
        a=np.concatenate([samples.a, a], axis=0),
    )
