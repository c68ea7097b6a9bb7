"""Pairs: equivalent views of one action, from a record and its turned replay (Def. 3)."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

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

# Share of a record that is too little to be learned from without a word.
FEW = 0.25
# How d transforms is declared as everything else is.
DIRECTION = symmetry.vector("direction", unit="1")


class Pairs(flax.struct.PyTreeNode):
    """G = E ∪ 𝒢(E), sample by sample: N samples in V = 1 + copies equivalent views.

    View 0 is the record itself. The views of one sample share its action (Def. 3).

    Attributes:
      s: `[V, N, S]`.
      d: `[V, N, 3]`, unit vectors o → o' (Remark 2).
      a: `[N, A]`.
    """

    s: Any
    d: Any
    a: Any


def pairs(
    robot: Robot,
    experience: Experience,
    turned: RotatedReplay | None = None,
    *,
    goal_horizon: int = 100,
    mirror: bool = False,
) -> Pairs:
    """Samples to fit from: the record, its turned copies, and their reflections.

    Args:
      robot: whose layouts say how s and a transform.
      experience: E, `[T, B, ...]`.
      turned: 𝒢(E), or None for the record alone.
      goal_horizon: h, steps to the intermediate goal o'; 1 is the paper's reading. Steps
        whose episode ends before are left out. Where o' lies beyond what was replayed in
        one piece, it is the record's own, turned.
      mirror: adds the reflection y → −y of every sample, in every view.

    Raises:
      BadInput: goal_horizon is no whole number from 1 on, or longer than all episodes, or the
        record is unusable.
    """
    check_value("goal_horizon", goal_horizon, count())
    experience = experience.prepared(robot)
    goal, exists = map(np.asarray, goal_step(jnp.asarray(experience.ends), goal_horizon))
    ahead = np.take_along_axis(experience.o_next, goal[..., None], axis=0)
    views = [(experience.s, ahead - experience.o)]
    # A step that is not valid is no goal for others, either.
    _tell_of_gaps(experience)
    valid = experience.valid & exists & np.take_along_axis(experience.valid, goal, axis=0)
    for copy in _copies(turned):
        views.append((copy.s, _goal(copy, goal, ahead) - copy.o))
        valid = valid & copy.valid
    if 0 < valid.mean() < FEW:
        said = (
            f"goal_horizon {goal_horizon} leaves {valid.sum()} of {valid.size} steps to learn from"
        )
        warnings.warn(f"{said}: the episodes of the others end sooner", stacklevel=2)
    if not exists.any():
        raise BadInput(
            f"no episode lasts goal_horizon = {goal_horizon} steps: make it less "
            "(--method.goal-horizon), or collect more (--scale)"
        )
    out = _samples(views, experience.a, valid)
    return with_reflection(robot, out) if mirror else out


def _tell_of_gaps(experience: Experience) -> None:
    """Says how much of somebody's log is marked as not valid; a simulation counts its own."""
    if experience.physics is None and not experience.valid.all():
        gone = ~experience.valid
        t, lane = np.argwhere(gone)[0]
        said = f"{gone.sum()} of {gone.size} steps are not valid and left out, first [{t}, {lane}]"
        warnings.warn(said, stacklevel=3)


def _copies(turned: RotatedReplay | None) -> Iterator[RotatedReplay]:
    """The copies of a replay one by one, arrays `[T, B, ...]` on the host."""
    if turned is not None:
        host = jax.tree.map(np.asarray, turned)
        start = np.broadcast_to(host.start, host.yaw.shape)
        for copy in range(host.yaw.shape[0]):
            yield jax.tree.map(lambda x, n=copy: x[n], host.replace(start=start))


def _goal(copy: RotatedReplay, goal: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """o' `[T, B, 3]` of a copy: replayed where that reaches, else the record's own, turned."""
    replayed = np.take_along_axis(copy.o_next, goal[..., None], axis=0)
    exact = np.asarray(symmetry.rotate_vector(jnp.asarray(ahead), jnp.asarray(copy.yaw)))
    in_one_piece = np.take_along_axis(copy.start, goal, axis=0) == copy.start
    in_one_piece &= np.take_along_axis(copy.valid, goal, axis=0)
    return np.where(in_one_piece[..., None], replayed, exact)


def _samples(views: list[tuple[np.ndarray, np.ndarray]], a: np.ndarray, valid: np.ndarray) -> Pairs:
    """Pairs from views (s, o' − o) `[T, B, ...]`, without samples that have no direction."""
    length = np.stack([np.linalg.norm(way, axis=-1) for _, way in views])
    keep = valid & (length > 1e-6).all(axis=0)
    if not keep.any():
        raise BadInput("no sample can be learned from: no step of it is valid and leads anywhere")
    s = np.stack([s[keep] for s, _ in views])
    d = np.stack([way[keep] for _, way in views]) / length[:, keep, None]
    return Pairs(s, d, a[keep])


def with_reflection(robot: Robot, samples: Pairs) -> Pairs:
    """The samples and their reflections y → −y, 2N in all."""
    s = np.asarray(robot.observation.mirror(samples.s))
    d = np.asarray(DIRECTION.mirror(samples.d))
    a = np.asarray(robot.action.mirror(samples.a))
    return Pairs(
        s=np.concatenate([samples.s, s], axis=1),
        d=np.concatenate([samples.d, d], axis=1),
        a=np.concatenate([samples.a, a], axis=0),
    )
