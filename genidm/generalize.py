"""𝒢 (Def. 4): the record's own actions, replayed from a turned start, and the Pairs they give.

Replayed physics is chaotic: in float32 an Ant's way leaves the exactly turned one after
some tens of steps (docs/physics.md). So 𝒢 replays *segments*: every H steps the robot is
placed on the record again, turned by a new yaw. Def. 4 allows any trajectory τ ⊆ E.
Whole episodes (§5.2 to the letter) and exact rotation without physics are modes too.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from genidm import devices, files, symmetry
from genidm.errors import BadInput
from genidm.experience import Experience, goal_step
from genidm.progress import Progress, compiled
from genidm.robots.base import Robot, State, select

Mode = Literal["segments", "episodes", "rotate"]

# Share of a record that is too little to be learned from without a word.
FEW = 0.25
# How d transforms is declared as everything else is.
DIRECTION = symmetry.vector("direction", unit="1")


@dataclasses.dataclass(frozen=True)
class Generalize:
    """Settings of 𝒢.

    Attributes:
      mode: "segments" places the robot on the record again every `segment` steps;
        "episodes" replays whole episodes (the paper's §5.2); "rotate" turns the record
        exactly, without physics.
      segment: steps of a segment, H.
      copies: turned copies of the record.
      lanes: robots replayed at once; an accelerator takes more.
    """

    mode: Mode = "segments"
    segment: int = 20
    copies: int = 1
    lanes: int = 512

    def __post_init__(self) -> None:
        if self.segment < 1 or self.copies < 1 or self.lanes < 1:
            raise BadInput("𝒢 needs segment, copies and lanes of at least 1")


class Replay(flax.struct.PyTreeNode):
    """What 𝒢 saw: C turned copies of a record of T steps of B lanes.

    Attributes:
      s: ŝ `[C, T, B, S]`.
      o: ô `[C, T, B, 3]`.
      o_next: `[C, T, B, 3]`, replayed position after the step.
      yaw: `[C, T, B]`, radians, by which the step is turned.
      start: `[T, B]` int32, the step at which the robot was last placed.
      valid: `[C, T, B]` bool, False once the physics diverged.
    """

    s: Any
    o: Any
    o_next: Any
    yaw: Any
    start: Any
    valid: Any

    def save(self, path: Path) -> None:
        """Writes the replay as a directory of arrays, without pickle."""
        tree = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        files.save_arrays(path, tree, {}, overwrite=True)

    @classmethod
    def load(cls, path: Path) -> Replay:
        """A replay that `save` wrote; raises BadInput if it is torn."""
        return cls(**files.load_arrays(path)[0])


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


class Cursor(flax.struct.PyTreeNode):
    """Robots in the middle of a replay, and the yaw that each is turned by."""

    robots: State
    yaw: jax.Array
    valid: jax.Array
    keys: jax.Array


def replay(
    robot: Robot,
    experience: Experience,
    key: jax.Array,
    settings: Generalize | None = None,
    *,
    mesh: Mesh | None = None,
    quiet: bool = False,
) -> Replay:
    """𝒢(E): the record's actions replayed from starts turned by random yaws.

    Args:
      robot: the robot that the record is of.
      experience: E, `[T, B, ...]`.
      key: of the yaws.
      settings: mode, segment length and number of copies.
      mesh: devices to share the lanes among; all, unless given.
      quiet: no progress bar.

    Raises:
      BadInput: the record is unusable, or holds no physics and the mode needs it.
    """
    settings = settings or Generalize()
    experience.check(robot)
    if settings.mode == "rotate":
        return rotate(robot, experience, key, settings.copies)
    if experience.physics is None:
        raise BadInput('this experience holds no physics to replay from: use mode "rotate"')
    mesh = mesh or devices.mesh()
    blocks = Blocks(experience, settings, mesh.size)
    runner = Runner(robot, mesh, blocks.example(key))
    copies = []
    with Progress("generalize", settings.copies * blocks.total, "steps", quiet=quiet) as bar:
        for copy_key in jax.random.split(key, settings.copies):
            copies.append(blocks.gather(runner.over(blocks, copy_key, bar)))
    s, o, o_next, yaw, valid = (np.stack(x) for x in zip(*copies, strict=True))
    return Replay(s, o, o_next, yaw, _last_placed(blocks.placed), valid)


def rotate(robot: Robot, experience: Experience, key: jax.Array, copies: int = 1) -> Replay:
    """The record turned exactly, each sample by a yaw of its own, without physics."""
    shape = (copies, *experience.first.shape)
    yaw = jax.random.uniform(key, shape, minval=-jnp.pi, maxval=jnp.pi)
    turn = jax.vmap(symmetry.turn_vector, (None, 0))
    return Replay(
        s=jax.vmap(robot.observation.turn, (None, 0))(jnp.asarray(experience.s), yaw),
        o=turn(jnp.asarray(experience.o), yaw),
        o_next=turn(jnp.asarray(experience.o_next), yaw),
        yaw=yaw,
        start=jnp.broadcast_to(jnp.arange(shape[1])[:, None], shape[1:]),
        valid=jnp.broadcast_to(jnp.asarray(experience.valid), shape),
    )


def _placements(first: np.ndarray, settings: Generalize) -> np.ndarray:
    """Where `[T, B]` the robot is placed on the record."""
    time = np.arange(first.shape[0])[:, None]
    every = settings.segment if settings.mode == "segments" else first.shape[0]
    return first | (time % every == 0)


def _last_placed(placed: np.ndarray) -> np.ndarray:
    """For each step `[T, B]` the step of the last placement."""
    time = np.arange(placed.shape[0], dtype=np.int32)[:, None]
    return np.maximum.accumulate(np.where(placed, time, 0), axis=0)


Block = dict[str, Any]


class Blocks:
    """A record cut into blocks `[H, lanes]` of equal size, and put together again.

    In mode "segments" each column of a block is a segment, and blocks are independent.
    In mode "episodes" the columns are the record's lanes, and blocks follow one another.
    Iterating gives the blocks, trees of arrays on the host.

    Args:
      experience: E, `[T, B, ...]`, with its physics.
      settings: mode, segment length and lanes.
      among: devices that share a block's lanes evenly.

    Attributes:
      placed: `[T, B]` bool, where the robot is placed on the record.
      length: steps of a block, H.
      width: lanes of a block.
      follow: whether blocks follow one another.
    """

    def __init__(self, experience: Experience, settings: Generalize, among: int):
        self.placed = _placements(np.asarray(experience.first), settings)
        steps, lanes = self.placed.shape
        self.length = settings.segment
        self.shape = (-(-steps // self.length), lanes)
        self.steps = steps
        self.follow = settings.mode == "episodes"
        count = self.shape[0] * lanes
        width = lanes if self.follow else min(devices.at_once(settings.lanes), count)
        self.width = -(-width // among) * among
        source = dict(
            physics=experience.physics, s=experience.s, a=experience.a,
            placed=self.placed, valid=experience.valid,
        )  # fmt: skip
        self.columns = jax.tree.map(lambda x: self._cut(np.asarray(x)), source)

    def _cut(self, x: np.ndarray) -> np.ndarray:
        """`[T, B, ...]` → `[H, blocks in time × B, ...]`, the last block padded."""
        pad = self.shape[0] * self.length - self.steps
        x = np.concatenate([x, x[-1:].repeat(pad, axis=0)]) if pad else x
        x = x.reshape(self.shape[0], self.length, *x.shape[1:]).swapaxes(0, 1)
        return x.reshape(self.length, -1, *x.shape[3:])

    def __iter__(self) -> Iterator[Block]:
        step = self.shape[1] if self.follow else self.width
        for begin in range(0, self.shape[0] * self.shape[1], step):
            yield jax.tree.map(functools.partial(self._pad, begin, begin + step), self.columns)

    def _pad(self, begin: int, end: int, columns: np.ndarray) -> np.ndarray:
        x = columns[:, begin:end]
        short = self.width - x.shape[1]
        return np.concatenate([x, x[:, -1:].repeat(short, axis=1)], axis=1) if short else x

    @property
    def total(self) -> int:
        """Steps in all blocks, the padding counted."""
        step = self.shape[1] if self.follow else self.width
        return -(-self.shape[0] * self.shape[1] // step) * self.length * self.width

    def example(self, key: jax.Array) -> tuple[jax.Array, Block]:
        """Arguments of the first call, to compile for."""
        return jax.random.split(key, self.width), next(iter(self))

    def gather(self, outputs: list[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
        """Outputs of all blocks as arrays `[T, B, ...]`."""
        step = self.shape[1] if self.follow else self.width

        def join(*parts: np.ndarray) -> np.ndarray:
            x = np.concatenate([p[:, :step] for p in parts], axis=1)
            x = x[:, : self.shape[0] * self.shape[1]]
            x = x.reshape(self.length, *self.shape, *x.shape[2:]).swapaxes(0, 1)
            return x.reshape(-1, *x.shape[2:])[: self.steps]

        return [join(*parts) for parts in zip(*outputs, strict=True)]


class Runner:
    """The compiled replay of one block, its lanes sharded over the mesh.

    Args:
      robot: whose record is replayed.
      mesh: devices that share the lanes.
      example: keys and a block of the shapes to compile for (`Blocks.example`).

    Attributes:
      program: the compiled (cursor, block on the devices) → (cursor, outputs on the
        devices): s, o, o', yaw and valid, `[H, lanes, ...]`.
    """

    def __init__(self, robot: Robot, mesh: Mesh, example: tuple[jax.Array, Block]):
        self.robot, self.mesh = robot, mesh
        keys, block = example
        cursor = self.start(keys, block)
        sharded = devices.over_lanes(self._replay, mesh, [0, 1], (0, 1))
        self.program = compiled("generalize", jax.jit(sharded), cursor, self.put(block))

    def put(self, block: Block) -> Block:
        """A block on the devices."""
        return devices.put(block, self.mesh, axis=1)

    def start(self, keys: jax.Array, block: Block) -> Cursor:
        """A cursor for a block, with keys `[lanes]`; its robots are placed before they step."""
        yaw = jnp.zeros(keys.shape)
        first = jax.tree.map(lambda x: x[0], block["physics"])
        shapes = jax.eval_shape(self.robot.place, first, yaw)
        robots = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return devices.put(Cursor(robots, yaw, yaw == 0, keys), self.mesh)

    def over(self, blocks: Blocks, key: jax.Array, bar: Progress) -> list[tuple[np.ndarray, ...]]:
        """Outputs of all blocks, on the host; where blocks follow one another, robots go on."""
        outputs: list[tuple[np.ndarray, ...]] = []
        cursor = None
        for i, block in enumerate(blocks):
            if cursor is None or not blocks.follow:
                # A column's key is its own, however wide the blocks are.
                columns = i * blocks.width + np.arange(blocks.width)
                keys = jax.vmap(jax.random.fold_in, (None, 0))(key, columns)
                cursor = self.start(keys, block)
            cursor, out = self.program(cursor, self.put(block))
            outputs.append(jax.tree.map(np.asarray, out))
            bar.advance(blocks.length * blocks.width)
        return outputs

    def _replay(self, cursor: Cursor, block: Block) -> tuple[Cursor, tuple[jax.Array, ...]]:
        return jax.lax.scan(self._step, cursor, block)

    def _step(self, cursor: Cursor, row: Block) -> tuple[Cursor, tuple[jax.Array, ...]]:
        """One step of B lanes: placed on the record where it says so, then replayed."""
        placed = row["placed"]
        keys, yaw = _draw_yaw(cursor.keys)
        yaw = jnp.where(placed, yaw, cursor.yaw)
        on_record = self.robot.place(row["physics"], yaw)
        # The record knows readings that `place` cannot (contact): turned, they are exact.
        on_record = on_record.replace(observation=self.robot.observation.turn(row["s"], yaw))
        before = select(placed, on_record, cursor.robots)
        after = self.robot.step(before, row["a"])
        valid = (placed | cursor.valid) & row["valid"] & ~after.diverged
        out = (before.observation, before.position, after.position, yaw, valid)
        return Cursor(after, yaw, valid, keys), out


def _draw_yaw(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    streams = jax.vmap(jax.random.split)(keys)
    draw: Callable[[jax.Array], jax.Array] = jax.vmap(
        lambda k: jax.random.uniform(k, minval=-jnp.pi, maxval=jnp.pi)
    )
    return streams[:, 0], draw(streams[:, 1])


def residual(experience: Experience, turned: Replay, steps: int = 200) -> dict[str, np.ndarray]:
    """How far the replay leaves the exact rotation of the record (e.m.o., Def. 3).

    Args:
      experience: the record.
      turned: its replay.
      steps: greatest number of steps since placing to report.

    Returns:
      "step" `[n]`, and "median", "p90" `[n]`: metres between o_next replayed and the
      record's own turned, over all samples that many steps after a placing.
    """
    exact = jax.vmap(symmetry.turn_vector, (None, 0))(experience.o_next, turned.yaw)
    distance = np.linalg.norm(np.asarray(exact) - turned.o_next, axis=-1)
    since = np.arange(distance.shape[1])[:, None] - turned.start
    rows = []
    for n in range(min(steps, int(since.max()) + 1)):
        there = np.broadcast_to(since == n, distance.shape) & turned.valid
        if there.any():
            rows.append((n + 1, *np.quantile(distance[there], [0.5, 0.9])))
    step, median, p90 = np.asarray(rows, np.float64).reshape(-1, 3).T
    return {"step": step, "median": median, "p90": p90}


def pairs(
    robot: Robot,
    experience: Experience,
    turned: Replay | None = None,
    *,
    look_ahead: int = 100,
    mirror: bool = False,
) -> Pairs:
    """Samples to fit from: the record, its turned copies, and their reflections.

    Args:
      robot: whose layouts say how s and a transform.
      experience: E, `[T, B, ...]`.
      turned: 𝒢(E), or None for the record alone.
      look_ahead: h, steps to the intermediate goal o'; 1 is the paper's reading. Steps
        whose episode ends before are left out. Where o' lies beyond what was replayed in
        one piece, it is the record's own, turned.
      mirror: adds the reflection y → −y of every sample, in every view.

    Raises:
      BadInput: look_ahead is below 1, or the record is unusable.
    """
    if look_ahead < 1:
        raise BadInput(f"look_ahead must be at least 1, not {look_ahead}")
    experience.check(robot)
    goal, exists = map(np.asarray, goal_step(jnp.asarray(experience.last), look_ahead))
    ahead = np.take_along_axis(np.asarray(experience.o_next), goal[..., None], axis=0)
    views = [(np.asarray(experience.s), ahead - np.asarray(experience.o))]
    valid = np.asarray(experience.valid) & exists
    for copy in _copies(turned):
        views.append((copy.s, _goal(copy, goal, ahead) - copy.o))
        valid = valid & copy.valid
    if 0 < valid.mean() < FEW:
        said = f"look_ahead {look_ahead} leaves {valid.sum()} of {valid.size} steps to learn from"
        warnings.warn(f"{said}: the episodes of the others end sooner", stacklevel=2)
    out = _samples(views, np.asarray(experience.a), valid)
    return with_reflection(robot, out) if mirror else out


def _copies(turned: Replay | None) -> Iterator[Replay]:
    """The copies of a replay one by one, arrays `[T, B, ...]` on the host."""
    if turned is not None:
        host = jax.tree.map(np.asarray, turned)
        start = np.broadcast_to(host.start, host.yaw.shape)
        for copy in range(host.yaw.shape[0]):
            yield jax.tree.map(lambda x, n=copy: x[n], host.replace(start=start))


def _goal(copy: Replay, goal: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """o' `[T, B, 3]` of a copy: replayed where that reaches, else the record's own, turned."""
    replayed = np.take_along_axis(copy.o_next, goal[..., None], axis=0)
    exact = np.asarray(symmetry.turn_vector(jnp.asarray(ahead), jnp.asarray(copy.yaw)))
    in_one_piece = np.take_along_axis(copy.start, goal, axis=0) == copy.start
    in_one_piece &= np.take_along_axis(copy.valid, goal, axis=0)
    return np.where(in_one_piece[..., None], replayed, exact)


def _samples(views: list[tuple[np.ndarray, np.ndarray]], a: np.ndarray, valid: np.ndarray) -> Pairs:
    """Pairs from views (s, o' − o) `[T, B, ...]`, without samples that have no direction."""
    length = np.stack([np.linalg.norm(way, axis=-1) for _, way in views])
    keep = valid & (length > 1e-6).all(axis=0)
    if not keep.any():
        raise BadInput("no sample can be learned from: are all episodes shorter than look_ahead?")
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


def generalize(
    robot: Robot,
    experience: Experience,
    key: jax.Array,
    settings: Generalize | None = None,
    *,
    look_ahead: int = 100,
    mirror: bool = False,
) -> tuple[Pairs, dict[str, np.ndarray]]:
    """𝒢 from record to Pairs, and the e.m.o. residual; `replay` and `pairs` in one."""
    turned = replay(robot, experience, key, settings)
    samples = pairs(robot, experience, turned, look_ahead=look_ahead, mirror=mirror)
    return samples, residual(experience, turned)
