"""Rows of 𝒢: replaying the record, with and without the transfer to the devices and back."""

from __future__ import annotations

import functools

import jax

from experiments.benchmark.bench import Bench, counted
from experiments.benchmark.collecting import record, segment
from experiments.benchmark.measuring import Probe, carried, timed
from genidm.paper.replaying import Blocks, Runner
from genidm.progress import Progress


def generalizing(bench: Bench, *, program_alone: bool = False) -> Probe:
    """`replay`: sends blocks to the devices, replays them, and brings them back.

    Args:
      bench: sizes.
      program_alone: measure without the transfers.
    """
    lanes = bench.robot.max_parallel_envs(bench.options.wide)
    blocks = Blocks(bench.once(record), segment(bench), lanes, bench.mesh.size)
    key = jax.random.key(0)
    keys, block = blocks.example(key)
    runner = Runner(bench.robot, bench.mesh, (keys, block))
    note = counted(blocks.width, "lane")
    if program_alone:
        there = runner.put(block)
        call = carried(lambda cursor: runner.program(cursor, there)[0], runner.start(keys, block))
        return Probe(timed(call, blocks.length * blocks.width), note)
    bar = Progress("generalize", 0, "steps", quiet=True)
    replay = functools.partial(runner.over, blocks, key, bar)
    return Probe(timed(lambda: blocks.gather(replay()), blocks.total), note)
