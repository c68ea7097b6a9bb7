"""docs/extending.md, followed to the letter: a robot and an engine, from the class to the video."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import bits
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_c import assert_close, placed, positive_w, step_in_c

from experiments import evaluate, physics, train
from genidm import engines, robots
from genidm.config import to_json
from genidm.controller import load as load_controller
from genidm.engines import ENGINES, Engine, Physics
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.robots import ROBOTS, Ant, Robot, by_name, remade
from genidm.robots.mujoco import MujocoRobot

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
TEST = EvaluationSettings(max_steps=20, num_envs=4, chunk=10)
SMALL = (
    *("--scale", "0.0005", "--episodes", "2", "--engine", "mujoco"),
    *("--test.max-steps", "20", "--test.num-envs", "4", "--test.chunk", "10"),
    *(
        "--method.agent.num-envs",
        "16",
        "--method.agent.unroll-length",
        "8",
        "--method.goal-horizon",
        "5",
    ),
    *("--method.fit.updates", "20", "--method.fit.batch-size", "16"),
)
BEETLE = """
<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="9 9 1"/>
  <body name="base" pos="0 0 0.3"><freejoint/><geom type="box" size=".2 .1 .05"/>
    <body name="left" pos="0 .15 0"><joint name="left" axis="0 1 0" range="-60 60"/>
      <geom type="capsule" size=".03" fromto="0 0 0 0 .1 -.25"/></body>
    <body name="right" pos="0 -.15 0"><joint name="right" axis="0 1 0" range="-60 60"/>
      <geom type="capsule" size=".03" fromto="0 0 0 0 -.1 -.25"/></body>
  </body></worldbody>
  <actuator><motor joint="right" gear="5"/><motor joint="left" gear="5"/></actuator></mujoco>
"""


def program(kind: str) -> Any:
    """The class that the page's program of a kind defines, and registers."""
    section = PAGE.read_text(encoding="utf-8").split(f"## {kind}")[1]
    code = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert code
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(code[1], str(PAGE), "exec"), names)
    found = [x for x in names.values() if getattr(x, "__module__", None) == "page"]
    (made,) = found
    return made


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> type[MujocoRobot]:
    monkeypatch.setitem(ROBOTS, "toy", Ant)  # so that it is taken away again
    del ROBOTS["toy"]
    return program("A robot")


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> type[Engine]:
    monkeypatch.setitem(ENGINES, "loop", ENGINES["mujoco"])
    del ENGINES["loop"]
    return program("An engine")


def command(main: Any, *flags: str) -> None:
    with pytest.MonkeyPatch.context() as m:
        m.setattr(sys, "argv", ["command", *flags])
        main()


# ── a robot ─────────────────────────────────────────────────────────────────────────────────


def test_the_page_robot_goes_all_the_way(
    toy: type[MujocoRobot], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Collected, replayed, fitted, tested, filmed and shown; then loaded and tested again."""
    where = ("--run-dir", str(tmp_path), "--report-dir", str(tmp_path / "shown"), "--video")
    command(train.main, "--robot", "toy", *SMALL, *where, "--method", "LR")
    assert re.search(r"^LR +\d\.\d{3} ± \d\.\d{3}", capsys.readouterr().out, re.MULTILINE)
    stages = {path.parent.name.rsplit("-", 1)[0] for path in (tmp_path / "toy").glob("*/done.json")}
    assert stages == {"experience-PPO-0", "replay-segments-0", "LR-0", "test-LR-0"}
    (run,) = (tmp_path / "toy").glob("LR-0-*")
    assert (run / "video.html").stat().st_size > 10_000
    (written,) = (tmp_path / "shown").glob("toy*.json")
    assert list(json.loads(written.read_text(encoding="utf-8"))["methods"]) == ["LR"]
    controller = load_controller(run, engine="mujoco")
    assert isinstance(controller.robot, toy)
    assert controller(jnp.zeros((3, 27)).at[:, 1].set(1.0), jnp.ones((3, 3))).shape == (3, 8)
    evaluate.main((run,), seeds=1, episodes=2, engine="mujoco", test=TEST)
    assert re.search(r"^LR ", capsys.readouterr().out, re.MULTILINE)


def test_its_physics_is_measured(
    toy: type[MujocoRobot], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """By every engine there is: here, where MJX would take minutes to compile, by one."""
    monkeypatch.setattr(physics, "ENGINES", {"mujoco": ENGINES["mujoco"]})
    monkeypatch.setattr(physics, "SETTINGS", (physics.OURS,))
    physics.physics(physics.Options(robot="toy", steps=1, num_envs=2, out=tmp_path / "x.json"))
    written = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    assert [(row["engine"], row["steps"]) for row in written["stability"]] == [
        ("C float32 rows", physics.EPISODE * 2)
    ]
    drifts = {row["engine"]: row["median"] for row in written["drift"]}
    assert drifts["C float64 rows"][0] < 1e-12 < drifts["C float32 rows"][0] < 1e-5
    assert "elliptic 4/8" in capsys.readouterr().out
    with pytest.raises(BadInput, match=r"^--robot must be ant, ant_v2, humanoid"):
        physics.physics(physics.Options(robot="minitaur"))


def test_its_defaults_are_gymnasiums(toy: type[MujocoRobot], ant: Ant) -> None:
    """On the Ant's own model: the Ant without its contacts."""
    made = toy(engine="mujoco")
    assert made.observation.describe() == ant.observation.describe().rsplit("\n", 1)[0]
    keys, yaw = jax.random.split(jax.random.key(0), 3), jnp.array([0.0, 1.0, -2.0])
    state = made.reset(keys, yaw)
    theirs = ant.set_state(state.physics, jnp.zeros(3))
    bits.same(state.observation, theirs.observation[:, :27])
    action = jnp.full((3, 8), 0.5)
    assert_close(made.cost(state, action), np.full(3, 0.5 * 8 * 0.25), atol=1e-6)
    assert_close(made.cost(state, action), ant.cost(theirs, action), atol=1e-6)


@pytest.fixture
def beetle(tmp_path: Path) -> MujocoRobot:
    """A robot from a file of one's own, given as a str; nothing of it is the Ant's."""
    file = tmp_path / "beetle.xml"
    file.write_text(BEETLE, encoding="utf-8")

    class Beetle(MujocoRobot):
        """A box on two legs."""

        name = "beetle"
        model = str(file)
        frame_skip, dt = 4, 0.02
        standing_height, healthy_height = 0.3, (0.1, 1.0)

    return Beetle(engine="mujoco")


def test_another_model_steps_as_mujoco_does(beetle: MujocoRobot) -> None:
    rng, lanes = np.random.default_rng(0), 4
    qpos = np.tile(beetle.rest_pose().astype(float), (lanes, 1))
    start = Physics(qpos, 0.1 * rng.normal(size=(lanes, 8)), np.zeros((lanes, 8)))
    start = jax.tree.map(lambda x: x.astype(np.float32).astype(float), start)
    actions = rng.uniform(-1, 1, (1, lanes, 2)).astype(np.float32)
    after, _ = step_in_c(beetle, start, actions)
    state = beetle.step(placed(beetle, start), jnp.asarray(actions[0]))
    expected = positive_w(after)
    assert_close(state.observation, np.hstack([expected.qpos[:, 2:], expected.qvel]), atol=1e-5)
    assert not state.fallen.any()


def test_its_mirror_image_is_read_off_the_model(beetle: MujocoRobot) -> None:
    """Joints are in the file's order, left first; actuators are not."""
    m = beetle.mirror
    assert (m.hinges, m.signs, m.actuators, m.actuator_signs) == ([1, 0], [1, 1], [1, 0], [1, 1])
    assert beetle.action.mirror(jnp.array([[0.25, -0.5]])).tolist() == [[-0.5, 0.25]]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("<freejoint/>", ""), "a free joint first, and hinges after it"),
        (('name="left" axis', 'name="left" type="slide" axis'), "a free joint first, and hinges"),
        (('timestep="0.005"', 'timestep="0.004"'), r"4 time steps of the model are 0.016 s, not"),
        (('pos="0 .15 0"', 'pos="0 .25 0"'), "its own image"),
    ],
)
def test_a_model_that_does_not_fit_is_refused(
    beetle: MujocoRobot, change: tuple[str, str], why: str
) -> None:
    file = Path(str(beetle.model))
    file.write_text(BEETLE.replace(*change), encoding="utf-8")
    with pytest.raises(ValueError, match=why):
        type(beetle)(engine="mujoco")


# ── an engine ───────────────────────────────────────────────────────────────────────────────


def test_the_page_engine_gives_the_bits_of_mujoco_in_c(
    loop: type[Engine], toy: type[MujocoRobot], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT where it runs
    made, usual = toy(engine="loop"), toy(engine="mujoco")
    assert isinstance(made.engine, loop) and made.settings["engine"] == "loop"
    state = usual.reset(jax.random.split(jax.random.key(1), 4), jnp.zeros(4))
    action = jax.random.uniform(jax.random.key(2), (4, 8), minval=-1.5, maxval=1.5)
    bits.same(made.engine.step(state.physics, action), usual.engine.step(state.physics, action))
    broken = state.physics.replace(qpos=state.physics.qpos.at[2, 0].set(jnp.nan))
    lost = made.engine.step(broken, action)
    assert np.isnan(lost.physics.qpos).any(-1).tolist() == [False, False, True, False]
    assert made.step(state.replace(physics=broken), action).diverged.tolist() == [0, 0, 1, 0]


def test_the_page_engine_goes_all_the_way(
    loop: type[Engine], toy: type[MujocoRobot], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["loop" if flag == "mujoco" else flag for flag in SMALL]
    command(train.main, "--robot=toy", "--method=GE", *flags, "--run-dir", str(tmp_path))
    shown = capsys.readouterr()
    assert "toy on MuJoCo in C, one robot after another\n" in shown.err
    assert re.search(r"^GE +\d\.\d{3} ", shown.out, re.MULTILINE)
    (config,) = (tmp_path / "toy").glob("replay-segments-0-*/config.json")
    assert '"segment": 50' in config.read_text(encoding="utf-8")
    (run,) = (tmp_path / "toy").glob("GE-0-*")
    assert isinstance(load_controller(run, engine="loop").robot.engine, loop)


def test_every_robot_with_a_model_takes_it_and_none_gets_it_unasked(loop: type[Engine]) -> None:
    assert isinstance(by_name("ant", "loop").engine, loop)
    assert [*Ant.engines] == ["mjx", "mujoco", "loop"]
    assert engines.choose(None, Ant.engines, "ant") in ("mjx", "mujoco")
    assert engines.choose(None, by_name("ant", "mujoco").engines, "ant") != "loop"
    settings = by_name("ant", "loop").settings
    assert isinstance(remade(to_json(settings)).engine, loop)


# ── the registries ──────────────────────────────────────────────────────────────────────────


def test_a_name_is_given_once(toy: type[MujocoRobot], loop: type[Engine]) -> None:
    assert ROBOTS["toy"] is toy and ENGINES["loop"] is loop
    again = program("A robot")  # the same program once more, as in a notebook
    assert again is not toy and ROBOTS["toy"] is again
    program("An engine")

    class Other(Ant):
        """Another robot, which has left its name as it was."""

    with pytest.raises(BadInput, match=r"^another robot is called 'ant': genidm\.robots\.ant\.Ant"):
        robots.register(Other)
    assert ROBOTS["ant"] is Ant


@pytest.mark.parametrize("name", ["", "a/b", "two words", "../up", None, 3])
def test_a_name_that_cannot_stand_in_a_path_is_refused(name: Any) -> None:
    with pytest.raises(BadInput, match=r"^the name of (a robot|Kind) must "):
        robots.register(type("Kind", (MujocoRobot,), {"name": name}))
    engine = type("Kind", (ENGINES["mujoco"],), {"name": name})
    with pytest.raises(BadInput, match=r"^the name of Kind must be an identifier, not "):
        engines.register(engine)


def test_what_lacks_a_method_is_no_robot_yet() -> None:
    class Half(Robot):
        """A robot that cannot step."""

        name = "half"

    with pytest.raises(BadInput, match=r"^Half is not a complete robot: it lacks cost, dt, "):
        robots.register(Half)
    engine = type("Half", (Engine,), {"name": "half"})
    sentence = r"^Half is not a complete engine: it lacks __str__, label, step$"
    with pytest.raises(BadInput, match=sentence):
        engines.register(engine)
    unsized = type(
        "Unsized", (MujocoRobot,), {"name": "unsized", "model": "x.xml", "frame_skip": 5}
    )
    lacking = "dt, healthy_height, standing_height"
    with pytest.raises(BadInput, match=f"^Unsized is not a complete robot: it lacks {lacking}$"):
        robots.register(unsized)
    assert not {"half", "unsized"} & {*ROBOTS, *ENGINES}


def test_a_robot_that_steps_itself_takes_no_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    from point import Point

    monkeypatch.setitem(ROBOTS, "point", Point)
    assert by_name("point").engine is None
    with pytest.raises(BadInput, match=r"^the point steps itself and takes no engine, got 'mjx'$"):
        by_name("point", "mjx")
