"""Films, beside what MuJoCo itself says of the same poses, on a point whose way is known."""

from __future__ import annotations

import dataclasses
import html
import io
import json
import math
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image
from point import Physics, Point, Straight
from tiny import TEST, tiny

from genidm import robots, video
from genidm.config import to_json
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.scenarios import scenarios
from genidm.evaluation.waypoints import WaypointSettings, follow_waypoints
from genidm.files import Corrupt, load_arrays, save_arrays, save_json
from genidm.paper import methods
from genidm.robots import Ant, HumanoidWorld, Logged, remade
from genidm.robots.mujoco import Solver
from genidm.runs.cell import run_method
from genidm.runs.command import run_cli
from genidm.runs.resolve import Options
from genidm.store import Stage
from genidm.video import Clip, RenderSettings, Video, backends, encoding, recorded, rendering
from genidm.video.__main__ import main
from genidm.video.clips import LONGEST, robot_of
from genidm.video.pages import FPS, contents
from genidm.video.scenery import FLOOR_NAME, REACHED, TO_GO, scene


class Drawn(Point):
    """The point, as a box with an arm on a hinge that stays where it is."""

    def visual_model(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        base = spec.worldbody.add_body(name="base")
        base.add_freejoint()
        base.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.3, 0.2, 0.1))
        arm = base.add_body(name="arm", pos=(0.3, 0.0, 0.1))
        arm.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 1, 0))
        arm.add_geom(fromto=(0, 0, 0, 0.2, 0, 0.2), size=(0.05, 0, 0),
                     type=mujoco.mjtGeom.mjGEOM_CAPSULE)  # fmt: skip
        return spec

    def visual_qpos(self, physics: Physics) -> np.ndarray:
        hinge = np.zeros((*np.shape(physics.position)[:-1], 1))
        return np.concatenate([physics.position, physics.orientation, hinge], axis=-1)


def straight(robot: Point) -> Straight:
    return Straight(jnp.float32(1.0), robot)


@pytest.fixture(scope="module")
def made() -> Video:
    return video.render_test(Drawn(), straight(Drawn()), (0, 2), title="a point", quiet=True)


@pytest.fixture
def renderer() -> None:
    try:
        backends.backend()
    except BadInput as error:
        pytest.skip(str(error))


# ── what is filmed ──────────────────────────────────────────────────────────────────────


def test_the_film_is_of_episodes_of_the_test_and_stops_at_their_end(made: Video) -> None:
    tested_scenarios = scenarios(Drawn(), 1, 3)
    starts = Drawn().reset(tested_scenarios.keys[0], tested_scenarios.yaw[0]).position
    for i, take in zip((0, 2), made.clips, strict=True):
        np.testing.assert_allclose(take.position[0], starts[i], atol=1e-6)
        np.testing.assert_allclose(take.waypoints, tested_scenarios.target[0, i][None], atol=1e-6)
        apart = np.linalg.norm((take.position - take.waypoints)[:, :2], axis=-1)
        # The point goes straight there, 0.05 m a step; so near, the episode is over.
        assert (
            apart[-1] <= 0.1 < apart[-2] and len(take.qpos) == np.ceil((apart[0] - 0.1) / 0.05) + 1
        )
        assert take.arrival.tolist() == [len(take.qpos) - 1] and not take.fell
        np.testing.assert_array_equal(take.qpos[:, :3], take.position)
    assert len(made.clips[0].qpos) != len(made.clips[1].qpos)


def test_waypoints_are_each_to_go_until_they_are_reached() -> None:
    points = [(1.0, 0.0), (1.0, 1.0)]
    keys, still = jax.random.split(jax.random.key(0), 1), jnp.zeros(1)
    film = video.render(
        Drawn(), straight(Drawn()), points, keys, still, WaypointSettings(200), quiet=True
    )
    (take,) = film.clips
    first, last = take.arrivals
    assert 0 < first < last == take.seconds and film.title == "point"
    at = np.array([0.0, first - 0.01, first, last])
    assert take.left(at).tolist() == [[True, True], [True, True], [False, True], [False, False]]
    np.testing.assert_allclose(take.goal(at)[:, :2], [points[0]] * 2 + [points[1]] * 2)


def test_a_walk_is_shown_as_it_was() -> None:
    robot, keys = Drawn(), jax.random.split(jax.random.key(0), 3)
    walked = follow_waypoints(
        robot, straight(robot), [(1.0, 0.0), (1.0, 1.0)], keys, jnp.zeros(3),
        settings=WaypointSettings(200), record=video.POSES, quiet=True,
    )  # fmt: skip
    film = video.render_walked(robot, walked, [2, 0], 0.25, "a walk")
    assert film.title == "a walk" and film.goal_radius == 0.25
    for take, i in zip(film.clips, (2, 0), strict=True):
        np.testing.assert_array_equal(take.position, walked.position[i, : walked.steps[i] + 1])
        np.testing.assert_array_equal(take.qpos[:, :3], take.position)
        assert take.arrival.tolist() == walked.arrival[i].tolist() and not take.fell


def test_seconds_end_a_film(made: Video) -> None:
    short = video.render_test(Drawn(), straight(Drawn()), [0], seconds=0.5, quiet=True)
    assert short.clips[0].seconds == pytest.approx(0.5) and short.clips[0].arrival.tolist() == [-1]
    np.testing.assert_allclose(short.clips[0].qpos, made.clips[0].qpos[:11], atol=1e-6)


def test_poses_between_steps_lie_on_the_way(made: Video) -> None:
    model, take = made.visual_model.compile(), made.clips[0]
    np.testing.assert_allclose(take.at(model, take.times), take.qpos, atol=1e-6)
    half = take.at(model, take.times[:-1] + take.dt / 2)
    np.testing.assert_allclose(half[:, :3], (take.qpos[1:] + take.qpos[:-1])[:, :3] / 2, atol=1e-6)
    middle = (take.qpos[1:] + take.qpos[:-1])[:, 3:7]
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    np.testing.assert_allclose(half[:, 3:7], middle, atol=1e-6)


@pytest.mark.parametrize("robot", [Point(), type("Mine", (Logged,), {"name": "mine"})()])
def test_a_robot_without_a_drawing_is_refused(robot) -> None:
    with pytest.raises(BadInput, match="has no visual model"):
        video.render_test(robot, straight(Point()))
    with pytest.raises(BadInput, match="has no visual model"):
        robot.visual_qpos(None)


def test_numbers_that_cannot_be_are_refused() -> None:
    refused: list[tuple[dict, str]] = [
        ({"episodes": ()}, "at least one"), ({"episodes": (1, -1)}, "episode must be at least 0"),
        ({"episodes": (10**12,)}, "at most 999999"), ({"episodes": (0.5,)}, "whole number"),
        ({"seed": -1}, "seed"), ({"seed": 2**32}, "seed"),
        ({"seconds": 0.01}, "at least 0.05 s"), ({"seconds": np.nan}, "at least 0.05 s"),
    ]  # fmt: skip
    for wrong, said in refused:
        with pytest.raises(BadInput, match=said):
            video.render_test(Drawn(), straight(Drawn()), **wrong)
    for wrong in ({"fps": 0.0}, {"fps": 1e-3}, {"width": 2}, {"hold": -1.0}):
        with pytest.raises(BadInput, match=next(iter(wrong))):
            RenderSettings(**wrong)


# ── a run's robot ───────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "robot", [Ant(Solver(iterations=6)), HumanoidWorld(Solver(elliptic=False))]
)
def test_a_robot_is_made_again_from_its_settings(robot, tmp_path: Path) -> None:
    save_json(tmp_path / "experience-0" / "config.json", {"config": {"robot": robot.settings}})
    save_json(tmp_path / "LR-0" / "config.json", {"config": {"source": "experience-0"}})
    Stage(tmp_path / "LR-0").finish({"robot": robot.name, "experience": "experience-0"})
    again = robot_of(tmp_path / "LR-0")
    assert again.settings == robot.settings and type(again) is type(robot)
    assert again.mj_model.opt.iterations == robot.mj_model.opt.iterations


def test_settings_of_no_robot_are_refused() -> None:
    settings = json.loads(json.dumps(to_json(Ant().settings)))
    for wrong in ({"legs": 6}, {"solver": {**settings["solver"], "bends": 1}}):
        with pytest.raises(BadInput, match="cannot make the ant"):
            remade(settings | wrong)


def test_without_its_experience_a_run_has_the_usual_robot(tmp_path: Path) -> None:
    Stage(tmp_path).finish({"robot": "ant", "experience": "experience-gone"})
    assert robot_of(tmp_path).settings == Ant().settings


# ── the page ────────────────────────────────────────────────────────────────────────────


def ant_film(count: int = 12) -> Video:
    """An Ant thrown about: poses that nobody chose."""
    robot, rng = Ant(), np.random.default_rng(0)
    model, qpos = robot.mj_model, np.tile(robot.rest_pose(), (count, 1)).astype(float)
    for pose in qpos:
        mujoco.mj_integratePos(model, pose, rng.normal(size=model.nv), 0.5)
    take = Clip(qpos, qpos[:, :3], np.array([[2.0, 1.0, 0.55]]), np.array([-1]), False, 1 / FPS)
    return Video("ant", robot.visual_model(), [take], 0.1)


def poses(page: dict, take: int = 0) -> np.ndarray:
    """The bodies' places (m) and quaternions `[frames, bodies, 7]`."""
    rows = np.array(page["takes"][take]["frames"], float)[:, 3:]
    return rows.reshape(len(rows), -1, 7) / [1e3, 1e3, 1e3, 1e4, 1e4, 1e4, 1e4]


def test_every_geom_is_where_mujoco_has_it() -> None:
    film = ant_film()
    page, model = contents(film), film.visual_model.compile()
    there = [i for i in range(model.ngeom) if model.geom_type[i] != mujoco.mjtGeom.mjGEOM_PLANE]
    assert len(page["geoms"]) == len(there) == model.ngeom - 1
    data, point = mujoco.MjData(model), np.zeros(3)
    for pose, bodies in zip(film.clips[0].qpos, poses(page), strict=True):
        data.qpos = pose
        mujoco.mj_forward(model, data)
        for geom, i in zip(page["geoms"], there, strict=True):
            body = bodies[geom["body"]]
            np.testing.assert_allclose(body[:3], data.xpos[model.geom_bodyid[i]], atol=6e-4)
            mujoco.mju_rotVecQuat(point, np.array(geom["place"]), body[3:])
            np.testing.assert_allclose(body[:3] + point, data.geom_xpos[i], atol=1e-3)


def test_the_floor_stays_under_what_comes_from_a_urdf() -> None:
    """MuJoCo leaves out of a URDF what nothing collides with."""
    urdf = """<robot name="block"><link name="block">
      <inertial><mass value="1"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><geometry><box size="1 1 1"/></geometry></collision></link></robot>"""
    model = scene(mujoco.MjSpec.from_string(urdf), 64, 64)
    assert model.geom(FLOOR_NAME).type == mujoco.mjtGeom.mjGEOM_PLANE and model.ntex == 1


def test_every_kind_of_geom_is_shown_and_a_mesh_as_its_box() -> None:
    spec = Drawn().visual_model()
    arm = spec.body("arm")
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0.5]], float)
    spec.add_mesh(
        name="wedge", uservert=corners.reshape(-1), userface=[0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
    )
    kinds = mujoco.mjtGeom
    for kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CYLINDER, kinds.mjGEOM_ELLIPSOID):
        arm.add_geom(type=kind, size=(0.1, 0.2, 0.3), rgba=(1, 0, 0, 1))
    arm.add_geom(type=kinds.mjGEOM_MESH, meshname="wedge", pos=(0.1, 0.2, 0.3))
    spec.add_material(name="paint", rgba=(0, 0, 1, 1))
    arm.add_geom(type=kinds.mjGEOM_SPHERE, size=(0.1, 0, 0), material="paint")
    arm.add_geom(type=kinds.mjGEOM_BOX, size=(1, 1, 1), group=3)
    arm.add_geom(type=kinds.mjGEOM_BOX, size=(1, 1, 1), rgba=(1, 0, 0, 0))
    qpos = np.array([[0.0, 0, 0, 1, 0, 0, 0, 0]] * 2)
    take = Clip(qpos, qpos[:, :3], np.zeros((1, 3)), np.array([1]), False, 0.1)
    page = contents(Video("all", spec, [take], 0.1))
    shown = [geom["kind"] for geom in page["geoms"]]
    assert shown == ["box", "capsule", "sphere", "cylinder", "ellipsoid", "box", "sphere"]
    assert page["geoms"][2]["colour"] == [255, 0, 0]
    assert page["geoms"][-1]["colour"] == [0, 0, 255]
    box = page["geoms"][-2]
    # The body's frame is turned by nothing here, so the corners are where the file has them.
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, np.array(box["turn"]))
    inside = (corners + np.array([0.1, 0.2, 0.3]) - box["place"]) @ turned.reshape(3, 3)
    assert (np.abs(inside) <= np.array(box["size"]) + 1e-3).all()


def test_a_page_says_how_the_journeys_went(made: Video) -> None:
    page = contents(made)
    for shown, take in zip(page["takes"], made.clips, strict=True):
        assert shown["arrivals"] == [pytest.approx(take.seconds)]
        assert shown["outcome"] == f"arrived after {take.seconds:.1f} s"
        np.testing.assert_allclose(
            np.array(shown["frames"])[-1, :3] / 1e3, take.position[-1], atol=6e-4
        )
        assert len(shown["frames"]) == len(take.qpos)  # both are of 0.05 s
    lost = dataclasses.replace(made.clips[0], arrival=np.array([5, -1]), fell=True)
    assert video.pages.outcome(lost) == f"1 of 2, fell after {lost.seconds:.1f} s"


def inside(page: str) -> dict:
    """What a page was given, as a browser finds it."""
    start = page.index('id="film">') + len('id="film">')
    return json.loads(page[start : page.index("</script>", start)])


def test_a_page_is_whole_and_nothing_breaks_out_of_it(made: Video) -> None:
    film = dataclasses.replace(made, title='</script><b>"&')
    page = video.page(film)
    assert (
        "http" not in page and "src=" not in page and "<link" not in page and "@import" not in page
    )
    data = inside(page)
    assert data["title"] == film.title and len(data["takes"]) == 2
    shown = page._repr_html_()
    srcdoc = shown.split('srcdoc="')[1].split('" sandbox')[0]
    assert html.unescape(srcdoc) == page


# ── pictures ────────────────────────────────────────────────────────────────────────────


def near(picture: np.ndarray, colour: tuple[float, ...]) -> int:
    """How many pixels have the hue of a colour: more of its strongest part than floor and box."""
    wanted = np.array(colour[:3]) - np.mean(colour[:3])
    shade = picture.astype(float) - picture.mean(-1, keepdims=True)
    along = shade @ wanted / np.linalg.norm(wanted)
    across = np.linalg.norm(shade - along[..., None] * wanted / np.linalg.norm(wanted), axis=-1)
    return int(((along > 40) & (across < 0.5 * along)).sum())


@pytest.mark.usefixtures("renderer")
def test_pictures_show_the_target_and_that_it_was_reached(made: Video) -> None:
    film = dataclasses.replace(made, clips=made.clips[:1])
    shot = RenderSettings(160, 120, 5.0, hold=0.4, caption=False)
    pictures = np.stack(list(video.frames(film, shot, quiet=True)))
    seconds = film.clips[0].seconds
    assert pictures.shape == (np.ceil(seconds * 5) + 3, 120, 160, 3)
    assert near(pictures[0], TO_GO) > 10 and near(pictures[0], REACHED) == 0
    assert near(pictures[-1], REACHED) > 10 and near(pictures[-1], TO_GO) == 0
    moved = np.abs(np.diff(pictures[:-2].astype(int), axis=0)).max((1, 2, 3))
    assert (moved > 30).all()
    np.testing.assert_array_equal(pictures[-1], pictures[-3])  # the end, held


@pytest.mark.usefixtures("renderer")
def test_a_gif_has_every_picture_for_its_time(made: Video, tmp_path: Path) -> None:
    film = dataclasses.replace(made, clips=made.clips[:1])
    video.write(film, tmp_path / "a.gif", quiet=True, width=96, height=64, hold=0.0)
    with Image.open(tmp_path / "a.gif") as gif:
        shown = rendering.times(film.clips[0], RenderSettings(hold=0.0))
        assert gif.size == (96, 64) and gif.n_frames == len(shown) and gif.info["loop"] == 0
        assert {frame_time(gif, i) for i in range(gif.n_frames)} == {80}


@pytest.mark.parametrize("fps", [0.01, 0.5, 10.0, 25.0, encoding.FASTEST])
def test_a_gif_is_shown_at_its_pace(fps: float) -> None:
    pictures = [np.full((16, 16, 3), x, np.uint8) for x in (0, 255)]
    with Image.open(io.BytesIO(encoding.gif(pictures, fps))) as gif:
        assert frame_time(gif, 1) == pytest.approx(1000 / fps)


def frame_time(gif: Image.Image, number: int) -> int:
    gif.seek(number)
    return gif.info["duration"]


def test_a_gif_keeps_the_colours_of_little_things() -> None:
    floor = np.linspace(120, 230, 96 * 64).reshape(64, 96, 1).repeat(3, -1).astype(np.uint8)
    pictures = [floor.copy() for _ in range(10)]
    for i, picture in enumerate(pictures):
        picture[30:36, 8 * i : 8 * i + 6] = np.round(255 * np.array(TO_GO[:3]))
    with Image.open(io.BytesIO(encoding.gif(pictures, 12.5))) as gif:
        gif.seek(5)
        found = np.asarray(gif.convert("RGB"))[32, 42].astype(int)
    assert np.abs(found - 255 * np.array(TO_GO[:3])).max() < 20


def test_the_camera_keeps_the_robot_in_the_middle_and_its_goal_in_sight(made: Video) -> None:
    take = made.clips[0]
    cameras = rendering.cameras(take, take.times, 1.0)
    ahead = np.radians([camera.azimuth for camera in cameras])
    way = (take.waypoints - take.position)[:, :2]
    angle = np.arctan2(way[:, 1], way[:, 0]) - ahead
    assert (np.abs(np.degrees((angle + np.pi) % (2 * np.pi) - np.pi)) < 45).all()
    apart = np.linalg.norm([c.lookat for c in cameras] - take.position, axis=-1)
    assert apart.max() < 0.25


def test_mp4_needs_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(BadInput, match=r"genidm\[video\]"):
        encoding.encoder()


@pytest.mark.parametrize(("shape", "size"), [((64, 96), (96, 64)), ((63, 95), (96, 64))])
def test_an_mp4_has_every_picture(
    shape: tuple[int, int], size: tuple[int, int], tmp_path: Path
) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="mp4 needs imageio-ffmpeg")
    pictures = (np.full((*shape, 3), 25 * i, np.uint8) for i in range(10))
    (tmp_path / "a.mp4").write_bytes(encoding.mp4(pictures, 5.0))
    about, *shown = ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert about["size"] == size and about["fps"] == 5.0 and about["pix_fmt"].startswith("yuv420p")
    middle = [np.frombuffer(x, np.uint8).reshape(*size[::-1], 3)[32, 48].mean() for x in shown]
    assert middle == pytest.approx([25 * i for i in range(10)], abs=4)


@pytest.mark.parametrize("reads", ["cat > /dev/null", "true"])
def test_an_mp4_that_cannot_be_encoded_is_refused(
    reads: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where that shows at the very end: the last bytes are written there."""
    fails = tmp_path / "ffmpeg"
    fails.write_text(f"#!/bin/sh\n{reads}\necho No space left on device >&2\nexit 1\n")
    fails.chmod(0o755)
    monkeypatch.setattr(encoding, "encoder", lambda: str(fails))
    pictures = [np.zeros((640, 480, 3), np.uint8)] * 3
    with pytest.raises(BadInput, match=r"cannot encode the mp4 in /.*: No space left on device$"):
        encoding.mp4(pictures, 5.0)


# ── what it draws with ──────────────────────────────────────────────────────────────────


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which nothing starts."""
    backends.backend.cache_clear()
    monkeypatch.setattr(backends, "starts", lambda name: False)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")


@pytest.mark.usefixtures("nowhere")
def test_without_a_renderer_a_command_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(sys, "argv", ["video", str(tmp_path), "--out", str(tmp_path / "a.gif")])
    with pytest.raises(SystemExit) as stop:
        run_cli(main, "Renders a saved controller.")
    said = capsys.readouterr().err
    assert stop.value.code == 2 and said.startswith("error: ") and said.count("\n") == 1
    assert "libosmesa6" in said and "libegl1" in said and ".html" in said
    assert not (tmp_path / "a.gif").exists()


@pytest.mark.usefixtures("nowhere")
def test_the_user_says_what_to_draw_with(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(backends.candidates()) == {"egl", "osmesa"}
    monkeypatch.setenv("MUJOCO_GL", "OSMesa")
    assert backends.candidates() == ("osmesa",)
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(BadInput, match="MUJOCO_GL turns it off"):
        backends.backend()


def test_what_does_not_start_is_not_taken() -> None:
    assert not backends.starts("nothing_of_that_name")


REFUSED: list[tuple[str, dict, str]] = [
    ("film.avi", {}, r"a video must be a"),
    ("render", {}, r"a video must be a"),
    ("a.gif", {"fps": math.nan}, "fps must be a finite number"),
    ("a.gif", {"fps": 60.0}, r"fps of a gif must lie in .*50"),
    ("a.mp4", {"fps": 1e-9}, "fps must lie in"),
    ("a.html", {"fps": math.inf}, "fps must be a finite number"),
    ("a.mp4", {"width": 10**6}, "width must be at most 8192"),
    ("a.gif", {"height": -3}, "height must be at least 16"),
    ("file/a.gif", {}, "cannot use .*file/a.gif"),
    ("folder.html", {}, "a directory, not a file"),
    (f"{'x' * 300}.mp4", {}, "File name too long"),
    ("proc/a.html", {}, "cannot use"),
]


@pytest.fixture
def places(tmp_path: Path) -> Path:
    """A directory with a file, a directory called like a video, and one that nobody can write."""
    (tmp_path / "file").touch()
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "proc").symlink_to("/proc")
    return tmp_path


@pytest.mark.parametrize(("name", "changes", "said"), REFUSED)
def test_what_cannot_be_written_is_refused_before_there_is_a_film(
    name: str, changes: dict, said: str, places: Path
) -> None:
    with pytest.raises(BadInput, match=said):
        video.check(places / name, **changes)
    # Were the run looked at before the video's file, it would say that there is no such run.
    with pytest.raises(BadInput, match=said):
        main((places / "no run",), (places / "good.html", places / name), **changes)
    assert not (places / "good.html").exists()


def test_checking_leaves_no_file(tmp_path: Path) -> None:
    shot = video.check(str(tmp_path / "new" / "a.html"), width=99)  # and a str is a path
    assert shot.width == 99 and not [*tmp_path.rglob("*")]


def test_a_command_refuses_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out = str(tmp_path / "a.html")
    monkeypatch.setattr(sys, "argv", ["video", str(tmp_path), "--out", out, "--fps", "nan"])
    with pytest.raises(SystemExit) as stop:
        run_cli(main, "Renders a saved controller.")
    said = capsys.readouterr().err
    assert stop.value.code == 2 and said == "error: fps must be a finite number, not nan\n"


# ── from a command ──────────────────────────────────────────────────────────────────────


def test_a_cell_films_its_controller_even_where_no_picture_can_be_drawn(
    tmp_path: Path, nowhere: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    options = Options(scale="0.25", run_dir=tmp_path, episodes=2, test=TEST, video=True)
    run_method(Drawn(), tiny(methods.RS), options)
    (path,) = tmp_path.glob("point/RS-0-*/video.html")
    beside = inside(path.read_text())
    # They are the tested episodes themselves, all that there were.
    (test,) = tmp_path.glob("point/test-RS-0-*")
    outcome = load_arrays(test / "episodes")[0]["episodes"]
    takes = video.render_recorded(Drawn(), test).clips
    assert [len(take.qpos) - 1 for take in takes] == outcome["steps"][0].tolist()
    assert [take.fell for take in takes] == outcome["fell"][0].tolist()
    assert contents(video.render_recorded(Drawn(), str(test), title="RS, point")) == beside
    assert recorded(path.parent, Drawn(), (0, 1)) == test
    assert recorded(str(path.parent), Drawn(), (2,)) is None
    assert contents(video.render_run(str(path.parent), robot=Drawn())) == beside
    save_json(tmp_path / "point" / "test-of-others" / "done.json", [])  # the newest, and no test's
    assert recorded(path.parent, Drawn()) == test
    for other in ("test-of-others", "no run", *(p.name for p in tmp_path.glob("point/exp*"))):
        with pytest.raises(BadInput, match=r"done\.json|controller"):
            video.render_run(tmp_path / "point" / other, robot=Drawn())
    assert (
        beside["title"] == "RS, point" and "no gif: MuJoCo cannot render" in capsys.readouterr().err
    )
    monkeypatch.setitem(robots.ROBOTS, "point", Drawn)
    main((path.parent,), (tmp_path / "again.html",), seconds=LONGEST)
    assert inside((tmp_path / "again.html").read_text()) == beside  # found by its run alone
    main((path.parent,), (tmp_path / "way.html",), (4, 1), waypoints=(9.0, 0.0, 0.0, 9.0))
    with pytest.raises(BadInput, match="exactly one run"):
        main((path.parent,) * 2)
    way = inside((tmp_path / "way.html").read_text())
    assert [take["waypoints"] for take in way["takes"]] == [[[9, 0, 0.5], [0, 9, 0.5]]] * 2
    assert way["reach"] == WaypointSettings.goal_radius and "way.html" in capsys.readouterr().out


def test_a_test_is_read_by_the_film_alone_which_sees_whether_it_is_corrupt(tmp_path: Path) -> None:
    run, test = tmp_path / "RS-0-a", tmp_path / "test-RS-0-b"
    poses = np.array([[0.0, 0, 0, 1, 0, 0, 0, 0]] * 3)
    recording = {"qpos": poses, "position": poses[:, :3], "target": np.zeros(3)}
    outcome = {"reached": np.array([[False, True]]), "fell": np.array([[True, False]])}
    tree = {"episodes": outcome, "recordings": {"1": recording}}
    save_arrays(test / "episodes", tree, {})
    Stage(test).finish(
        {"fit": run.name, "engine": None, "test": to_json(EvaluationSettings(max_steps=9))}
    )
    assert recorded(run, Drawn(), [1]) == recorded(str(run), Drawn()) == test
    assert recorded(run, Drawn(), [0, 1]) is None
    (take,) = video.render_recorded(Drawn(), str(test)).clips
    assert take.arrival.tolist() == [2] and not take.fell
    with pytest.raises(BadInput, match="has not recorded episode 0"):
        video.render_recorded(Drawn(), test, [1, 0])
    (test / "episodes" / "recordings.1.qpos.npy").write_bytes(b"corrupt")
    assert recorded(run, Drawn()) == test
    with pytest.raises(Corrupt, match=r"recordings\.1\.qpos"):
        video.render_recorded(Drawn(), test)


def test_a_test_that_has_recorded_nothing_is_no_film(tmp_path: Path) -> None:
    save_arrays(tmp_path / "episodes", {"episodes": {"fell": np.zeros((1, 1), bool)}}, {})
    Stage(tmp_path).finish({"test": to_json(EvaluationSettings())})
    with pytest.raises(BadInput, match="has not recorded"):
        video.render_recorded(Drawn(), tmp_path)


def test_a_cell_that_cannot_be_filmed_says_so_before_it_begins(tmp_path: Path) -> None:
    options = Options(scale="0.25", run_dir=tmp_path, episodes=2, test=TEST, video=True)
    with pytest.raises(BadInput, match="has no visual model"):
        run_method(Point(), tiny(methods.RS), options)
    assert not list(tmp_path.iterdir())
