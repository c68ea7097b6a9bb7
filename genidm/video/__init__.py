"""Films of a robot at work: gif, mp4, and a page that can be turned and played.

film = film_run(Path("runs/ant/LR-0-…"))
page(film)                       # in a notebook: shows itself
write(film, Path("ant.gif"))
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from genidm.errors import BadInput
from genidm.files import save_bytes, save_text
from genidm.video.backends import backend
from genidm.video.clip import encoder, gif, mp4
from genidm.video.filming import Film, Take, film, film_run, film_test, film_tested, recorded
from genidm.video.pages import Page, page
from genidm.video.shooting import Shot, frames

# An mp4 has room for what would make a gif large.
SHOTS = {".gif": Shot(), ".mp4": Shot(width=640, height=480, fps=25.0)}
PAGE = ".html"


def check(path: Path) -> None:
    """Raises BadInput where a film cannot be written to `path`: before it is made."""
    if path.suffix not in (*SHOTS, PAGE):
        raise BadInput(f"a film is a .gif, an .mp4 or a page (.html), not {path.name}")
    if path.suffix in SHOTS:
        backend()
    if path.suffix == ".mp4":
        encoder()


def write(made: Film, path: Path, quiet: bool = False, **changes: Any) -> None:
    """Writes a film, as its name's ending says.

    Args:
      made: the film.
      path: .gif, .mp4 or .html.
      quiet: no progress bar.
      changes: to the `Shot` of this kind of file: width, height, fps, hold, caption.

    Raises:
      BadInput: there is no such kind, nothing to draw or encode with, or the disk is full.
    """
    check(path)
    if path.suffix == PAGE:
        return save_text(path, page(made))
    shot = dataclasses.replace(SHOTS[path.suffix], **changes)
    pictures = list(frames(made, shot, quiet))
    return save_bytes(path, {".gif": gif, ".mp4": mp4}[path.suffix](pictures, shot.fps))


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
