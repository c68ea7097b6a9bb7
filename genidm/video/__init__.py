"""Videos of a controlled robot: gif, mp4, and an interactive page.

video = render_run("runs/ant/LR-0-…")
page(video)                       # in a notebook: shows itself
write(video, "ant.gif")
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from genidm.checks import check_value, number
from genidm.errors import BadInput
from genidm.files import check_writable, save_bytes, save_text
from genidm.video.backends import backend
from genidm.video.clips import (
    POSES,
    Clip,
    Video,
    recorded,
    render,
    render_recorded,
    render_run,
    render_test,
    render_walked,
)
from genidm.video.encoding import FASTEST, encoder, gif, mp4
from genidm.video.pages import Page, page
from genidm.video.rendering import RenderSettings, frames

# An mp4 stays small at sizes at which a gif is large. A page ignores these settings.
SETTINGS = {
    ".gif": RenderSettings(),
    ".mp4": RenderSettings(width=640, height=480, fps=25.0),
    ".html": RenderSettings(),
}


def check(path: Path | str, **changes: Any) -> RenderSettings:
    """Checks that a video can be written to `path`; returns the settings of its rendering.

    Call it before the video is computed, so that errors are found early.

    Args:
      path: .gif, .mp4 or .html.
      changes: to the `RenderSettings` of this file type: width, height, fps, hold, caption.

    Raises:
      BadInput: the file type is unknown, a change is out of range, the file cannot be written, or
        a renderer or an encoder is missing.
    """
    kind = Path(path).suffix
    if kind not in SETTINGS:
        raise BadInput(f"a video must be a .gif, .mp4 or .html file, not {Path(path).name}")
    settings = dataclasses.replace(SETTINGS[kind], **changes)
    check_writable(path)
    if kind == ".gif":
        check_value("fps of a gif", settings.fps, number(high=FASTEST))
    if kind == ".mp4":
        encoder()
    if kind != ".html":
        backend()
    return settings


def write(made: Video, path: Path | str, quiet: bool = False, **changes: Any) -> None:
    """Writes a video to a file; the suffix of its name chooses the format.

    Args:
      made: the video.
      path: .gif, .mp4 or .html.
      quiet: no progress bar.
      changes: as for `check`.

    Raises:
      BadInput: as for `check`, or the disk is full.
    """
    settings, kind = check(path, **changes), Path(path).suffix
    if kind == ".html":
        return save_text(path, page(made))
    encode = {".gif": gif, ".mp4": mp4}[kind]
    return save_bytes(path, encode(frames(made, settings, quiet), settings.fps))


__all__ = [
    "POSES",
    "Clip",
    "Page",
    "RenderSettings",
    "Video",
    "check",
    "frames",
    "page",
    "recorded",
    "render",
    "render_recorded",
    "render_run",
    "render_test",
    "render_walked",
    "write",
]
