"""Imports MJX without its messages about a backend that genidm does not use.

MJX 3.17 prints two lines on stdout where `warp` is not installed. These are dropped; anything
else that the import prints goes to stderr.
"""

import contextlib
import io
import sys
from types import ModuleType


def _import_mjx() -> ModuleType:
    """Imports `mujoco.mjx`; only the first import in a process prints."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            from mujoco import mjx
        return mjx
    finally:
        for line in printed.getvalue().splitlines():
            if not line.endswith("No module named 'warp'"):
                print(line, file=sys.stderr)


mjx = _import_mjx()
