"""A video as one HTML page: the robot's geoms, its poses as numbers, and a viewer.

The page is self-contained: it needs no network, no GPU, and no other file.
"""

from __future__ import annotations

import html
import importlib.resources
import json
from typing import Any

import mujoco
import numpy as np

from genidm.video.clips import Clip, Video
from genidm.video.scenery import size

FPS = 20.0
# Scales of the whole numbers in the page: metres in thousandths, quaternions in ten thousandths.
PLACE, TURN = 1e3, 1e4
HEIGHT = 460  # pixels, in a notebook

KINDS = {"sphere", "capsule", "box", "cylinder", "ellipsoid"}  # geom types that the viewer draws


class Page(str):
    """An HTML page; a notebook shows it in an iframe."""

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self)}" sandbox="allow-scripts" title="a video" '
            f'style="width: 100%; height: {HEIGHT}px; border: 0; border-radius: 8px"></iframe>'
        )


def page(video: Video) -> Page:
    """Makes an interactive HTML page of a video: rotate, zoom, play."""
    viewer = importlib.resources.files("genidm.video").joinpath("viewer.html").read_text("utf-8")
    data = json.dumps(contents(video), separators=(",", ":"), allow_nan=False)
    # "</script" would end the script even inside a JSON string, so every "<" is escaped.
    return Page(viewer.replace("FILM", data.replace("<", "\\u003c"), 1))


def contents(video: Video) -> dict[str, Any]:
    """The data of the page, for viewer.html.

    `fps` frames per second, `size` of the robot (m), the goal radius `reach` (m), the robot's
    `geoms`, each in the frame of its body, and the clips `takes`. A clip's `frames` are rows of
    whole numbers: the base's x, y, z (mm), then for each body x, y, z (mm) and quaternion (1e-4).
    """
    model, start = video.visual_model.compile(), video.clips[0].qpos[0]
    shown = _shown(model)
    bodies = sorted({int(model.geom_bodyid[i]) for i in shown})
    return {
        "title": video.title,
        "fps": FPS,
        "reach": video.goal_radius,
        "size": round(size(model, start), 3),
        "geoms": [_geom(model, i, colour, bodies) for i, colour in shown.items()],
        "takes": [_clip(model, bodies, clip) for clip in video.clips],
    }


def _shown(model: mujoco.MjModel) -> dict[int, np.ndarray]:
    """The geoms that MuJoCo draws, without planes: id → colour `[4]`, 0 to 1."""
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, maxgeom=10_000)
    mujoco.mj_forward(model, data)
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene
    )
    drawn = (g for g in scene.geoms[: scene.ngeom] if g.objtype == mujoco.mjtObj.mjOBJ_GEOM)
    return {g.objid: g.rgba.copy() for g in drawn if g.type != mujoco.mjtGeom.mjGEOM_PLANE}


def _geom(
    model: mujoco.MjModel, geom: int, colour: np.ndarray, bodies: list[int]
) -> dict[str, Any]:
    """One geom; a type that the viewer cannot draw (a mesh) becomes its bounding box."""
    kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    known = kind in KINDS
    place, turn = model.geom_pos[geom], model.geom_quat[geom]
    middle, half = model.geom_aabb[geom].reshape(2, 3)
    if not known:
        offset = np.zeros(3)
        mujoco.mju_rotVecQuat(offset, middle, turn)
        place = place + offset
    return {
        "kind": kind if known else "box",
        "body": bodies.index(int(model.geom_bodyid[geom])),
        "size": np.round(model.geom_size[geom] if known else half, 4).tolist(),
        "place": np.round(place, 4).tolist(),
        "turn": np.round(turn, 5).tolist(),
        "colour": np.round(255 * colour[:3]).astype(int).tolist(),
    }


def _clip(model: mujoco.MjModel, bodies: list[int], clip: Clip) -> dict[str, Any]:
    data = mujoco.MjData(model)
    seconds = np.minimum(np.arange(np.ceil(clip.seconds * FPS - 1e-6) + 1) / FPS, clip.seconds)
    rows = []
    for middle, pose in zip(clip.place(seconds), clip.at(model, seconds), strict=True):
        data.qpos = pose
        mujoco.mj_kinematics(model, data)
        placed = np.c_[PLACE * data.xpos[bodies], TURN * data.xquat[bodies]]
        rows.append(np.round([*(PLACE * middle), *placed.reshape(-1)]).astype(int).tolist())
    return {
        "seconds": round(clip.seconds, 4),
        "outcome": outcome(clip),
        "waypoints": np.round(clip.waypoints, 3).tolist(),
        "arrivals": [round(t, 3) if np.isfinite(t) else None for t in clip.arrivals.tolist()],
        "frames": rows,
    }


def outcome(clip: Clip) -> str:
    """The outcome of a clip in a few words, as the page shows it."""
    reached, count = int((clip.arrival >= 0).sum()), len(clip.arrival)
    if reached == count:
        return f"arrived after {clip.seconds:.1f} s"
    way = f"{reached} of {count}, " if count > 1 else ""
    return f"{way}fell after {clip.seconds:.1f} s" if clip.fell else f"{way}{clip.seconds:.1f} s"
