"""Collection (§4.1): an agent learns one task, and all its experience is recorded."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from genidm import checks, devices, trees
from genidm.agents.base import Agent, Learning
from genidm.agents.buffer import Buffer
from genidm.agents.remembering import Remembering
from genidm.checks import check_value, count
from genidm.errors import BadInput
from genidm.experience import Experience, concatenate, load
from genidm.progress import Progress
from genidm.robots.base import Robot
from genidm.store import Stage
from genidm.tasks import EnvState, Task, WalkForward

# Transitions per chunk on disk.
CHUNK = 1 << 17
# Maximum transitions per iteration: for the Ant these take 2 GB before any learning.
MOST_AT_ONCE = 1 << 22


def collect(
    robot: Robot,
    agent: Agent,
    interactions: int,
    seed: int = 0,
    *,
    task: Task | None = None,
    mesh: Mesh | None = None,
    stage: Stage | None = None,
    keep: bool = True,
    quiet: bool = False,
) -> tuple[Any, Any]:
    """Train an agent for a number of interactions, and record all of them.

    The training steps themselves are recorded, so a record needs no extra interactions.

    Args:
      robot: the robot.
      agent: the settings of the agent.
      interactions: environment steps over all lanes; rounded up to whole iterations.
      seed: random seed.
      task: reward and end of an episode; default: `WalkForward()`.
      mesh: devices that share the lanes; their number must divide `num_envs`. Default: as many
        devices of the robot's engine as possible.
      stage: directory for the record, checkpoints and metrics; default: memory only.
      keep: whether to keep the record; if False, only the learner is kept.
      quiet: show no progress bar.

    Returns:
      the Experience `[T, num_envs, ...]` (None if `keep` is False), and the final learner.

    Raises:
      BadInput: a setting is out of range, or a learned parameter is not finite; the
        parameters are then not saved.
    """
    mesh = mesh or devices.dividing(robot.mesh(), agent.num_envs)
    _check(agent, interactions, seed, mesh)
    learning = agent.learning(robot, task or WalkForward(), mesh)
    learner = learning.place(jax.jit(learning.start)(jax.random.key(seed)))
    size = agent.num_envs * agent.unroll_length
    iterations = whole(agent, interactions) // size
    log = _Log(robot, stage, max(1, CHUNK // size), keep)
    done, learner = log.resume(learner, learning)
    if done == iterations:
        return log.experience(), learner
    iterate = learning.prepare(learner)
    directory = stage.directory if stage else None
    with Progress("collect", iterations * size, "steps", directory, done * size, quiet) as bar:
        for i in range(done, iterations):
            learner, part, metrics = iterate(learner)
            log.add(part)
            bar.advance(size, **{name: np.mean(x) for name, x in metrics.items()})
            if log.full or i + 1 == iterations:
                _check_learned(learner, (i + 1) * size)
                log.flush(i + 1, learner)
    return log.experience(), learner


def whole(agent: Agent, interactions: int) -> int:
    """Number of interactions that `collect` makes: rounded up to whole iterations."""
    size = agent.num_envs * agent.unroll_length
    return -(-interactions // size) * size


def _check(agent: Agent, interactions: int, seed: int, mesh: Mesh) -> None:
    check_value("interactions", interactions, count())
    check_value("seed", seed, checks.seed())
    check_value(
        "num_envs × unroll_length", agent.num_envs * agent.unroll_length, count(1, MOST_AT_ONCE)
    )
    if agent.num_envs % mesh.size:
        raise BadInput(f"{agent.num_envs} lanes cannot be shared among {mesh.size} devices evenly")


def _check_learned(learner: Any, interactions: int) -> None:
    """Raise BadInput if a parameter, or another learned array, is not finite."""
    # Robot states and buffers stay finite: a step that diverges repeats the state before it.
    not_learned = EnvState | Buffer
    learned = jax.tree.map(
        lambda x: None if isinstance(x, not_learned) else x,
        learner,
        is_leaf=lambda x: isinstance(x, not_learned),
    )
    if name := trees.not_finite(learned):
        raise BadInput(
            f"{name} holds NaN or infinity after {interactions} interactions: the policy cannot "
            "be used. A smaller learning rate may help"
        )


class _Log:
    """The record and the checkpoints of a collection.

    The newest parts stay on the devices until a chunk is full. Then the chunk moves to the
    host and, with a stage, to disk. Without `keep` there is no record, only checkpoints.
    """

    def __init__(self, robot: Robot, stage: Stage | None, chunk: int, keep: bool):
        self.robot, self.stage, self.chunk, self.keep = robot, stage, chunk, keep
        self.waiting = 0
        self.parts: list[Experience] = []
        self.chunks: list[Experience] = []
        self.checkpoints = Remembering(stage.checkpoints()) if stage else None

    @property
    def full(self) -> bool:
        return self.waiting >= self.chunk

    def add(self, part: Experience) -> None:
        self.waiting += 1
        if self.keep:
            self.parts.append(part)

    def flush(self, iteration: int, learner: Any) -> None:
        """Move the parts to the host; with a stage, also write them and a checkpoint to disk."""
        self.waiting = 0
        if self.keep:
            self.chunks.append(concatenate(self.parts))
            self.parts = []
            if self.stage:
                path = self.stage.path(self._name(len(self.chunks) - 1))
                self.chunks[-1].save(path, overwrite=True)
        if self.checkpoints:
            self.checkpoints.save(iteration, {"learner": learner, "chunks": len(self.chunks)})

    def resume(self, learner: Any, learning: Learning) -> tuple[int, Any]:
        """Number of completed iterations, and the learner after them."""
        like = {"learner": learner, "chunks": 0}
        found = self.checkpoints and self.checkpoints.latest(like)
        if not self.stage or not found:
            return 0, learner
        iteration, tree = found
        names = map(self._name, range(tree["chunks"]))
        self.chunks = [self.stage.read(load, name, self.robot) for name in names]
        return iteration, learning.place(tree["learner"])

    @staticmethod
    def _name(chunk: int) -> str:
        return f"experience/chunk_{chunk:05d}"

    def experience(self) -> Experience | None:
        return concatenate(self.chunks) if self.keep else None
