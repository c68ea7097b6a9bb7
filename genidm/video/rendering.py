"""Renders the frames of a video with MuJoCo."""

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

# The camera: distance in robot sizes, elevation and azimuth in degrees (azimuth relative to the
# way to the goal), and the widths in seconds over which position and azimuth are smoothed.
AWAY = 3.7
DOWN = -27.0
ASIDE = 38.0
CALM_PLACE = 0.25
CALM_TURN = 0.7
# A waypoint's flag is a ball above the waypoint: radius and height, in robot sizes.
BALL = 0.13
HOVER = 0.65
# Metres: radius of the trail (a flag's pole has half of it), length of a piece of the trail.
LINE = 0.02
PIECE = 0.08
MOST_MARKS = 4000


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """Settings of the rendering.

    Attributes:
      width, height: pixels.
      fps: frames per second.
      hold: seconds for which the last frame of a clip is shown.
      caption: whether title, time and distance are written into the frames.
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
    """Renders all clips, one after another; yields frames `[height, width, 3]`, uint8.

    Raises:
      BadInput: no rendering backend works.
    """
    model = scene(video.visual_model, settings.width, settings.height)
    cues = [times(clip, settings) for clip in video.clips]
    with (
        Progress("frames", sum(map(len, cues)), "frames", quiet=quiet) as bar,
        renderer(model, settings.width, settings.height, MOST_MARKS + model.ngeom) as eye,
    ):
        for number, (clip, seconds) in enumerate(zip(video.clips, cues, strict=True), 1):
            words = f"{video.title}   {number} of {len(cues)}" if len(cues) > 1 else video.title
            for picture, now in zip(_clip(eye, video, clip, seconds), seconds, strict=True):
                yield _captioned(picture, words, _gauge(clip, now)) if settings.caption else picture
                bar.advance(1)


def times(clip: Clip, settings: RenderSettings) -> np.ndarray:
    """Seconds since the start of every frame `[n]`; the end repeats for `settings.hold` seconds."""
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
    """Adds the waypoints and the robot's trail to a scene.

    Args:
      scene: the scene.
      clip: the clip.
      left: `[W]` bool, whether each waypoint is not yet reached.
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
    """Adds a geom to a scene; if the scene is full, it replaces the last geom."""
    scene.ngeom = min(scene.ngeom + 1, scene.maxgeom)
    geom = scene.geoms[scene.ngeom - 1]
    upright = np.eye(3).reshape(-1)
    rgba = np.asarray(colour, np.float32)
    mujoco.mjv_initGeom(geom, kind, np.asarray(size), np.asarray(place), upright, rgba)
    return geom


def add_line(
    scene: mujoco.MjvScene, a: np.ndarray, b: np.ndarray, radius: float, colour: RGBA
) -> None:
    """Adds a line from a to b `[3]`, a capsule, to a scene."""
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    mujoco.mjv_connector(add(scene, kind, (radius,) * 3, a, colour), kind, radius, a, b)


def _clip(
    eye: mujoco.Renderer, video: Video, clip: Clip, seconds: np.ndarray
) -> Iterator[np.ndarray]:
    data, poses = mujoco.MjData(eye.model), clip.at(eye.model, seconds)
    metres = size(eye.model, poses[0])
    seen_by = cameras(clip, seconds, metres)
    for pose, left, now, camera in zip(poses, clip.left(seconds), seconds, seen_by, strict=True):
        data.qpos = pose
        mujoco.mj_forward(eye.model, data)
        data.light_xpos[:] = camera.lookat - SUN_AWAY * np.asarray(SUN)
        eye.update_scene(data, camera)
        mark(eye.scene, clip, left, now, video.goal_radius, metres)
        yield eye.render()


def _way(clip: Clip, now: float) -> np.ndarray:
    """Points `[n, 3]` of the trail on the floor up to the time `now`, about PIECE apart."""
    points = clip.position[clip.times <= now + 1e-6] * (1, 1, 0) + (0, 0, LINE)
    length = np.cumsum(np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1))
    return points[np.unique(length // PIECE, return_index=True)[1]]


def cameras(clip: Clip, seconds: np.ndarray, size: float) -> list[mujoco.MjvCamera]:
    """Cameras behind the robot and to its side, so that the goal is in the frame."""
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
    """`x [t, …]` smoothed with a Gaussian of `sigma` seconds; the end values are repeated."""
    return gaussian_filter1d(x, sigma / clip.dt, axis=0, mode="nearest")


def _gauge(clip: Clip, now: float) -> str:
    """Text with the time and the horizontal distance to the next waypoint."""
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
