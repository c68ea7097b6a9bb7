"""Videos as files: gif by Pillow, mp4 by the ffmpeg that comes with imageio-ffmpeg."""

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

FASTEST = 50.0  # pictures a second of a gif: browsers slow down what is shown for less than 0.02 s
# Of all pictures together: few colours, and the same ones, are what keeps a gif small.
COLOURS = 64
SAMPLED = 24
RAW = "-v error -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -"
# Players take whole pairs of pixels alone.
H264 = "-c:v h264 -crf 25 -pix_fmt yuv420p -vf pad=ceil(iw/2)*2:ceil(ih/2)*2"


def gif(pictures: Iterable[np.ndarray], fps: float) -> bytes:
    """Pictures `[height, width, 3]` as a gif that plays again and again.

    Args:
      pictures: uint8.
      fps: pictures a second; a gif's times are whole hundredths of a second.
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
    """The colours that some of the pictures are made of."""
    shown = pictures[:: -(-len(pictures) // SAMPLED)]
    # Not by median cut, which leaves no colour for what is as small as a target.
    return Image.fromarray(np.concatenate(shown)).quantize(COLOURS, Image.Quantize.FASTOCTREE)


def mp4(pictures: Iterable[np.ndarray], fps: float) -> bytes:
    """Pictures `[height, width, 3]` as H.264 in an mp4.

    Args:
      pictures: uint8; each is encoded as it comes.
      fps: pictures a second.

    Raises:
      BadInput: there is no ffmpeg, or it cannot encode them.
    """
    pictures = iter(pictures)
    first = next(pictures)
    raw = RAW.format(width=first.shape[1], height=first.shape[0], fps=fps)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        command = [encoder(), *raw.split(), *H264.split(), str(path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin
            with contextlib.suppress(BrokenPipeError):  # it says why at its end
                for picture in itertools.chain([first], pictures):
                    ffmpeg.stdin.write(picture.tobytes())
            said = " ".join(ffmpeg.communicate()[1].decode(errors="replace").split())
        if ffmpeg.returncode:
            why = said or f"exit status {ffmpeg.returncode}"
            raise BadInput(f"ffmpeg cannot encode the mp4 in {folder}: {why}")
        return path.read_bytes()


def encoder() -> str:
    """The ffmpeg of imageio-ffmpeg, of the extra `video`.

    Raises:
      BadInput: there is none.
    """
    try:
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise BadInput(
            'mp4 needs imageio-ffmpeg: pip install "genidm[video]"; .gif and .html do not'
        ) from None
