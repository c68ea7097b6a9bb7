"""The replay buffer against a list of episodes that forgets nothing."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from genidm.agents.buffer import (
    Buffer,
    Index,
    ReplayTransition,
    add,
    empty,
    gather,
    sample_index,
    steps_left,
)
from genidm.errors import BadInput

ROWS, LANES, UNROLL = 12, 5, 3
DRAWN = 20_000

jitted = {f: jax.jit(f) for f in (add, steps_left, gather)}
jitted[sample_index] = jax.jit(sample_index, static_argnums=2)


class Told(NamedTuple):
    """What happened in a lane in row n, and when its episode began."""

    n: int
    lane: int
    episode_step: int
    last: bool


def story(rows: int) -> list[list[Told]]:
    """Rows of lanes: short episodes, longer ones, and in lane 0 one that never ends."""
    rng, episode_step, told = np.random.default_rng(0), [0] * LANES, []
    for n in range(rows):
        lasts = [lane > 0 and rng.random() < 0.9 / (2 * lane) for lane in range(LANES)]
        told.append([Told(n, lane, episode_step[lane], last) for lane, last in enumerate(lasts)])
        episode_step = [0 if last else a + 1 for a, last in zip(episode_step, lasts, strict=True)]
    return told


def memory(told: list[list[Told]]) -> ReplayTransition:
    """Every number of a step says which it is."""

    def of(what: str) -> np.ndarray:
        return np.array([[getattr(t, what) for t in row] for row in told])

    number = np.float32(1 + of("n") * LANES + of("lane"))
    vector = number[..., None] + np.float32([0.0, 0.25, 0.5])
    last, episode_step = of("last"), of("episode_step").astype(np.int32)
    return ReplayTransition(
        s=vector[..., :2], o=vector, o_next=vector + 1000, a=vector[..., :1], goal=-vector,
        cost=number, fallen=last, reward=-number, absorbing_reward=number / 2, terminal=last,
        last=last, episode_step=episode_step,
    )  # fmt: skip


@functools.cache
def filled(parts: int) -> tuple[Buffer, list[list[Told]]]:
    """The buffer after so many parts, and the whole story so far."""
    told = story(parts * UNROLL)
    if parts == 0:
        part = jax.eval_shape(lambda: memory(story(UNROLL)))
        return empty(part, ROWS * LANES + UNROLL * LANES - 1), told
    buffer, _ = filled(parts - 1)
    return jitted[add](buffer, memory(told[-UNROLL:])), told


def kept(told: list[list[Told]]) -> list[list[Told]]:
    return told[-ROWS:]


# Not full, just full, and full again and again.
PARTS = (1, 2, 4, 5, 7, 8, 11, 12, 14)


@pytest.mark.parametrize("parts", PARTS)
def test_it_holds_the_newest_rows(parts: int) -> None:
    buffer, told = filled(parts)
    assert buffer.written == len(told) and buffer.filled == len(kept(told))
    assert buffer.rows.last.shape == (ROWS, LANES) and buffer.oldest == kept(told)[0][0].n % ROWS
    expected = memory(sorted(kept(told), key=lambda row: row[0].n % ROWS))
    there = jax.tree.map(lambda x: x[: buffer.filled], buffer.rows)
    jax.tree.map(np.testing.assert_array_equal, there, expected)


@pytest.mark.parametrize("parts", PARTS)
def test_steps_left_are_those_of_the_story(parts: int) -> None:
    buffer, told = filled(parts)
    left = np.asarray(jitted[steps_left](buffer))
    for row in kept(told):
        for t in row:
            following = [later[t.lane] for later in told[t.n :]]
            end = next((x.n for x in following if x.last), told[-1][0].n)
            assert left[t.n % ROWS, t.lane] == end - t.n
    if parts > 4:
        assert left[buffer.oldest, 0] == ROWS - 1  # an episode longer than the ring


@pytest.mark.parametrize("parts", PARTS)
def test_every_step_but_the_newest_is_drawn_as_often_as_any(parts: int) -> None:
    buffer, told = filled(parts)
    at = jitted[sample_index](buffer, jax.random.key(parts), DRAWN)
    counts = np.zeros((ROWS, LANES), int)
    np.add.at(counts, (np.asarray(at.row), np.asarray(at.lane)), 1)
    drawable = [row[0].n % ROWS for row in kept(told)[:-1]]
    expected = DRAWN / (len(drawable) * LANES)
    assert abs(counts[drawable] - expected).max() < 4.5 * np.sqrt(expected)
    assert counts[drawable].sum() == counts.sum() == DRAWN


@pytest.mark.parametrize("parts", PARTS)
def test_what_is_looked_up_is_the_step_and_the_state_after_it(parts: int) -> None:
    buffer, told = filled(parts)
    steps = [t for row in kept(told)[:-1] for t in row]
    at = Index(jnp.array([t.n % ROWS for t in steps]), jnp.array([t.lane for t in steps]))
    rows, s_next = jitted[gather](buffer, at)
    jax.tree.map(np.testing.assert_array_equal, rows, listed(steps))
    after = [told[t.n + 1][t.lane] for t in steps]
    np.testing.assert_array_equal(s_next, listed(after).s)
    goes_on = ~rows.last
    np.testing.assert_array_equal(
        listed(after).episode_step, jnp.where(goes_on, rows.episode_step + 1, 0)
    )


def listed(steps: list[Told]) -> ReplayTransition:
    return jax.tree.map(lambda x: x[:, 0], memory([[t] for t in steps]))


def test_the_story_has_what_these_tests_need() -> None:
    told = story(PARTS[-1] * UNROLL)
    assert not any(row[0].last for row in told) and len(told) > 3 * ROWS
    lengths = [t.episode_step + 1 for row in told for t in row if t.last]
    assert min(lengths) == 1 and max(lengths) > ROWS / 2


def test_a_buffer_is_made_of_whole_parts_and_no_fewer_than_two() -> None:
    part = jax.eval_shape(lambda: memory(story(UNROLL)))
    for max_replay_size in (2 * UNROLL * LANES, 3 * UNROLL * LANES - 1):
        assert empty(part, max_replay_size).rows.s.shape == (2 * UNROLL, LANES, 2)
    for max_replay_size in (2 * UNROLL * LANES - 1, 0, -5):
        with pytest.raises(BadInput, match="less than two"):
            empty(part, max_replay_size)
