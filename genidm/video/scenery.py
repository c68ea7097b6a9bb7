"""Where videos are made: a floor with squares of one metre, light, and colours that tell apart."""

from __future__ import annotations

import mujoco
import numpy as np

SUN = (-0.4, 0.3, -1.0)
# Metres from what the camera looks at to the sun: it goes along, and the shadows with it.
SUN_AWAY = 12.0
REACH_OF_SHADOWS = 20.0  # metres
RGBA = tuple[float, float, float, float]

# Okabe and Ito's: vermilion, bluish green, blue.
TO_GO: RGBA = (0.835, 0.369, 0.0, 1.0)
REACHED: RGBA = (0.0, 0.62, 0.451, 1.0)
TRAIL: RGBA = (0.0, 0.447, 0.698, 1.0)
FLOOR = ((0.80, 0.82, 0.85), (0.72, 0.745, 0.78))
FLOOR_NAME = "genidm floor"


def scene(visual_model: mujoco.MjSpec, width: int, height: int) -> mujoco.MjModel:
    """A robot's visual model on the video's floor, in its light.

    Args:
      visual_model: of the robot; its own floor and lights are left out.
      width: pixels of the greatest picture.
      height: pixels.
    """
    spec = visual_model.copy()
    # Else the floor, which nothing collides with, would be left out of what comes from a URDF.
    spec.compiler.discardvisual = False
    planes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
    skies = [t for t in spec.textures if t.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX]
    for part in (*planes, *spec.lights, *skies):
        spec.delete(part)
    _floor(spec)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=SUN, ambient=(0, 0, 0),
        diffuse=(0.6, 0.6, 0.6), specular=(0.2, 0.2, 0.2), castshadow=True,
    )  # fmt: skip
    spec.visual.headlight.ambient = (0.4, 0.4, 0.4)
    spec.visual.headlight.diffuse = (0.35, 0.35, 0.35)
    spec.visual.headlight.specular = (0, 0, 0)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    # Shadows are as sharp as this is small, but there is noise on the floor that lies farther.
    spec.stat.extent = REACH_OF_SHADOWS
    return spec.compile()


def _floor(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name=FLOOR_NAME, type=mujoco.mjtTexture.mjTEXTURE_2D, width=256, height=256,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER, rgb1=FLOOR[0], rgb2=FLOOR[1],
    )  # fmt: skip
    floor = spec.add_material(name=FLOOR_NAME, texuniform=True, texrepeat=(0.5, 0.5))
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR_NAME
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(
        name=FLOOR_NAME, type=plane, size=(0, 0, 1), material=FLOOR_NAME, rgba=(1, 1, 1, 1),
        contype=0, conaffinity=0,
    )  # fmt: skip


def size(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Metres from the middle of a robot to its farthest part, in the pose `qpos [nq]`."""
    data = mujoco.MjData(model)
    data.qpos = qpos
    mujoco.mj_kinematics(model, data)
    parts = np.flatnonzero(model.geom_bodyid > 0)
    middle = data.geom_xpos[parts].mean(0)
    far = np.linalg.norm(data.geom_xpos[parts] - middle, axis=-1) + model.geom_rbound[parts]
    return float(far.max())
