"""Generalized experience 𝒢(E) (Def. 4): recorded actions, replayed from rotated starts.

Replayed physics is chaotic: after some tens of steps, rounding moves a replayed Ant away from
the exactly rotated record (docs/physics.md). So 𝒢 replays *segments*: every H steps it places
the robot on the record again, rotated by a new yaw. The engine's rounding limits H. Def. 4
allows any trajectory τ ⊆ E. The other modes replay whole episodes (§5.2 to the letter), or
rotate the record exactly, without physics.
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
        "episodes" replays whole episodes (§5.2); "rotate" rotates the record exactly,
        without physics.
      segment: H, steps per segment; None takes the number of the robot's engine.
      copies: number of rotated copies of the record.
      num_envs: robots to replay at once; see `Robot.max_parallel_envs`.
    """

    mode: Mode = "segments"
    segment: int | None = None
    copies: int = 1
    num_envs: int = 512

    def __post_init__(self) -> None:
        check(self, segment=optional(count()), copies=count(1, 1000), num_envs=count())

    def on(self, robot: Robot) -> Generalize:
        """Fill in the segment length of the robot's engine where `segment` is None."""
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
    """Replay the record's actions from starts rotated by random yaws: 𝒢(E) (Def. 4).

    Args:
      robot: robot of the record.
      experience: E, `[T, B, ...]`.
      key: random key of the yaws.
      settings: mode, segment length and number of copies.
      mesh: devices that share the lanes; None takes those of the robot's engine.
      quiet: do not show a progress bar.

    Raises:
      BadInput: the record is invalid, or it holds no physics and the mode needs physics.
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
    """Rotate the record exactly, each sample by its own random yaw, without physics (Def. 3)."""
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
    """Measure the distance between the replay and the exactly rotated record (Def. 3).

    Args:
      experience: the record.
      turned: the rotated replay of the record.
      steps: largest number of steps after a placement to report.

    Returns:
      "step" `[n]`, steps after a placement; "median" and "p90" `[n]`, metres between the
      replayed o_next and the rotated o_next of the record, over all samples at that step.
    """
    record = experience.centred() if experience.far_away else experience
    o_next = jnp.asarray(record.o_next, jnp.float32)
    exact = jax.vmap(symmetry.rotate_vector, (None, 0))(o_next, turned.yaw)
    distance = np.linalg.norm(np.asarray(exact) - turned.o_next, axis=-1)
    since = np.arange(distance.shape[1])[:, None] - turned.start
    rows = []
    for n in range(min(steps, int(since.max()) + 1)):
        at_step = np.broadcast_to(since == n, distance.shape) & turned.valid
        if at_step.any():
            rows.append((n + 1, *np.quantile(distance[at_step], [0.5, 0.9])))
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
    """Make Pairs from a record by 𝒢 (Def. 4), and measure their residual.

    Calls `replay`, `pairs` and `residual`.

    Args:
      robot: robot of the record.
      experience: E, `[T, B, ...]`.
      key: random key of the yaws.
      settings: settings of 𝒢.
      goal_horizon: h, steps to the intermediate goal o'.
      mirror: add the reflection of every sample; not in the paper.

    Returns:
      the samples, and the result of `residual`, in metres.
    """
    turned = replay(robot, experience, key, settings)
    samples = pairs(robot, experience, turned, goal_horizon=goal_horizon, mirror=mirror)
    return samples, residual(experience, turned)
