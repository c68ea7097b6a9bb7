"""Films as files: gif by Pillow, mp4 by imageio-ffmpeg."""

from __future__ import annotations

import importlib
import io
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from genidm.errors import BadInput

# Of all pictures together: few colours, and the same ones, are what keeps a gif small.
COLOURS = 64
SAMPLED = 24


def gif(pictures: Sequence[np.ndarray], fps: float) -> bytes:
    """Pictures `[height, width, 3]` as a gif that plays again and again.

    Args:
      pictures: uint8.
      fps: pictures a second; a gif's times are whole hundredths of a second.
    """
    palette = _palette(pictures)
    plain = [Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.NONE)
             for p in pictures]  # fmt: skip
    out = io.BytesIO()
    plain[0].save(
        out, "GIF", save_all=True, append_images=plain[1:], duration=max(2, round(100 / fps)) * 10,
        loop=0, optimize=False,
    )  # fmt: skip
    return out.getvalue()


def _palette(pictures: Sequence[np.ndarray]) -> Image.Image:
    """The colours that some of the pictures are made of."""
    shown = pictures[:: -(-len(pictures) // SAMPLED)]
    # Not by median cut, which leaves no colour for what is as small as a target.
    return Image.fromarray(np.concatenate(shown)).quantize(COLOURS, Image.Quantize.FASTOCTREE)


def mp4(pictures: Sequence[np.ndarray], fps: float) -> bytes:
    """Pictures `[height, width, 3]` as H.264 in an mp4.

    Raises:
      BadInput: imageio-ffmpeg is not installed.
    """
    height, width = pictures[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = encoder().write_frames(str(path), (width, height), fps=fps, macro_block_size=2)
        with warnings.catch_warnings(category=RuntimeWarning, action="ignore"):
            writer.send(None)  # jax warns of forks, but here another program follows at once
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
        writer.close()
        return path.read_bytes()


def encoder() -> Any:
    """imageio_ffmpeg, of the extra `video`.

    Raises:
      BadInput: it is not installed.
    """
    try:
        return importlib.import_module("imageio_ffmpeg")
    except ImportError:
        raise BadInput(
            'mp4 needs imageio-ffmpeg: pip install "genidm[video]"; .gif and .html do not'
        ) from None
