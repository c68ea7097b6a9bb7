"""The newest state that is whole comes back, bit by bit."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from bits import flip, same, truncate
from brax.training.acme import running_statistics
from killing import Killed

from genidm import devices, files
from genidm.checkpoints import Checkpoints
from genidm.errors import BadInput


@flax.struct.dataclass
class Learner:
    params: dict
    optimiser: optax.OptState
    statistics: running_statistics.RunningStatisticsState
    keys: jax.Array
    step: int
    rate: float
    going: bool
    empty: jax.Array
    name: str = flax.struct.field(pytree_node=False)


def learner(scale: float = 1.0) -> Learner:
    params = {"dense/0": {"kernel": jnp.full((3, 2), scale), "bias": np.array([np.nan, -0.0])}}
    statistics = running_statistics.init_state(jnp.zeros(3))
    statistics = running_statistics.update(statistics, jnp.arange(6.0).reshape(2, 3) * scale)
    return Learner(
        params=params,
        optimiser=optax.adam(1e-3).init(params),
        statistics=statistics,
        keys=jax.random.split(jax.random.key(7, impl="rbg"), 4),
        step=2**40,
        rate=0.1,
        going=True,
        empty=jnp.zeros((0, 5)),
        name="ant",
    )


def test_a_learner_comes_back_bit_by_bit(tmp_path: Path) -> None:
    saved = learner()
    Checkpoints(tmp_path).save(5, saved)
    step, back = Checkpoints(tmp_path).latest(learner(0.0))
    assert step == 5
    same(back, saved)
    assert (type(back.step), back.step, back.rate, back.going) == (int, 2**40, 0.1, True)
    assert isinstance(back.params["dense/0"]["kernel"], np.ndarray)
    assert int(back.statistics.count) == 2
    draw = jax.vmap(jax.random.normal)
    np.testing.assert_array_equal(draw(back.keys), draw(saved.keys))


def test_saving_gives_the_log_back(tmp_path: Path, caplog) -> None:
    with caplog.at_level(logging.WARNING, "absl"):
        Checkpoints(tmp_path).save(5, {"a": 1})
        assert logging.getLogger("absl").level == logging.WARNING


def test_like_may_be_abstract(tmp_path: Path) -> None:
    saved = {"key": jax.random.key(1), "n": 3, "x": (np.ones((2, 3), np.int8), jnp.uint32(9))}
    Checkpoints(tmp_path).save(0, saved)
    _, back = Checkpoints(tmp_path).latest(jax.eval_shape(lambda: saved))
    same(back["key"], saved["key"])
    same(back["x"], saved["x"])
    assert back["n"] == 3 and back["n"].dtype == np.int32


def test_a_python_number_may_have_become_an_array(tmp_path: Path) -> None:
    Checkpoints(tmp_path).save(0, {"eps": jnp.float32(0.5), "n": jnp.int32(4)})
    assert Checkpoints(tmp_path).latest({"eps": 0.0, "n": 0}) == (0, {"eps": 0.5, "n": 4})


def test_sharded_arrays_and_keys_come_back(tmp_path: Path) -> None:
    if jax.device_count() < 2:
        pytest.skip("one device")
    count = 2 * jax.device_count()
    plain = {
        "x": np.arange(3 * count).reshape(count, 3),
        "k": jax.random.split(jax.random.key(0), count),
    }
    mesh = devices.mesh()
    sharded = devices.put(plain, mesh)
    assert len(sharded["x"].sharding.device_set) == jax.device_count()
    Checkpoints(tmp_path).save(1, sharded)
    _, back = Checkpoints(tmp_path).latest(sharded)
    same(devices.put(back, mesh), sharded)


def test_the_class_of_a_container_does_not_matter(tmp_path: Path) -> None:
    Checkpoints(tmp_path).save(1, optax.TraceState(trace={"w": np.ones(2)}))
    _, back = Checkpoints(tmp_path).latest({"trace": {"w": np.zeros(2)}})
    same(back, {"trace": {"w": np.ones(2)}})


@pytest.mark.parametrize(
    ("like", "difference"),
    [
        (
            {"a": np.ones((3, 4), np.float32)},
            r"a is float32\[2, 4\] in the checkpoint, float32\[3, 4\] in this run",
        ),
        (
            {"a": np.ones((2, 4), np.int32)},
            r"a is float32\[2, 4\] in the checkpoint, int32\[2, 4\] in this run",
        ),
        (
            {"b": np.ones((2, 4), np.float32)},
            r"a is float32\[2, 4\] in the checkpoint, absent in this run",
        ),
        (
            {"a": {"b": np.ones((2, 4), np.float32)}},
            r"a is float32\[2, 4\] in the checkpoint, absent in this run",
        ),
        (
            {"a": np.ones((2, 4), np.float32), "b": 1},
            r"b is absent in the checkpoint, int in this run",
        ),
    ],
)
def test_a_checkpoint_of_another_robot_is_refused(tmp_path: Path, like, difference: str) -> None:
    Checkpoints(tmp_path).save(1, {"a": np.ones((2, 4), np.float32)})
    with pytest.raises(BadInput, match="of another robot or setting: " + difference):
        Checkpoints(tmp_path).latest(like)


def test_only_the_newest_are_kept(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path / "c", keep=2)
    assert checkpoints.latest({"a": 0}) is None
    for step in (1, 20, 300, 1_000_000_000):
        checkpoints.save(step, {"a": step})
    assert checkpoints.steps() == [300, 1_000_000_000]
    assert checkpoints.latest({"a": 0}) == (1_000_000_000, {"a": 1_000_000_000})
    checkpoints.save(300, {"a": 301})  # a resume went back, and left the future
    assert checkpoints.steps() == [300]
    assert checkpoints.latest({"a": 0}) == (300, {"a": 301})


def files_of(directory: Path) -> list[str]:
    found = (p.relative_to(directory) for p in sorted(directory.rglob("*")) if p.is_file())
    return [str(p) for p in found]


def test_corrupt_checkpoints_give_way_to_the_one_before(tmp_path: Path, capfd) -> None:
    like = {"a": np.zeros(50)}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"a": np.full(50, 1.0)})
    checkpoints.save(2, {"a": np.full(50, 2.0)})
    newest = tmp_path / "step_000000002"
    names = files_of(newest)
    assert len(names) > 4
    for name in names:
        whole = (newest / name).read_bytes()
        for harm in (flip, truncate, Path.unlink):
            harm(newest / name)
            capfd.readouterr()
            step, tree = checkpoints.latest(like)
            assert (step, tree["a"][0]) == (1, 1.0)
            assert capfd.readouterr().err.count("warning: ") == 1
            (newest / name).write_bytes(whole)
    assert checkpoints.latest(like)[0] == 2
    for step in (1, 2):
        (tmp_path / f"step_{step:09d}" / "manifest.json").unlink()
    assert checkpoints.latest(like) is None


def test_two_leaves_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="same name"):
        Checkpoints(tmp_path).save(1, {"a": {"b": np.ones(1)}, "a/b": np.ones(1)})


def test_killed_at_any_moment_old_or_new_is_there(tmp_path: Path, monkeypatch) -> None:
    checkpoints, like = Checkpoints(tmp_path, keep=1), {"a": np.zeros(3), "n": 0}
    checkpoints.save(1, {"a": np.ones(3), "n": 1})
    moments = 0

    def dying(call, at: int):
        def replacement(*args, **kwargs):
            nonlocal moments
            moments += 1
            if moments == at:
                raise Killed
            if moments < at:  # the dead do not tidy up
                return call(*args, **kwargs)

        return replacement

    for at in range(1, 100):
        moments = 0
        with monkeypatch.context() as m:
            m.setattr(os, "fsync", dying(os.fsync, at))
            m.setattr(os, "replace", dying(os.replace, at))
            m.setattr(Path, "rename", dying(Path.rename, at))
            m.setattr(files, "delete", dying(files.delete, at))
            try:
                checkpoints.save(2, {"a": np.full(3, 2.0), "n": 2})
            except Killed:
                step, tree = checkpoints.latest(like)
                assert step == tree["n"] == tree["a"][0] and step in (1, 2)
            else:
                break
        if step == 2:  # and from the beginning again
            checkpoints.save(1, {"a": np.ones(3), "n": 1})
    assert at > 10 and checkpoints.steps() == [2]


LOOP = """
import sys, numpy as np
from genidm.checkpoints import Checkpoints
checkpoints = Checkpoints(sys.argv[1])
for step in range(10**6):
    checkpoints.save(step, {"a": np.full(100_000, step), "n": step})
    print(step, flush=True)
"""


def test_kill_9_leaves_a_readable_newest_checkpoint(tmp_path: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(Path(files.__file__).parents[1])}
    command = [sys.executable, "-c", LOOP, str(tmp_path)]
    checkpoints, like = Checkpoints(tmp_path), {"a": np.zeros(100_000, int), "n": 0}
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        for _ in range(4):
            said = int(process.stdout.readline())
        time.sleep(0.01)  # into the next save
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
    said = int(rest[-1]) if rest else said
    step, tree = checkpoints.latest(like)
    assert step in (said, said + 1)
    assert tree["n"] == step and (tree["a"] == step).all()
    checkpoints.save(step + 1, like)  # clears what the killed process left
    assert all(re.fullmatch(r"step_\d{9}", p.name) for p in tmp_path.iterdir())
