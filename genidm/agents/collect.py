"""Collecting (§4.1): an agent learns one task, and all it sees is kept."""

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

# Transitions that are written to disk at a time.
CHUNK = 1 << 17
# Transitions of an iteration: so many of the Ant's take 2 GB before anything is learned from them.
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
    """Lets an agent learn for a number of interactions, and keeps every one of them.

    Recording costs no interaction: what the agent learned from is what is kept, in order.

    Args:
      robot: what walks.
      agent: what moves it, and learns.
      interactions: steps of one robot, counted over all lanes; rounded up to a whole
        iteration of the agent.
      seed: of everything random in here.
      task: what is rewarded; walking forward, unless given.
      mesh: devices to share the lanes among, evenly; of those that the robot's engine wants as
        many as can, unless given.
      stage: where the record, checkpoints and metrics go; they stay in memory, unless given.
      keep: keep the record; off, the learner is all that is left.
      quiet: no progress bar.

    Returns:
      the Experience `[T, lanes, ...]` (None unless kept), and the learner as it ended.

    Raises:
      BadInput: what the learner has learned is not finite; nothing of that is kept.
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
    """Interactions, rounded up to a whole iteration of the agent: what `collect` makes."""
    size = agent.num_envs * agent.unroll_length
    return -(-interactions // size) * size


def _check(agent: Agent, interactions: int, seed: int, mesh: Mesh) -> None:
    check_value("interactions", interactions, count())
    check_value("seed", seed, checks.seed())
    check_value(
        "lanes × unroll_length", agent.num_envs * agent.unroll_length, count(1, MOST_AT_ONCE)
    )
    if agent.num_envs % mesh.size:
        raise BadInput(f"{agent.num_envs} lanes cannot be shared among {mesh.size} devices evenly")


def _check_learned(learner: Any, interactions: int) -> None:
    """Refuses parameters, or what else is learned, that are not finite."""
    still = EnvState | Buffer  # robots, and what they did: NaN never gets there
    learned = jax.tree.map(
        lambda x: None if isinstance(x, still) else x,
        learner,
        is_leaf=lambda x: isinstance(x, still),
    )
    if name := trees.not_finite(learned):
        raise BadInput(
            f"{name} holds NaN or infinity after {interactions} interactions: what was learned is "
            "of no use. A smaller learning rate may help"
        )


class _Log:
    """The record so far: on the devices until a chunk is full, then on disk if there is a stage.

    Unless it is to be kept, only the checkpoints are.
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
        """Brings the parts to the host; with a stage, also to disk, and then a checkpoint."""
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
        """Iterations done, and the learner after them."""
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
