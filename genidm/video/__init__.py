"""Films of a robot at work: gif, mp4, and a page that can be turned and played.

film = film_run("runs/ant/LR-0-…")
page(film)                       # in a notebook: shows itself
write(film, "ant.gif")
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from genidm.checks import check_value, number
from genidm.errors import BadInput
from genidm.files import check_writable, save_bytes, save_text
from genidm.video.backends import backend
from genidm.video.clip import FASTEST, encoder, gif, mp4
from genidm.video.filming import Film, Take, film, film_run, film_test, film_tested, recorded
from genidm.video.pages import Page, page
from genidm.video.shooting import Shot, frames

# An mp4 has room for what would make a gif large; a page is not shot.
SHOTS = {".gif": Shot(), ".mp4": Shot(width=640, height=480, fps=25.0), ".html": Shot()}


def check(path: Path | str, **changes: Any) -> Shot:
    """How a film that is written to `path` is shot; to be asked before the film is made.

    Args:
      path: .gif, .mp4 or .html.
      changes: to the `Shot` of this kind of file: width, height, fps, hold, caption.

    Raises:
      BadInput: there is no such kind, a change is out of range, the file cannot be written, or
        there is nothing to draw or encode with.
    """
    kind = Path(path).suffix
    if kind not in SHOTS:
        raise BadInput(f"a film is a .gif, an .mp4 or a page (.html), not {Path(path).name}")
    shot = dataclasses.replace(SHOTS[kind], **changes)
    check_writable(path)
    if kind == ".gif":
        check_value("fps of a gif", shot.fps, number(high=FASTEST))
    if kind == ".mp4":
        encoder()
    if kind != ".html":
        backend()
    return shot


def write(made: Film, path: Path | str, quiet: bool = False, **changes: Any) -> None:
    """Writes a film, as its name's ending says.

    Args:
      made: the film.
      path: .gif, .mp4 or .html.
      quiet: no progress bar.
      changes: as to `check`.

    Raises:
      BadInput: as `check` does, or the disk is full.
    """
    shot, kind = check(path, **changes), Path(path).suffix
    if kind == ".html":
        return save_text(path, page(made))
    encode = {".gif": gif, ".mp4": mp4}[kind]
    return save_bytes(path, encode(frames(made, shot, quiet), shot.fps))


__all__ = [
    "Film",
    "Page",
    "Shot",
    "Take",
    "check",
    "film",
    "film_run",
    "film_test",
    "film_tested",
    "frames",
    "page",
    "recorded",
    "write",
]
