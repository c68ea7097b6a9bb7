"""Encodes frames: gif with Pillow, mp4 with the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from genidm.errors import BadInput

FASTEST = 50.0  # frames per second of a gif; browsers slow down frames shorter than 0.02 s
# One palette for all frames, with few colours, keeps a gif small.
COLOURS = 64
SAMPLED = 24  # frames from which the palette is computed
RAW = "-v error -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -"
# Players need an even width and height.
H264 = "-c:v h264 -crf 25 -pix_fmt yuv420p -vf pad=ceil(iw/2)*2:ceil(ih/2)*2"


def gif(pictures: Iterable[np.ndarray], fps: float) -> bytes:
    """Encodes frames as a gif that repeats.

    Args:
      pictures: `[height, width, 3]` each, uint8.
      fps: frames per second; a gif rounds the time per frame to hundredths of a second.
    """
    pictures = list(pictures)
    palette = _palette(pictures)
    plain = [Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.NONE)
             for p in pictures]  # fmt: skip
    out = io.BytesIO()
    plain[0].save(
        out, "GIF", save_all=True, append_images=plain[1:], duration=10 * round(100 / fps),
        loop=0, optimize=False,
    )  # fmt: skip
    return out.getvalue()


def _palette(pictures: Sequence[np.ndarray]) -> Image.Image:
    """An image with the palette of a sample of the frames."""
    sample = pictures[:: -(-len(pictures) // SAMPLED)]
    # Median cut would leave no colour for objects as small as a target.
    return Image.fromarray(np.concatenate(sample)).quantize(COLOURS, Image.Quantize.FASTOCTREE)


def mp4(pictures: Iterable[np.ndarray], fps: float) -> bytes:
    """Encodes frames as H.264 in an mp4.

    Args:
      pictures: `[height, width, 3]` each, uint8; at least one. They are not kept in memory.
      fps: frames per second.

    Raises:
      BadInput: ffmpeg is missing or fails.
    """
    pictures = iter(pictures)
    first = next(pictures)
    raw = RAW.format(width=first.shape[1], height=first.shape[0], fps=fps)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        command = [encoder(), *raw.split(), *H264.split(), str(path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin
            with contextlib.suppress(BrokenPipeError):  # stderr, read below, has the reason
                for picture in itertools.chain([first], pictures):
                    ffmpeg.stdin.write(picture.tobytes())
            message = " ".join(ffmpeg.communicate()[1].decode(errors="replace").split())
        if ffmpeg.returncode:
            why = message or f"exit status {ffmpeg.returncode}"
            raise BadInput(f"ffmpeg cannot encode the mp4 in {folder}: {why}")
        return path.read_bytes()


def encoder() -> str:
    """Path of the ffmpeg of imageio-ffmpeg (extra `video`).

    Raises:
      BadInput: it is not installed.
    """
    try:
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise BadInput(
            'mp4 needs imageio-ffmpeg: pip install "genidm[video]" (.gif and .html do not need it)'
        ) from None
