"""The look of figures: styles of methods, axes, legends, and atomic writing of PNGs.

A method has the same colour, marker, line and hatch in every figure (`STYLES`). The colours are
Okabe and Ito's, which colour-blind readers can distinguish; markers, lines and hatches remain
distinct in grey print. Nothing here uses pyplot or its global state.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

Array = np.ndarray
Target = str | os.PathLike[str]

DPI = 150


@dataclasses.dataclass(frozen=True)
class Style:
    """The look of a method in figures.

    Attributes:
      colour: hexadecimal RGB.
      marker, line, hatch: Matplotlib's codes.
    """

    colour: str
    marker: str
    line: Any
    hatch: str


_DASHES = (0, (6, 1.5, 1.5, 1.5))
STYLES = {
    "RS": Style("#8C8C8C", "x", ":", ""),
    "RL": Style("#E69F00", "s", "--", "//"),
    "VGCP": Style("#56B4E9", "v", "-.", "\\\\"),
    "HER_SP": Style("#F0E442", "<", _DASHES, "--"),
    "HER_DE": Style("#CC79A7", ">", (0, (1, 1)), "||"),
    "GE": Style("#009E73", "^", "-.", "xx"),
    "LR": Style("#0072B2", "o", "-", ".."),
    "HF": Style("#D55E00", "D", (0, (5, 1)), "++"),
}
"""Method → its style in every figure."""

_SPARE = (
    Style("#0072B2", "o", "-", ""),
    Style("#D55E00", "s", "--", "//"),
    Style("#009E73", "^", "-.", "xx"),
    Style("#CC79A7", "v", _DASHES, "\\\\"),
    Style("#56B4E9", "P", (0, (5, 1)), "++"),
    Style("#E69F00", "X", (0, (1, 1)), "||"),
    Style("#882255", "D", ":", "oo"),
)


def styles(names: Iterable[str]) -> dict[str, Style]:
    """A style for each name: `STYLES`, or for other names a style that is still free."""
    names = list(names)
    taken = {STYLES[n].colour for n in names if n in STYLES}
    free = [s for s in _SPARE if s.colour not in taken] or list(_SPARE)
    spare = itertools.cycle(free)
    return {name: STYLES[name] if name in STYLES else next(spare) for name in names}


def write(fig: Figure, path: Target) -> Figure:
    """Writes a PNG beside `path` and renames it, so that no reader sees an incomplete file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        # Matplotlib's version in the file would make equal figures differ.
        fig.savefig(part, dpi=DPI, format="png", metadata={"Software": None})
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return fig


def style_axes(ax: Axes, xlabel: str, ylabel: str) -> None:
    """Sets labels and removes most decoration."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=10)
    ax.grid(axis="y", color="0.9", linewidth=0.8)
    ax.set_axisbelow(True)
    if xlabel:
        ax.set_xlabel(xlabel, fontsize=11)
    if ylabel:
        ax.set_ylabel(ylabel, fontsize=11)


def line(ax: Axes, x: Array, y: Array, style: Style) -> None:
    """Draws a method's line with a few markers."""
    every = max(1, len(x) // 8)
    ax.plot(x, y, **strokes(style), linewidth=1.8, markevery=every, markersize=5)


def strokes(style: Style) -> dict[str, Any]:
    """A method's colour, line and marker, as keyword arguments for Matplotlib."""
    drawn = {"color": style.colour, "linestyle": style.line, "marker": style.marker}
    # Yellow is hard to see on white without an edge.
    edge = [withStroke(linewidth=2.4, foreground="0.35")]
    return drawn | {"path_effects": edge} if _light(style.colour) else drawn


def _light(colour: str) -> bool:
    """Whether a colour is almost white, by its relative luminance."""
    linear = np.asarray(to_rgb(colour)) ** 2.2
    return bool(linear @ [0.2126, 0.7152, 0.0722] > 0.6)


def line_key(fig: Figure, looks: Mapping[str, Style], extra: Sequence[Line2D] = ()) -> None:
    """Adds a legend of the methods' lines and of `extra` handles."""
    lines = [Line2D([], [], label=name, **strokes(s)) for name, s in looks.items()]
    key(fig, [*lines, *extra])


def key(fig: Figure, handles: Sequence[Line2D], edge: str = "upper") -> None:
    """Adds a legend above or below the axes, in as many columns as fit."""
    if not handles:
        return
    # Inches at font size 9: 0.73 for a handle with its gaps, 0.07 for a letter.
    widths = [0.73 + 0.07 * len(str(h.get_label())) for h in handles]
    fitting = max(1, int(fig.get_figwidth() / max(widths)))
    columns = len(handles) if sum(widths) < fig.get_figwidth() else min(len(handles), fitting)
    place: Any = f"outside {edge} center"
    fig.legend(handles=handles, loc=place, ncols=columns, fontsize=9, handlelength=3)
