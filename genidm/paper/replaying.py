"""Physics of 𝒢 (Def. 4): cut a record into blocks, and replay their actions from rotated starts."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from genidm import devices, files
from genidm.experience import Experience
from genidm.progress import Progress, compile_ahead
from genidm.robots.base import Robot, State, select
from genidm.rollout import Move, rollout


class RotatedReplay(flax.struct.PyTreeNode):
    """𝒢(E): C rotated copies of a record of T steps and B lanes.

    Attributes:
      s: ŝ `[C, T, B, S]`, states.
      o: ô `[C, T, B, 3]`, positions before the step, metres.
      o_next: `[C, T, B, 3]`, replayed positions after the step, metres.
      yaw: `[C, T, B]`, radians, rotation of the step.
      start: `[T, B]` int32, step of the last placement on the record.
      valid: `[C, T, B]` bool, False from a divergence, or an invalid recorded step, to the
        next placement.
    """

    s: Any
    o: Any
    o_next: Any
    yaw: Any
    start: Any
    valid: Any

    def save(self, path: Path) -> None:
        """Write the replay as a directory of arrays, without pickle."""
        tree = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        files.save_arrays(path, tree, {}, overwrite=True)

    @classmethod
    def load(cls, path: Path) -> RotatedReplay:
        """Load a replay that `save` wrote; raises BadInput if it is corrupt."""
        return cls(**files.load_arrays(path)[0])


Block = dict[str, Any]


class Blocks:
    """A record, cut into blocks `[H, lanes]` of equal size.

    By default each column of a block is a segment, and blocks are independent. With `follow`,
    the columns are the record's lanes, and each block continues the block before it.
    Iterating gives the blocks, trees of arrays on the host.

    Args:
      experience: E, `[T, B, ...]`, with its physics.
      length: H, steps of a block.
      lanes: segments to replay at once.
      among: number of devices that share a block's lanes evenly.
      follow: replay whole episodes.

    Attributes:
      placed: `[T, B]` bool, where the robot is placed on the record.
      start: `[T, B]` int32, step of the last placement.
      length: H, steps of a block.
      width: lanes of a block.
      count: columns of all blocks together, without padding.
      stride: columns of a block without padding.
      follow: whether each block continues the block before it.
    """

    def __init__(
        self, experience: Experience, length: int, lanes: int, among: int, *, follow: bool = False
    ):
        first = np.asarray(experience.first)
        self.steps, recorded = first.shape
        length = min(length, self.steps)
        self.length, self.follow = length, follow
        time = np.arange(self.steps, dtype=np.int32)[:, None]
        self.placed = first | (time % (self.steps if follow else length) == 0)
        self.start = np.maximum.accumulate(np.where(self.placed, time, 0), axis=0)
        self.shape = (-(-self.steps // length), recorded)
        self.count = self.shape[0] * recorded
        width = recorded if follow else min(lanes, self.count)
        self.width = -(-width // among) * among
        self.stride = recorded if follow else self.width
        source = dict(
            physics=experience.physics, s=experience.s, a=experience.a,
            placed=self.placed, valid=experience.valid,
        )  # fmt: skip
        self.columns = jax.tree.map(lambda x: self._cut(np.asarray(x)), source)

    def _cut(self, x: np.ndarray) -> np.ndarray:
        """Reshape `[T, B, ...]` to `[H, blocks in time × B, ...]`, with the last block padded."""
        pad = self.shape[0] * self.length - self.steps
        x = np.concatenate([x, x[-1:].repeat(pad, axis=0)]) if pad else x
        x = x.reshape(self.shape[0], self.length, *x.shape[1:]).swapaxes(0, 1)
        return x.reshape(self.length, -1, *x.shape[3:])

    def __iter__(self) -> Iterator[Block]:
        for begin in range(0, self.count, self.stride):
            end = begin + self.stride
            yield jax.tree.map(functools.partial(self._pad, begin, end), self.columns)

    def _pad(self, begin: int, end: int, columns: np.ndarray) -> np.ndarray:
        x = columns[:, begin:end]
        missing = self.width - x.shape[1]
        return np.concatenate([x, x[:, -1:].repeat(missing, axis=1)], axis=1) if missing else x

    @property
    def total(self) -> int:
        """Steps in all blocks, with padding."""
        return -(-self.count // self.stride) * self.length * self.width

    def example(self, key: jax.Array) -> tuple[jax.Array, Block]:
        """Keys and the first block, whose shapes the program is compiled for."""
        return jax.random.split(key, self.width), next(iter(self))

    def gather(self, outputs: list[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
        """Join the outputs of all blocks to arrays `[T, B, ...]`."""

        def join(*parts: np.ndarray) -> np.ndarray:
            x = np.concatenate([p[:, : self.stride] for p in parts], axis=1)[:, : self.count]
            x = x.reshape(self.length, *self.shape, *x.shape[2:]).swapaxes(0, 1)
            return x.reshape(-1, *x.shape[2:])[: self.steps]

        return [join(*parts) for parts in zip(*outputs, strict=True)]


class Cursor(flax.struct.PyTreeNode):
    """State of a replay between two steps: the robots, and the yaw of each."""

    robots: State
    yaw: jax.Array
    valid: jax.Array
    keys: jax.Array


class Runner:
    """The compiled replay of one block, its lanes sharded over the mesh.

    Args:
      robot: robot of the record.
      mesh: devices that share the lanes.
      example: keys and a block with the shapes of the program (`Blocks.example`).

    Attributes:
      program: the compiled (cursor, block on the devices) → (cursor, outputs on the
        devices): s, o, o', yaw and valid, `[H, lanes, ...]`.
    """

    def __init__(self, robot: Robot, mesh: Mesh, example: tuple[jax.Array, Block]):
        self.robot, self.mesh = robot, mesh
        keys, block = example
        cursor = self.start(keys, block)
        sharded = devices.over_lanes(self._replay, mesh, [0, 1], (0, 1))
        self.program = compile_ahead("generalize", jax.jit(sharded), cursor, self.put(block))

    def put(self, block: Block) -> Block:
        """Copy a block to the devices."""
        return devices.put(block, self.mesh, axis=1)

    def start(self, keys: jax.Array, block: Block) -> Cursor:
        """Make a cursor for a block, with keys `[lanes]`; the first step places its robots."""
        yaw = jnp.zeros(keys.shape, jnp.float32)
        first = jax.tree.map(lambda x: x[0], block["physics"])
        shapes = jax.eval_shape(self.robot.set_state, first, yaw)
        robots = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return devices.put(Cursor(robots, yaw, yaw == 0, keys), self.mesh)

    def over(self, blocks: Blocks, key: jax.Array, bar: Progress) -> list[tuple[np.ndarray, ...]]:
        """Replay all blocks, and return their outputs on the host."""
        outputs: list[tuple[np.ndarray, ...]] = []
        cursor = None
        for i, block in enumerate(blocks):
            if cursor is None or not blocks.follow:
                # One key per column, so that the width of a block does not change the result.
                columns = i * blocks.width + np.arange(blocks.width)
                keys = jax.vmap(jax.random.fold_in, (None, 0))(key, columns)
                cursor = self.start(keys, block)
            cursor, out = self.program(cursor, self.put(block))
            outputs.append(jax.tree.map(np.asarray, out))
            bar.advance(blocks.length * blocks.width)
        return outputs

    def _replay(self, cursor: Cursor, block: Block) -> tuple[Cursor, tuple[jax.Array, ...]]:
        return rollout(self.robot, self._act, self._watch, cursor, block)

    def _act(self, cursor: Cursor, row: Block) -> tuple[State, jax.Array, tuple[Any, ...]]:
        """Place the robots on the record where `placed` is True; return them and the actions."""
        placed = row["placed"]
        keys, yaw = _draw_yaw(cursor.keys)
        yaw = jnp.where(placed, yaw, cursor.yaw)
        on_record = self.robot.set_state(row["physics"], yaw)
        # `set_state` cannot compute contact readings; those of the record, rotated, are exact.
        on_record = on_record.replace(observation=self.robot.observation.rotate(row["s"], yaw))
        usable = (placed | cursor.valid) & row["valid"]
        return select(placed, on_record, cursor.robots), row["a"], (keys, yaw, usable)

    def _watch(self, cursor: Cursor, move: Move) -> tuple[Cursor, tuple[jax.Array, ...]]:
        before, after, (keys, yaw, usable) = move.before, move.after, move.notes
        valid = usable & ~after.diverged
        out = (before.observation, before.position, after.position, yaw, valid)
        return Cursor(after, yaw, valid, keys), out


def _draw_yaw(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    streams = jax.vmap(jax.random.split)(keys)
    draw: Callable[[jax.Array], jax.Array] = jax.vmap(
        lambda k: jax.random.uniform(k, (), jnp.float32, minval=-jnp.pi, maxval=jnp.pi)
    )
    return streams[:, 0], draw(streams[:, 1])
