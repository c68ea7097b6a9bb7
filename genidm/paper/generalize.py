"""𝒢 (Def. 4): the record's own actions, replayed from a turned start, and the Pairs they give.

Replayed physics is chaotic: rounding takes an Ant's way off the exactly turned one after some
tens of steps (docs/physics.md). So 𝒢 replays *segments*: every H steps the robot is placed on
the record again, turned by a new yaw; H is what the engine's rounding allows. Def. 4 allows
any trajectory τ ⊆ E.
Whole episodes (§5.2 to the letter) and exact rotation without physics are modes too.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from genidm import symmetry
from genidm.checks import check, count, optional
from genidm.engines import Engine
from genidm.errors import BadInput
from genidm.experience import Experience
from genidm.paper.pairs import Pairs, pairs
from genidm.paper.replaying import Blocks, RotatedReplay, Runner
from genidm.progress import Progress
from genidm.robots.base import Robot

Mode = Literal["segments", "episodes", "rotate"]


@dataclasses.dataclass(frozen=True)
class Generalize:
    """Settings of 𝒢.

    Attributes:
      mode: "segments" places the robot on the record again every `segment` steps;
        "episodes" replays whole episodes (the paper's §5.2); "rotate" turns the record
        exactly, without physics.
      segment: steps of a segment, H; as many as the robot's engine allows, unless given.
      copies: turned copies of the record.
      num_envs: robots replayed at once; see `Robot.max_parallel_envs`.
    """

    mode: Mode = "segments"
    segment: int | None = None
    copies: int = 1
    num_envs: int = 512

    def __post_init__(self) -> None:
        check(self, segment=optional(count()), copies=count(1, 1000), num_envs=count())

    def on(self, robot: Robot) -> Generalize:
        """The settings with a segment's length chosen for the robot, unless it is given."""
        if self.segment is not None:
            return self
        engine = robot.engine or Engine
        return dataclasses.replace(self, segment=engine.segment)


def replay(
    robot: Robot,
    experience: Experience,
    key: jax.Array,
    settings: Generalize | None = None,
    *,
    mesh: Mesh | None = None,
    quiet: bool = False,
) -> RotatedReplay:
    """𝒢(E): the record's actions replayed from starts turned by random yaws.

    Args:
      robot: the robot that the record is of.
      experience: E, `[T, B, ...]`.
      key: of the yaws.
      settings: mode, segment length and number of copies.
      mesh: devices to share the lanes among; as the robot's engine wants, unless given.
      quiet: no progress bar.

    Raises:
      BadInput: the record is unusable, or holds no physics and the mode needs it.
    """
    settings = (settings or Generalize()).on(robot)
    if settings.mode == "rotate":
        return rotate_exactly(robot, experience, key, settings.copies)
    experience = experience.prepared(robot)
    if experience.physics is None:
        raise BadInput('this experience holds no physics to replay from: use mode "rotate"')
    mesh = mesh or robot.mesh()
    assert settings.segment
    follow = settings.mode == "episodes"
    lanes = robot.max_parallel_envs(settings.num_envs)
    blocks = Blocks(experience, settings.segment, lanes, mesh.size, follow=follow)
    runner = Runner(robot, mesh, blocks.example(key))
    copies = []
    with Progress("generalize", settings.copies * blocks.total, "steps", quiet=quiet) as bar:
        for copy_key in jax.random.split(key, settings.copies):
            copies.append(blocks.gather(runner.over(blocks, copy_key, bar)))
    s, o, o_next, yaw, valid = (np.stack(x) for x in zip(*copies, strict=True))
    return RotatedReplay(s, o, o_next, yaw, blocks.start, valid)


def rotate_exactly(
    robot: Robot, experience: Experience, key: jax.Array, copies: int = 1
) -> RotatedReplay:
    """The record turned exactly, each sample by a yaw of its own, without physics."""
    experience = experience.prepared(robot)
    shape = (copies, *experience.first.shape)
    yaw = jax.random.uniform(key, shape, jnp.float32, minval=-jnp.pi, maxval=jnp.pi)
    rotated = jax.vmap(symmetry.rotate_vector, (None, 0))
    return RotatedReplay(
        s=jax.vmap(robot.observation.rotate, (None, 0))(jnp.asarray(experience.s), yaw),
        o=rotated(jnp.asarray(experience.o), yaw),
        o_next=rotated(jnp.asarray(experience.o_next), yaw),
        yaw=yaw,
        start=jnp.broadcast_to(jnp.arange(shape[1])[:, None], shape[1:]),
        valid=jnp.broadcast_to(jnp.asarray(experience.valid), shape),
    )


def residual(
    experience: Experience, turned: RotatedReplay, steps: int = 200
) -> dict[str, np.ndarray]:
    """How far the replay leaves the exact rotation of the record (e.m.o., Def. 3).

    Args:
      experience: the record.
      turned: its replay.
      steps: greatest number of steps since placing to report.

    Returns:
      "step" `[n]`, and "median", "p90" `[n]`: metres between o_next replayed and the
      record's own turned, over all samples that many steps after a placing.
    """
    record = experience.centred() if experience.far_away else experience
    o_next = jnp.asarray(record.o_next, jnp.float32)
    exact = jax.vmap(symmetry.rotate_vector, (None, 0))(o_next, turned.yaw)
    distance = np.linalg.norm(np.asarray(exact) - turned.o_next, axis=-1)
    since = np.arange(distance.shape[1])[:, None] - turned.start
    rows = []
    for n in range(min(steps, int(since.max()) + 1)):
        there = np.broadcast_to(since == n, distance.shape) & turned.valid
        if there.any():
            rows.append((n + 1, *np.quantile(distance[there], [0.5, 0.9])))
    step, median, p90 = np.asarray(rows, np.float64).reshape(-1, 3).T
    return {"step": step, "median": median, "p90": p90}


def generalize(
    robot: Robot,
    experience: Experience,
    key: jax.Array,
    settings: Generalize | None = None,
    *,
    goal_horizon: int = 100,
    mirror: bool = False,
) -> tuple[Pairs, dict[str, np.ndarray]]:
    """𝒢 from record to Pairs, and the e.m.o. residual; `replay` and `pairs` in one.

    Args:
      robot: the robot that the record is of.
      experience: E, `[T, B, ...]`.
      key: of the yaws.
      settings: of 𝒢.
      goal_horizon: h, steps to the intermediate goal o'.
      mirror: adds the reflection of every sample; not in the paper.

    Returns:
      the samples, and the residual as `residual` gives it, in metres.
    """
    turned = replay(robot, experience, key, settings)
    samples = pairs(robot, experience, turned, goal_horizon=goal_horizon, mirror=mirror)
    return samples, residual(experience, turned)
