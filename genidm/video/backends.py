"""What MuJoCo draws with: EGL on a GPU, OSMesa in software, as the machine has it.

PyOpenGL binds itself to one of them for the life of a process, so each is tried in a process
of its own, and only the one that starts is imported here.
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

# Windows' and macOS' own, and what the user may name in MUJOCO_GL.
OWN = {"win32": "glfw", "darwin": "cgl"}
NAMED = ("egl", "osmesa", "glfw", "cgl")
OFF = ("disable", "disabled", "off", "false", "0")
GPU = ("nvidia[0-9]*", "dri/renderD*")

_TRIAL = "import mujoco; mujoco.Renderer(mujoco.MjSpec().compile(), 8, 8).close()"
# A machine that is busy compiles Mesa's shaders for a while.
PATIENCE = 120.0


def renderer(model: mujoco.MjModel, width: int, height: int, most: int) -> mujoco.Renderer:
    """MuJoCo's renderer, a context manager, for pictures of a size and so many things in them.

    Raises:
      BadInput: there is nothing to draw with.
    """
    # MuJoCo chooses when it is imported, by MUJOCO_GL alone, and by none takes a window's.
    gl_context.GLContext = importlib.import_module(f"mujoco.{backend()}").GLContext
    return mujoco.Renderer(model, height, width, most)


@functools.cache
def backend() -> str:
    """The backend that starts: the user's `MUJOCO_GL`; else EGL or OSMesa.

    Raises:
      BadInput: none does.
    """
    tried = candidates()
    for name in tried:
        if starts(name):
            return name
    what = f"neither {' nor '.join(tried)} starts" if tried else "MUJOCO_GL turns it off"
    raise BadInput(
        f"no picture can be drawn here: {what}. In software: apt-get install libosmesa6; with a "
        "GPU's driver: apt-get install libegl1. The interactive page (.html) needs none of it"
    )


def candidates() -> tuple[str, ...]:
    """What to try, in order."""
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
    """Whether a backend draws, in a process of its own."""
    command, chosen = [sys.executable, "-c", _TRIAL], {**os.environ, "MUJOCO_GL": name}
    try:
        trial = subprocess.run(command, env=chosen, capture_output=True, timeout=PATIENCE)
        return trial.returncode == 0
    except subprocess.TimeoutExpired:
        return False
