"""Pictures of a video, by MuJoCo's renderer."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from genidm.checks import check, count, number
from genidm.progress import Progress
from genidm.video.backends import renderer
from genidm.video.clips import Clip, Video, between
from genidm.video.scenery import REACHED, RGBA, SUN, SUN_AWAY, TO_GO, TRAIL, scene, size

# The camera: metres away in sizes of the robot, degrees, seconds that its moves are smoothed over.
AWAY = 3.7
DOWN = -27.0
ASIDE = 38.0
CALM_PLACE = 0.25
CALM_TURN = 0.7
# A waypoint's flag: a ball that hovers over where the base should come, in sizes of the robot.
BALL = 0.13
HOVER = 0.65
# Metres: radius of the trail and of a flag's pole, from one piece of the trail to the next.
LINE = 0.02
PIECE = 0.08
MOST_MARKS = 4000


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """How a video is rendered.

    Attributes:
      width, height: pixels.
      fps: pictures a second.
      hold: seconds that the end of a journey is shown.
      caption: write time and distance into the pictures.
    """

    width: int = 320
    height: int = 240
    fps: float = 12.5
    hold: float = 0.8
    caption: bool = True

    def __post_init__(self) -> None:
        size = count(16, 8192)
        check(self, width=size, height=size, fps=number(0.01, 1000), hold=number(0, 3600))


def frames(video: Video, settings: RenderSettings, quiet: bool = False) -> Iterator[np.ndarray]:
    """The pictures `[height, width, 3]` of every clip, one after another, as uint8.

    Raises:
      BadInput: there is nothing to draw with.
    """
    model = scene(video.visual_model, settings.width, settings.height)
    cues = [times(clip, settings) for clip in video.clips]
    with (
        Progress("pictures", sum(map(len, cues)), "pictures", quiet=quiet) as bar,
        renderer(model, settings.width, settings.height, MOST_MARKS + model.ngeom) as eye,
    ):
        for number, (clip, seconds) in enumerate(zip(video.clips, cues, strict=True), 1):
            words = f"{video.title}   {number} of {len(cues)}" if len(cues) > 1 else video.title
            for picture, now in zip(_clip(eye, video, clip, seconds), seconds, strict=True):
                yield _captioned(picture, words, _gauge(clip, now)) if settings.caption else picture
                bar.advance(1)


def times(clip: Clip, settings: RenderSettings) -> np.ndarray:
    """Seconds since the start that are shown, the end for a while."""
    moving = np.arange(0, clip.seconds, 1 / settings.fps)
    return np.append(moving, [clip.seconds] * (1 + round(settings.hold * settings.fps)))


def mark(
    scene: mujoco.MjvScene,
    clip: Clip,
    left: np.ndarray,
    now: float,
    goal_radius: float,
    size: float,
) -> None:
    """Adds what stands beside the robot: its waypoints, and its way so far.

    Args:
      scene: what is added to.
      clip: the journey.
      left: `[W]` bool, which waypoints are not reached yet.
      now: seconds since the start.
      goal_radius: metres.
      size: of the robot, metres.
    """
    kinds = mujoco.mjtGeom
    for point, to_go in zip(clip.waypoints, left, strict=True):
        colour = TO_GO if to_go else REACHED
        foot, top = point * (1, 1, 0), point + np.array([0, 0, HOVER * size])
        add(scene, kinds.mjGEOM_SPHERE, (BALL * size,) * 3, top, colour)
        add(scene, kinds.mjGEOM_CYLINDER, (goal_radius, 0.004, 0.0), foot, (*colour[:3], 0.4))
        add_line(scene, foot, top, LINE / 2, colour)
    for a, b in itertools.pairwise(_way(clip, now)):
        add_line(scene, a, b, LINE, TRAIL)


def add(
    scene: mujoco.MjvScene, kind: int, size: tuple[float, ...], place: np.ndarray, colour: RGBA
) -> mujoco.MjvGeom:
    """One more thing in a scene; the last one again where there is no room."""
    scene.ngeom = min(scene.ngeom + 1, scene.maxgeom)
    geom = scene.geoms[scene.ngeom - 1]
    upright = np.eye(3).reshape(-1)
    rgba = np.asarray(colour, np.float32)
    mujoco.mjv_initGeom(geom, kind, np.asarray(size), np.asarray(place), upright, rgba)
    return geom


def add_line(
    scene: mujoco.MjvScene, a: np.ndarray, b: np.ndarray, radius: float, colour: RGBA
) -> None:
    """A round line in a scene, from a to b `[3]`."""
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    mujoco.mjv_connector(add(scene, kind, (radius,) * 3, a, colour), kind, radius, a, b)


def _clip(
    eye: mujoco.Renderer, video: Video, clip: Clip, seconds: np.ndarray
) -> Iterator[np.ndarray]:
    data, poses = mujoco.MjData(eye.model), clip.at(eye.model, seconds)
    metres = size(eye.model, poses[0])
    cameras = _cameras(clip, seconds, metres)
    for pose, left, now, camera in zip(poses, clip.left(seconds), seconds, cameras, strict=True):
        data.qpos = pose
        mujoco.mj_forward(eye.model, data)
        data.light_xpos[:] = camera.lookat - SUN_AWAY * np.asarray(SUN)
        eye.update_scene(data, camera)
        mark(eye.scene, clip, left, now, video.goal_radius, metres)
        yield eye.render()


def _way(clip: Clip, now: float) -> np.ndarray:
    """The way up to a time `[n, 3]`, on the floor, in pieces of a length that can be seen."""
    made = clip.position[clip.times <= now + 1e-6] * (1, 1, 0) + (0, 0, LINE)
    length = np.cumsum(np.linalg.norm(np.diff(made, axis=0, prepend=made[:1]), axis=1))
    return made[np.unique(length // PIECE, return_index=True)[1]]


def _cameras(clip: Clip, seconds: np.ndarray, size: float) -> list[mujoco.MjvCamera]:
    """Behind the robot and to its side, so that where it goes is in the picture."""
    ahead = clip.goal(clip.times)[:, :2] - clip.position[:, :2]
    turn = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    calm = np.c_[_calm(clip.position, CALM_PLACE, clip), _calm(turn, CALM_TURN, clip)]
    cameras = []
    for *place, azimuth in between(calm, clip.times, seconds):
        camera = mujoco.MjvCamera()
        camera.azimuth, camera.elevation = np.degrees(azimuth) + ASIDE, DOWN
        camera.distance, camera.lookat = AWAY * size, place
        cameras.append(camera)
    return cameras


def _calm(x: np.ndarray, sigma: float, clip: Clip) -> np.ndarray:
    """`x [t, …]` smoothed over `sigma` seconds; beyond its ends it stays as it is."""
    return gaussian_filter1d(x, sigma / clip.dt, axis=0, mode="nearest")


def _gauge(clip: Clip, now: float) -> str:
    """Time, and the distance to the next waypoint."""
    at = np.array([now])
    apart = np.linalg.norm((clip.goal(at) - clip.place(at))[0, :2])
    return f"{now:.1f} s   {apart:.2f} m"


def _captioned(picture: np.ndarray, left: str, right: str) -> np.ndarray:
    image = Image.fromarray(picture)
    draw, edge = ImageDraw.Draw(image), image.height // 30
    font = ImageFont.load_default(size=image.height // 17)
    ink = (30, 34, 40)
    draw.text((edge, edge), left, ink, font)
    draw.text((image.width - edge, edge), right, ink, font, anchor="ra")
    return np.asarray(image)
