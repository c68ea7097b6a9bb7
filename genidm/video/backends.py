"""Chooses MuJoCo's rendering backend: EGL (GPU) or OSMesa (software), as available.

PyOpenGL cannot change its backend within a process. So each backend is tried in a separate
process, and this process imports only one that works.
"""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from pathlib import Path

import mujoco
from mujoco.rendering.classic import gl_context

from genidm.errors import BadInput

# Backends of Windows and macOS; values of MUJOCO_GL; values that disable rendering; GPU devices.
OWN = {"win32": "glfw", "darwin": "cgl"}
NAMED = ("egl", "osmesa", "glfw", "cgl")
OFF = ("disable", "disabled", "off", "false", "0")
GPU = ("nvidia[0-9]*", "dri/renderD*")

_TRIAL = "import mujoco; mujoco.Renderer(mujoco.MjSpec().compile(), 8, 8).close()"
# Seconds for a trial: a busy machine needs long to compile Mesa's shaders.
PATIENCE = 120.0


def renderer(model: mujoco.MjModel, width: int, height: int, most: int) -> mujoco.Renderer:
    """MuJoCo's renderer, a context manager.

    Args:
      model: the model to render.
      width: pixels.
      height: pixels.
      most: largest number of geoms in a frame.

    Raises:
      BadInput: no backend works.
    """
    # At its import MuJoCo chooses by MUJOCO_GL alone; without it, it needs a window system.
    gl_context.GLContext = importlib.import_module(f"mujoco.{backend()}").GLContext
    return mujoco.Renderer(model, height, width, most)


@functools.cache
def backend() -> str:
    """Finds the rendering backend that works: the user's `MUJOCO_GL`, else EGL or OSMesa.

    Raises:
      BadInput: no backend works.
    """
    tried = candidates()
    for name in tried:
        if starts(name):
            return name
    why = f"{' and '.join(tried)} failed" if tried else "MUJOCO_GL turns it off"
    raise BadInput(
        f"MuJoCo cannot render here: {why}. Install libosmesa6 (software) or libegl1 (with a GPU "
        "driver), or write the interactive page (.html), which needs no renderer"
    )


def candidates() -> tuple[str, ...]:
    """Backends to try, in order."""
    given = os.environ.get("MUJOCO_GL", "").lower().strip()
    if given in NAMED:
        return (given,)
    if given in OFF:
        return ()
    if sys.platform in OWN:
        return (OWN[sys.platform],)
    gpu = any(True for pattern in GPU for _ in Path("/dev").glob(pattern))
    return ("egl", "osmesa") if gpu else ("osmesa", "egl")


def starts(name: str) -> bool:
    """Whether a backend renders a frame in a separate process."""
    command, chosen = [sys.executable, "-c", _TRIAL], {**os.environ, "MUJOCO_GL": name}
    try:
        trial = subprocess.run(command, env=chosen, capture_output=True, timeout=PATIENCE)
        return trial.returncode == 0
    except subprocess.TimeoutExpired:
        return False
