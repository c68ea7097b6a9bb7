"""What MuJoCo draws with: EGL on a GPU, OSMesa in software, as the machine has it.

PyOpenGL binds itself to one of them for the life of a process, so each is tried in a process
of its own, and only the one that starts is imported here. `mujoco.Renderer` is not used: it
is bound when mujoco is imported, long before anybody asks for a picture.
"""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from genidm.errors import BadInput

# Windows' and macOS' own, and what the user may name in MUJOCO_GL.
OWN = {"win32": "glfw", "darwin": "cgl"}
NAMED = ("egl", "osmesa", "glfw", "cgl")
OFF = ("disable", "disabled", "off", "false", "0")
GPU = ("nvidia[0-9]*", "dri/renderD*")

_TRIAL = """
import importlib, mujoco, sys
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjSpec().compile(), 100).free()
context.free()
"""
# A machine that is busy compiles Mesa's shaders for a while.
PATIENCE = 120.0


def context(width: int, height: int) -> Any:
    """A GL context to draw pictures of up to this size in; `free` it.

    Raises:
      BadInput: there is nothing to draw with.
    """
    return importlib.import_module(f"mujoco.{backend()}").GLContext(width, height)


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
    command = [sys.executable, "-c", _TRIAL, name]
    try:
        return not subprocess.run(command, capture_output=True, timeout=PATIENCE).returncode
    except subprocess.TimeoutExpired:
        return False
