"""The contact sheet of a movie: frames spread over it, with their numbers, times and faults."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from sphereorient.movies import Movie
from sphereorient.movies.survey import Survey, SurveyedFrame
from sphereorient.report.plots.style import AXIS_COLOURS, in_style, new_figure, write_figure

COLUMNS = 6
WIDTH, LINE, HEAD = 13.0, 0.27, 0.8  # inches: of the figure, of the line above a frame, of the title
FAULT_COLOUR = AXIS_COLOURS[0]
BRIGHT_QUANTILE = 0.999  # of the pixels: shown white, so that a few glints do not darken the rest


@in_style
def contact_sheet(movie: Movie, seen: Survey, path: Path) -> None:
    """Draw the frames of a survey of a movie side by side, on one scale of grey, into a PNG or PDF."""
    rows = math.ceil(len(seen.frames) / COLUMNS)
    height, width = movie.frame_shape
    figure = new_figure(WIDTH, HEAD + rows * ((WIDTH / COLUMNS) * height / width + LINE))
    pictures = [frame.small for frame in seen.frames if frame.small is not None and not frame.fault]
    pictures = pictures or [frame.small for frame in seen.frames if frame.small is not None]
    values = np.concatenate([picture.ravel() for picture in pictures]) if pictures else np.array([0.0])
    black = float(values.min())
    white = max(float(np.quantile(values, BRIGHT_QUANTILE)), black + 1)
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
    write_figure(figure, path, dpi=110)


def _draw(ax: Any, frame: SurveyedFrame, movie: Movie, black: float, white: float) -> None:
    height, width = movie.frame_shape
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)  # row 0 on top
    picture = np.zeros((1, 1)) if frame.small is None else frame.small
    ax.imshow(picture, cmap="gray", vmin=black, vmax=white, extent=edges, interpolation="nearest")
    ax.set(xticks=[], yticks=[], xlim=edges[:2], ylim=edges[2:])
    title = f"{frame.number}"
    if movie.times_s is not None:
        time_s = float(movie.times_s[frame.number])
        title += f", {time_s:.6g} s" if abs(time_s) >= 1 or not time_s else f", {1e3 * time_s:.5g} ms"
    ax.set_title(title, fontsize=8, pad=2)
    if frame.fault:
        ax.set_title(f"{title}: {frame.fault}", fontsize=8, pad=2, color=FAULT_COLOUR, fontweight="bold")
        for spine in ax.spines.values():
            spine.set(color=FAULT_COLOUR, linewidth=2)
