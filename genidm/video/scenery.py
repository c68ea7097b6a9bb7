"""The scene of videos: a floor with squares of one metre, lights, and distinct colours."""

from __future__ import annotations

import mujoco
import numpy as np

SUN = (-0.4, 0.3, -1.0)
# Metres from the camera's focus to the sun, which moves with the focus and so do the shadows.
SUN_AWAY = 12.0
REACH_OF_SHADOWS = 20.0  # metres
RGBA = tuple[float, float, float, float]

# Colours of Okabe and Ito: vermilion, bluish green, blue.
TO_GO: RGBA = (0.835, 0.369, 0.0, 1.0)
REACHED: RGBA = (0.0, 0.62, 0.451, 1.0)
TRAIL: RGBA = (0.0, 0.447, 0.698, 1.0)
FLOOR = ((0.80, 0.82, 0.85), (0.72, 0.745, 0.78))
FLOOR_NAME = "genidm floor"


def scene(visual_model: mujoco.MjSpec, width: int, height: int) -> mujoco.MjModel:
    """Compiles a robot's visual model with the floor and the lights of videos.

    Args:
      visual_model: of the robot; its own planes, lights and skies are removed.
      width: pixels of the largest frame.
      height: pixels of the largest frame.
    """
    spec = visual_model.copy()
    # A model from a URDF discards geoms without collisions, such as this floor.
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
    # A smaller extent makes sharper shadows, but the floor beyond it shows noise.
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
    """Metres from the centre of a robot to its farthest part, in the pose `qpos [nq]`."""
    data = mujoco.MjData(model)
    data.qpos = qpos
    mujoco.mj_kinematics(model, data)
    parts = np.flatnonzero(model.geom_bodyid > 0)
    middle = data.geom_xpos[parts].mean(0)
    far = np.linalg.norm(data.geom_xpos[parts] - middle, axis=-1) + model.geom_rbound[parts]
    return float(far.max())
