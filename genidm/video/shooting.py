"""Pictures of a film, by MuJoCo's renderer."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from genidm.checks import check, count, number, positive
from genidm.progress import Progress
from genidm.video import backends
from genidm.video.filming import Film, Take
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
class Shot:
    """How a film is shot.

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
        check(self, width=size, height=size, fps=positive(1000), hold=number(0, 3600))


def frames(film: Film, shot: Shot, quiet: bool = False) -> Iterator[np.ndarray]:
    """The pictures `[height, width, 3]` of every take, one after another, as uint8.

    Raises:
      BadInput: there is nothing to draw with.
    """
    model = scene(film.drawing, shot.width, shot.height)
    cues = [times(take, shot) for take in film.takes]
    with (
        Progress("pictures", sum(map(len, cues)), "pictures", quiet=quiet) as bar,
        Eye(model, shot.width, shot.height) as eye,
    ):
        for number, (take, seconds) in enumerate(zip(film.takes, cues, strict=True), 1):
            words = f"{film.title}   {number} of {len(cues)}" if len(cues) > 1 else film.title
            for picture, now in zip(_take(eye, film, take, seconds), seconds, strict=True):
                yield _captioned(picture, words, _gauge(take, now)) if shot.caption else picture
                bar.advance(1)


def times(take: Take, shot: Shot) -> np.ndarray:
    """Seconds since the start that are shown, the end for a while."""
    moving = np.arange(0, take.seconds, 1 / shot.fps)
    return np.append(moving, [take.seconds] * (1 + round(shot.hold * shot.fps)))


class Eye:
    """A context manager that draws what a camera sees.

    Args:
      model: what is drawn.
      width, height: pixels.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        self.model, self.data = model, mujoco.MjData(model)
        self._context = backends.context(width, height)
        self._context.make_current()
        self._pixels = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._pixels)
        self._scene = mujoco.MjvScene(model, MOST_MARKS + model.ngeom)
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def __enter__(self) -> Eye:
        return self

    def __exit__(self, *error: object) -> None:
        # By hand: OSMesa's own clean-up fails, and says so, once the interpreter is going down.
        self._pixels.free()
        self._context.free()

    def pose(self, qpos: np.ndarray) -> None:
        """Puts the robot into a pose `[nq]`."""
        self.data.qpos = qpos
        mujoco.mj_forward(self.model, self.data)

    def look(self, camera: mujoco.MjvCamera, marks: Marks) -> np.ndarray:
        """The picture `[height, width, 3]` of the robot and of marks."""
        self.data.light_xpos[:] = camera.lookat - SUN_AWAY * np.asarray(SUN)
        everything, options = mujoco.mjtCatBit.mjCAT_ALL, mujoco.MjvOption()
        mujoco.mjv_updateScene(
            self.model, self.data, options, None, camera, everything, self._scene
        )
        marks(self._scene)
        self._context.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._pixels)
        picture = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._rect, self._pixels)
        return picture[::-1]


@dataclasses.dataclass(frozen=True)
class Marks:
    """What is drawn beside the robot: its waypoints, and its way so far.

    Attributes:
      waypoints: `[W, 3]`, metres.
      left: `[W]` bool, which of them are not reached yet.
      way: `[n, 3]`, metres.
      reach: metres.
      size: of the robot, metres.
    """

    waypoints: np.ndarray
    left: np.ndarray
    way: np.ndarray
    reach: float
    size: float

    def __call__(self, scene: mujoco.MjvScene) -> None:
        """Adds them to a scene."""
        kinds = mujoco.mjtGeom
        for point, left in zip(self.waypoints, self.left, strict=True):
            colour = TO_GO if left else REACHED
            foot, top = point.copy(), point.copy()
            foot[2], top[2] = 0.0, point[2] + HOVER * self.size
            add(scene, kinds.mjGEOM_SPHERE, (BALL * self.size,) * 3, top, colour)
            add(scene, kinds.mjGEOM_CYLINDER, (self.reach, 0.004, 0.0), foot, (*colour[:3], 0.4))
            add_line(scene, foot, top, LINE / 2, colour)
        floored = np.c_[self.way[:, :2], np.full(len(self.way), LINE)]
        for a, b in itertools.pairwise(floored):
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


def _take(eye: Eye, film: Film, take: Take, seconds: np.ndarray) -> Iterator[np.ndarray]:
    poses = take.at(eye.model, seconds)
    eye.pose(poses[0])
    metres = size(eye.model, eye.data)
    cameras = _cameras(take, seconds, metres)
    for pose, left, now, camera in zip(poses, take.left(seconds), seconds, cameras, strict=True):
        eye.pose(pose)
        yield eye.look(camera, Marks(take.waypoints, left, _way(take, now), film.reach, metres))


def _way(take: Take, now: float) -> np.ndarray:
    """The way up to a time `[n, 3]`, in pieces of a length that can be seen."""
    made = take.position[take.times <= now + 1e-6]
    length = np.cumsum(np.linalg.norm(np.diff(made[:, :2], axis=0, prepend=made[:1, :2]), axis=1))
    return made[np.unique(length // PIECE, return_index=True)[1]]


def _cameras(take: Take, seconds: np.ndarray, size: float) -> list[mujoco.MjvCamera]:
    """Behind the robot and to its side, so that where it goes is in the picture."""
    t = take.times
    ahead = take.goal(t)[:, :2] - take.position[:, :2]
    turn = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    place = _calm(take.position, CALM_PLACE / take.control_step)
    turn = _calm(turn[:, None], CALM_TURN / take.control_step)[:, 0]
    cameras = []
    for now in seconds:
        camera = mujoco.MjvCamera()
        camera.azimuth = np.degrees(np.interp(now, t, turn)) + ASIDE
        camera.elevation, camera.distance = DOWN, AWAY * size
        camera.lookat = [np.interp(now, t, axis) for axis in place.T]
        cameras.append(camera)
    return cameras


def _calm(x: np.ndarray, sigma: float) -> np.ndarray:
    """`x [t, n]` smoothed by a Gaussian of `sigma` steps; beyond its ends it stays as it is."""
    reach = max(1, int(3 * sigma))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(x, ((reach, reach), (0, 0)), mode="edge")
    columns = [np.convolve(column, weights / weights.sum(), "valid") for column in padded.T]
    return np.stack(columns, axis=-1)


def _gauge(take: Take, now: float) -> str:
    """Time, and the distance to the next waypoint."""
    o = [np.interp(now, take.times, axis) for axis in take.position[:, :2].T]
    apart = np.linalg.norm(take.goal(np.array([now]))[0, :2] - o)
    return f"{now:.1f} s   {apart:.2f} m"


def _captioned(picture: np.ndarray, left: str, right: str) -> np.ndarray:
    image = Image.fromarray(picture)
    draw, edge = ImageDraw.Draw(image), image.height // 30
    font = ImageFont.load_default(size=image.height // 17)
    ink = (30, 34, 40)
    draw.text((edge, edge), left, ink, font)
    draw.text((image.width - edge, edge), right, ink, font, anchor="ra")
    return np.asarray(image)
