"""Imports MJX without its word on a backend that genidm does not use.

MJX 3.17 prints two lines on stdout wherever `warp` is not installed; anything else that it
may have to say is kept, on stderr.
"""

import contextlib
import io
import sys
from types import ModuleType


def _import_mjx() -> ModuleType:
    """Imports `mujoco.mjx`; the first import in a process is the one that prints."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            from mujoco import mjx
        return mjx
    finally:
        for line in said.getvalue().splitlines():
            if not line.endswith("No module named 'warp'"):
                print(line, file=sys.stderr)


mjx = _import_mjx()
