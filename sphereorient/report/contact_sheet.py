"""The picture of a movie: frames spread over it, with their numbers, times and faults."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sphereorient.movies import Movie
from sphereorient.movies.survey import Survey, SurveyedFrame

COLUMNS = 6
WIDTH, LINE, HEAD = 13.0, 0.27, 0.8  # inches: of the figure, of the line above a frame, of the title
FAULT_COLOUR = "#D55E00"  # Okabe and Ito's
BRIGHT_QUANTILE = 0.999  # of the pixels: shown white, so that a few glints do not darken all else


def contact_sheet(movie: Movie, seen: Survey, path: Path) -> None:
    """Draw frames of a movie side by side, all in one scale of grey.

    Args:
        movie: what was looked at.
        seen: of `survey`.
        path: of the PNG or PDF to write.
    """
    rows = math.ceil(len(seen.frames) / COLUMNS)
    height, width = movie.frame_shape
    row = (WIDTH / COLUMNS) * height / width + LINE
    figure = Figure(figsize=(WIDTH, HEAD + rows * row), layout="constrained")
    FigureCanvasAgg(figure)
    black, white = _scale(seen)
    figure.suptitle(
        f"{movie.path.name}: {len(movie)} frames of {width} x {height} px, {8 * movie.dtype.itemsize} bit\n"
        f"grey levels {black:.0f} (black) to {white:.0f} (white)",
        fontsize=11,
    )
    axes = np.ravel(figure.subplots(rows, COLUMNS, squeeze=False))
    for ax, frame in zip(axes, seen.frames, strict=False):
        _draw(ax, frame, movie, black, white)
    for ax in axes[len(seen.frames) :]:
        ax.set_axis_off()
    figure.savefig(path, dpi=110)


def _scale(seen: Survey) -> tuple[float, float]:
    """Return the grey levels that are shown black and white: those of the frames without fault, where there are any."""
    pictures = [frame.small for frame in seen.frames if frame.small is not None and not frame.fault]
    pictures = pictures or [frame.small for frame in seen.frames if frame.small is not None]
    if not pictures:
        return 0.0, 1.0
    values = np.concatenate([picture.ravel() for picture in pictures])
    black, white = float(values.min()), float(np.quantile(values, BRIGHT_QUANTILE))
    return black, max(white, black + 1)


def _draw(ax: Any, frame: SurveyedFrame, movie: Movie, black: float, white: float) -> None:
    height, width = movie.frame_shape
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)  # row 0 on top
    picture = np.zeros((1, 1)) if frame.small is None else frame.small
    ax.imshow(picture, cmap="gray", vmin=black, vmax=white, extent=edges, interpolation="nearest")
    ax.set(xticks=[], yticks=[], xlim=edges[:2], ylim=edges[2:])
    time = "" if movie.times_s is None else f", {_seconds(float(movie.times_s[frame.number]))}"
    ax.set_title(f"{frame.number}{time}", fontsize=8, pad=2)
    if frame.fault:
        ax.set_title(f"{frame.number}{time}: {frame.fault}", fontsize=8, pad=2, color=FAULT_COLOUR, fontweight="bold")
        for spine in ax.spines.values():
            spine.set(color=FAULT_COLOUR, linewidth=2)


def _seconds(time_s: float) -> str:
    return f"{time_s:.6g} s" if abs(time_s) >= 1 or not time_s else f"{1e3 * time_s:.5g} ms"
