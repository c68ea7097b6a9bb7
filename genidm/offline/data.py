"""A record as the dataset of offline goal-conditioned RL, with goals in hindsight.

A goal is a position (in OGBench: a whole state), because a test gives a position only. A network
sees the state s and the goal relative to the robot, g − o, as the paper's goal-conditioned
baselines do. With 𝒢, a sample is seen in the record or in one of its rotated copies, and its
next state and its goals are rotated with it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from genidm import symmetry
from genidm.checks import check, number
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.paper.replaying import RotatedReplay
from genidm.robots.base import Robot
from genidm.tasks import inputs

STD_FLOOR = 1e-2
# Inputs that are drawn to measure the mean and the standard deviation.
MEASURED = 1 << 16


@dataclasses.dataclass(frozen=True)
class Goals:
    """Where goals come from, as probabilities with the sum 1 (OGBench's `GCDataset`).

    Attributes:
      current: the position of the step itself.
      future: a later position in the same trajectory.
      random: the position of any step of the record.
      geometric: a future goal is a geometric number of steps ahead (with the learner's discount),
        at most the rest of the trajectory; False draws it evenly from the rest.
    """

    current: float = 0.0
    future: float = 1.0
    random: float = 0.0
    geometric: bool = False

    def __post_init__(self) -> None:
        share = number(0, 1)
        check(self, current=share, future=share, random=share)
        if abs(self.current + self.future + self.random - 1) > 1e-6:
            raise BadInput("the probabilities of current, future and random goals must add up to 1")


class Dataset(flax.struct.PyTreeNode):
    """N states in V = 1 + copies views, episode by episode in time order; view 0 is the record.

    A trajectory is a part of an episode without invalid steps. Its last state has no next state,
    so its action is not learned from, but its position is a goal of the states before it.

    Attributes:
      s: states `[V, N, S]`.
      o: positions `[V, N, 3]`, metres.
      yaw: `[V, N]`, radians, rotation of each state against the record; 0 in view 0.
      usable: `[V, N]` bool, the state is valid in this view.
      segment: `[N]` int32, first state of the replayed segment.
      a: actions `[N, A]`.
      end: `[N]` int32, last state of the trajectory.
      starts: `[M]` int32, states that are learned from: valid in all views, with a next state.
      mean: `[S + 3]`, mean of the inputs.
      std: `[S + 3]`, standard deviation of the inputs, at least 0.01.
      robot: robot of the record.
    """

    s: Any
    o: Any
    yaw: Any
    usable: Any
    segment: Any
    a: Any
    end: Any
    starts: Any
    mean: Any
    std: Any
    robot: Robot = flax.struct.field(pytree_node=False)

    def at(self, sample: Sample, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        """States `[..., n, S]` and positions `[..., n, 3]` of steps, as a sample's view sees them.

        Inside the sample's segment this is the replayed state; elsewhere, where the copy has
        another yaw, it is the record's own, rotated by the sample's yaw (as in `pairs`).
        """
        view, n = sample.view, sample.n
        if self.s.shape[0] == 1:
            return self.s[0, step], self.o[0, step]
        yaw = jnp.broadcast_to(self.yaw[view, n], step.shape)
        near = (self.segment[step] == self.segment[n]) & self.usable[view, step]
        s = self.robot.observation.rotate(self.s[0, step], yaw)
        o = symmetry.rotate_vector(self.o[0, step], yaw)
        # View 0 is the record itself: rotated by 0, its numbers would change by rounding.
        near = (near | (view == 0))[..., None]
        return jnp.where(near, self.s[view, step], s), jnp.where(near, self.o[view, step], o)

    def seen(self, sample: Sample, step: jax.Array, goal: jax.Array) -> jax.Array:
        """Normalised network inputs (s, g − o) `[..., n, S + 3]` at steps, with goals at others."""
        s, o = self.at(sample, step)
        return normalize(inputs(s, self.at(sample, goal)[1] - o), self.mean, self.std)


class Sample(flax.struct.PyTreeNode):
    """Samples of a minibatch: state `n [n]` of view `view [n]`."""

    view: jax.Array
    n: jax.Array


def normalize(x: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """Normalise inputs by the statistics of the training data, and clip them to ±10."""
    return jnp.clip((x - mean) / std, -10.0, 10.0)


def draw_samples(data: Dataset, key: jax.Array, size: int) -> Sample:
    """Draw samples from all views alike."""
    sample_key, view_key = jax.random.split(key)
    view = jax.random.randint(view_key, (size,), 0, data.s.shape[0])
    return Sample(view, random_states(data, sample_key, size))


def random_states(data: Dataset, key: jax.Array, size: int) -> jax.Array:
    """Draw states `[size]` of the record that have a next state."""
    return data.starts[jax.random.randint(key, (size,), 0, data.starts.size)]


def draw_goals(
    data: Dataset, key: jax.Array, n: jax.Array, goals: Goals, discounting: float
) -> jax.Array:
    """Draw the states `[n]` whose positions are the goals of states n."""
    future_key, random_key, kind_key = jax.random.split(key, 3)
    future = future_states(data, future_key, n, goals.geometric, discounting)
    random = random_states(data, random_key, n.size)
    kind = jax.random.uniform(kind_key, n.shape)
    drawn = jnp.where(kind < goals.current + goals.future, future, random)
    return jnp.where(kind < goals.current, n, drawn)


def future_states(
    data: Dataset, key: jax.Array, n: jax.Array, geometric: bool, discounting: float
) -> jax.Array:
    """Draw a later state `[n]` of the same trajectory for each state n."""
    left = data.end[n] - n
    if geometric:
        ahead = jax.random.geometric(key, 1 - discounting, n.shape, jnp.int32)
        return n + jnp.minimum(ahead, left)
    share = jax.random.uniform(key, n.shape)
    ahead = jnp.minimum(left, 1) * share + left * (1 - share)
    return n + jnp.round(ahead).astype(jnp.int32)


def dataset(robot: Robot, experience: Experience, turned: RotatedReplay | None = None) -> Dataset:
    """Make the dataset of a record and its rotated copies: E ∪ 𝒢(E) (Def. 4).

    Args:
      robot: robot of the record.
      experience: E, `[T, B, ...]`.
      turned: 𝒢(E), or None for the record only.

    Raises:
      BadInput: the record is invalid, or no trajectory has two valid states in a row.
    """
    experience = experience.prepared(robot)
    valid = _by_episode(experience.valid)
    views = [_view(experience, np.zeros_like(experience.o[..., 0]))]
    if turned is not None:
        copies = range(np.shape(turned.yaw)[0])
        views += [_view(jax.tree.map(lambda x, c=c: x[c], _copies(turned)), None) for c in copies]
    s, o, yaw, usable = (np.stack(x) for x in zip(*views, strict=True))
    end = _ends(experience)
    starts = np.flatnonzero(usable.all(0) & (np.arange(end.size) < end))
    if not starts.size:
        raise BadInput("no step can be learned from: no valid step has a valid next step")
    segment = np.zeros_like(end) if turned is None else _segments(turned, experience)
    size = robot.observation.size + 3
    return Dataset(
        s, o, yaw, usable & valid, segment, _by_episode(experience.a), end,
        starts.astype(np.int32), np.zeros(size, np.float32), np.ones(size, np.float32), robot,
    )  # fmt: skip


def _copies(turned: RotatedReplay) -> RotatedReplay:
    return turned.replace(start=np.broadcast_to(turned.start, np.shape(turned.yaw)))


def _view(part: Any, yaw: np.ndarray | None) -> tuple[np.ndarray, ...]:
    yaw = np.asarray(part.yaw if yaw is None else yaw)
    return tuple(_by_episode(np.asarray(x)) for x in (part.s, part.o, yaw, part.valid))


def _by_episode(x: np.ndarray) -> np.ndarray:
    """Reshape `[T, B, ...]` to `[B · T, ...]`: the steps of a lane lie in a row."""
    return np.ascontiguousarray(x.swapaxes(0, 1)).reshape(-1, *x.shape[2:])


def _segments(turned: RotatedReplay, experience: Experience) -> np.ndarray:
    """`[N]` int32, the first state of each state's segment."""
    steps, lanes = experience.first.shape
    start = _by_episode(np.asarray(turned.start)).astype(np.int32)
    return start + np.repeat(np.arange(lanes, dtype=np.int32) * steps, steps)


def _ends(experience: Experience) -> np.ndarray:
    """`[N]` int32, the last state of each state's trajectory."""
    last = experience.ends.copy()
    last[-1] = True
    last[:-1] |= ~experience.valid[1:]
    last = _by_episode(last)
    state = np.arange(last.size, dtype=np.int32)
    ends = np.where(last, state, last.size)
    return np.minimum.accumulate(ends[::-1])[::-1].astype(np.int32)


def measured(data: Dataset, key: jax.Array) -> Dataset:
    """Set the statistics of the inputs, with goals drawn evenly from the rest of a trajectory."""
    x = jax.jit(_drawn_inputs)(data, key)
    return data.replace(mean=x.mean(0), std=jnp.maximum(x.std(0), STD_FLOOR))


def _drawn_inputs(data: Dataset, key: jax.Array) -> jax.Array:
    sample_key, goal_key = jax.random.split(key)
    sample = draw_samples(data, sample_key, MEASURED)
    (s, o), goal = data.at(sample, sample.n), draw_goals(data, goal_key, sample.n, Goals(), 0.99)
    return inputs(s, data.at(sample, goal)[1] - o)


def longest_way(data: Dataset) -> jax.Array:
    """The largest distance from a state to the end of its trajectory, metres."""
    return jnp.linalg.norm(data.o[0, data.end[data.starts]] - data.o[0, data.starts], axis=-1).max()
