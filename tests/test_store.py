"""What is on the disk is whole, or is known not to be."""

from __future__ import annotations

import dataclasses
import enum
import errno
import json
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
from brax.training.acme import running_statistics

from genidm import devices, store
from genidm.errors import BadInput
from genidm.store import Checkpoints, Stage, Torn, load_arrays, save_arrays


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


@dataclasses.dataclass(frozen=True)
class Inner:
    rate: float = 1e-3
    colour: Colour = Colour.RED


@dataclasses.dataclass(frozen=True)
class Config:
    inner: Inner = Inner()
    sizes: tuple[int, ...] = (64, 64)
    path: Path = Path("a/b")
    nothing: None = None


@dataclasses.dataclass(frozen=True)
class Other:
    inner: Inner = Inner()
    sizes: tuple[int, ...] = (64, 64)
    path: Path = Path("a/b")
    nothing: None = None


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-2])


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def same(a: object, b: object) -> None:
    """Same structure, dtypes and bits."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if jnp.issubdtype(getattr(x, "dtype", None), jax.dtypes.prng_key):
            assert x.dtype == y.dtype
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        x, y = np.asarray(x), np.asarray(y)
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())


# --- configs ---------------------------------------------------------------------------


def test_plain_is_readable_json() -> None:
    plain = store.plain({"c": Config(), "f": jnp.tanh, "x": np.float32(0.5), "bad": np.inf})
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["c"]["class"].endswith("test_store.Config")
    assert plain["c"]["inner"]["colour"].endswith("Colour.RED")
    assert plain["c"]["path"] == "a/b"
    assert (plain["x"], plain["bad"]) == (0.5, "inf")


def test_digest_sees_every_difference_and_nothing_else() -> None:
    base = store.digest(Config())
    assert re.fullmatch("[0-9a-f]{10}", base)
    assert base == store.digest(Config(sizes=[64, np.int64(64)]))  # type: ignore[arg-type]
    changed = [
        Config(inner=Inner(rate=2e-3)),
        Config(inner=Inner(colour=Colour.BLUE)),
        Config(sizes=(64, 65)),
        Config(path=Path("a/c")),
        Other(),
    ]
    assert len({base, *map(store.digest, changed)}) == 1 + len(changed)
    assert store.digest({"a": 1, "b": 2}) == store.digest({"b": 2, "a": 1})
    assert store.digest(jnp.tanh) != store.digest(jnp.sin)
    # Names of directories must not change from one version to the next.
    assert store.digest({"a": (1, 2.5, None, True)}) == "115eaa7689"


def test_digest_refuses_what_it_cannot_tell_apart() -> None:
    with pytest.raises(BadInput, match="cannot stand in a config"):
        store.digest({"robot": object()})


def test_environment_names_versions_and_hardware() -> None:
    here = store.environment()
    assert here["versions"]["jax"] == jax.__version__
    assert f"{jax.device_count()} jax devices" in here["hardware"]
    assert here["commit"] is None or re.fullmatch("[0-9a-f]{40}", here["commit"])
    assert json.loads(json.dumps(here)) == here


# --- arrays ----------------------------------------------------------------------------

TREE = {
    "physics": {
        "qpos": np.arange(12.0, dtype=np.float32).reshape(3, 4).T,
        "empty": np.zeros((0, 2)),
    },
    "ends": np.array([True, False]),
    "count": np.uint64(2**63),
}


@pytest.mark.parametrize("mmap", [False, True])
def test_arrays_come_back_bit_by_bit(tmp_path: Path, mmap: bool) -> None:
    save_arrays(tmp_path / "x", TREE, {"seed": 3, "robot": "ant"})
    tree, meta = load_arrays(tmp_path / "x", mmap=mmap)
    same(tree, TREE)
    assert meta == {"seed": 3, "robot": "ant"}
    assert isinstance(tree["physics"]["qpos"], np.memmap) == mmap


NAMES = ["physics.qpos.npy", "meta.json", "manifest.json"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("harm", [flip, truncate, Path.unlink])
def test_torn_arrays_are_recognised_and_replaced(tmp_path: Path, name: str, harm) -> None:
    save_arrays(tmp_path / "x", TREE, {})
    harm(tmp_path / "x" / name)
    with pytest.raises(Torn, match=r"torn|missing"):
        load_arrays(tmp_path / "x")
    if name != "manifest.json" or harm is not Path.unlink:
        save_arrays(tmp_path / "x", TREE, {"again": True})
        assert load_arrays(tmp_path / "x")[1] == {"again": True}


def test_missing_arrays_are_torn(tmp_path: Path) -> None:
    with pytest.raises(Torn, match="missing"):
        load_arrays(tmp_path / "nowhere")


def test_complete_arrays_are_overwritten_only_when_told(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", TREE, 1)
    with pytest.raises(BadInput, match="not overwritten"):
        save_arrays(tmp_path / "x", TREE, 2)
    assert load_arrays(tmp_path / "x")[1] == 1
    save_arrays(tmp_path / "x", {"a": np.ones(1)}, 3, overwrite=True)
    assert load_arrays(tmp_path / "x")[1] == 3
    assert sorted(p.name for p in (tmp_path / "x").iterdir()) == ["a.npy", *sorted(NAMES[1:])]


def test_a_directory_of_something_else_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(BadInput, match="something else"):
        save_arrays(tmp_path, TREE, {}, overwrite=True)
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize(
    ("tree", "why"),
    [
        ({"x": np.array([{}], object)}, "pickle"),
        ({"x": jax.eval_shape(lambda: 0)}, "pickle"),
        ({"x": jax.random.key(0)}, "random keys"),
        ({"../x": np.ones(1)}, "cannot name"),
        ({"a.b": np.ones(1)}, "cannot name"),
    ],
)
def test_what_cannot_be_kept_is_refused(tmp_path: Path, tree: dict, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        save_arrays(tmp_path / "x", tree, {})
    assert not list(tmp_path.iterdir())


def test_pickle_is_not_loaded_even_with_a_true_manifest(tmp_path: Path) -> None:
    save_arrays(tmp_path / "x", {"a": np.ones(1)}, {})
    file = tmp_path / "x" / "a.npy"
    np.save(file, np.array([print], object), allow_pickle=True)
    manifest = store.load_json(tmp_path / "x" / "manifest.json")
    store.save_json(tmp_path / "x" / "manifest.json", {**manifest, "a.npy": store._measure(file)})
    for mmap in (False, True):
        with pytest.raises(BadInput, match="cannot be read"):
            load_arrays(tmp_path / "x", mmap=mmap)


# --- full disks ------------------------------------------------------------------------


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch) -> None:
    save_arrays(tmp_path / "x", TREE, 1)
    store.save_json(tmp_path / "y.json", 1)
    Checkpoints(tmp_path / "z").save(1, {"a": np.ones(3)})
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(os, "fsync", full_disk)
    for write in (
        lambda: save_arrays(tmp_path / "x", TREE, 2, overwrite=True),
        lambda: save_arrays(tmp_path / "new", TREE, 2),
        lambda: store.save_json(tmp_path / "y.json", 2),
        lambda: Checkpoints(tmp_path / "z").save(2, {"a": np.ones(3)}),
    ):
        with pytest.raises(BadInput, match="no space left on the disk that holds"):
            write()
    assert sorted(tmp_path.rglob("*")) == before
    assert load_arrays(tmp_path / "x")[1] == store.load_json(tmp_path / "y.json") == 1


@pytest.mark.parametrize(
    "error",
    [
        OSError("12000 requested and 512 written"),  # numpy
        ValueError("RESOURCE_EXHAUSTED: Failed to write to file 14: No space left on device"),
    ],
)
def test_a_full_disk_without_errno_is_recognised(tmp_path: Path, monkeypatch, error) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(np, "save", fail)
    monkeypatch.setattr(store, "_write", fail)
    with pytest.raises(BadInput, match="no space left"):
        save_arrays(tmp_path / "x", TREE, {})
    with pytest.raises(BadInput, match="no space left"):
        Checkpoints(tmp_path / "z").save(2, {"a": np.ones(3)})
    assert not [p for p in tmp_path.rglob("*") if p.name != "z"]


def test_a_place_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for write in (
        lambda: Stage.open(tmp_path / "file", "collect", {}),
        lambda: save_arrays(tmp_path / "file" / "x", TREE, {}),
        lambda: save_arrays(tmp_path / "file", TREE, {}, overwrite=True),
        lambda: store.save_json("/proc/nothing/x.json", {}),
        lambda: Checkpoints(tmp_path / "file").save(0, {"a": np.ones(3)}),
    ):
        with pytest.raises(BadInput, match="cannot use"):
            write()


# --- checkpoints -----------------------------------------------------------------------


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
        ({"a": np.ones((3, 4), np.float32)}, r"a is float32\[2, 4\] there, float32\[3, 4\] here"),
        ({"a": np.ones((2, 4), np.int32)}, r"a is float32\[2, 4\] there, int32\[2, 4\] here"),
        ({"b": np.ones((2, 4), np.float32)}, r"a is float32\[2, 4\] there, absent here"),
        ({"a": {"b": np.ones((2, 4), np.float32)}}, r"a is float32\[2, 4\] there, absent here"),
        ({"a": np.ones((2, 4), np.float32), "b": 1}, r"b is absent there, int here"),
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


def test_torn_checkpoints_give_way_to_the_one_before(tmp_path: Path, capfd) -> None:
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
    with pytest.raises(BadInput, match="one name"):
        Checkpoints(tmp_path).save(1, {"a": {"b": np.ones(1)}, "a/b": np.ones(1)})


class Killed(BaseException):
    """Stands for kill -9: nothing is tidied up after it."""


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
            m.setattr(store, "_delete", dying(store._delete, at))
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
from genidm.store import Checkpoints
checkpoints = Checkpoints(sys.argv[1])
for step in range(10**6):
    checkpoints.save(step, {"a": np.full(100_000, step), "n": step})
    print(step, flush=True)
"""


def test_kill_9_leaves_a_readable_newest_checkpoint(tmp_path: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(Path(store.__file__).parents[1])}
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


# --- stages ----------------------------------------------------------------------------


def test_a_stage_is_found_again_and_knows_whether_it_is_done(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "collect", Config())
    assert stage.directory == tmp_path / f"collect-{store.digest(Config())}"
    config = store.load_json(stage.path("config.json"))
    assert config["config"] == store.plain(Config())
    assert config["environment"] == store.environment()
    assert not stage.done
    stage.checkpoints().save(3, {"a": 1})
    assert Stage.open(tmp_path, "collect", Config()).checkpoints().steps() == [3]
    stage.finish({"interactions": np.int64(7), "mean": np.float32(0.5)})
    stage.clear_checkpoints()
    again = Stage.open(tmp_path, "collect", Config())
    assert again.done and again.summary() == {"interactions": 7, "mean": 0.5}
    assert again.checkpoints().steps() == []
    assert sorted(p.name for p in stage.directory.iterdir()) == ["config.json", "done.json"]
    assert not Stage.open(tmp_path, "collect", Other()).done


def test_a_torn_done_is_not_done(tmp_path: Path) -> None:
    stage = Stage.open(tmp_path, "fit", {})
    stage.finish({"loss": 1.0})
    truncate(stage.path("done.json"))
    assert not stage.done


def test_a_stage_resumed_elsewhere_warns(tmp_path: Path, monkeypatch, capfd) -> None:
    here = store.environment()
    stage = Stage.open(tmp_path, "fit", {})
    stage.checkpoints().save(1, {"a": 1})
    Stage.open(tmp_path, "fit", {})
    assert "warning" not in capfd.readouterr().err
    monkeypatch.setattr(store, "environment", lambda: {**here, "hardware": "another"})
    Stage.open(tmp_path, "fit", {})
    assert "bits may differ" in capfd.readouterr().err
    stage.finish({})
    Stage.open(tmp_path, "fit", {})
    assert "warning" not in capfd.readouterr().err
