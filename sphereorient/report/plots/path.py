"""The way of the sphere through space, with its axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sphereorient.report.plots.marks import legend_of_figure, note, say_empty
from sphereorient.report.plots.part import Part, cut, shown_part
from sphereorient.report.plots.style import ALL, COMPONENTS, WIDTH_IN, in_style, new_figure
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]

TRIPODS = 14
TRIPOD_SIZE = 0.09  # of the path's largest extent
THINNEST = 0.35  # of the largest extent: what the shortest side of the box has at least


@in_style
def path_figure(track: Trajectory) -> Figure:
    """Draw the path in the lab with the axes of the sphere's body along it, in one scale.

    Of a long track the part is drawn that `track_figure` shows.

    Args:
        track: what was measured; the smoother's position (mm) and orientation.

    Returns:
        The figure, to be written by `write_figure`.

    Source: the paper, figure of a sample track in space.
    """
    part = shown_part(track)
    figure = new_figure(WIDTH_IN, 5.6)
    axes: Any = figure.add_subplot(projection="3d")
    axes.set(xlabel="x, lab (mm)", ylabel="y, lab (mm)", zlabel="z, lab (mm)")
    position = part.track.position_smooth
    there = np.flatnonzero(np.isfinite(position).all(1))
    if len(there):
        size = TRIPOD_SIZE * max(float(np.ptp(position[there], axis=0).max()), 1.0)
        _path(axes, part, there)
        _tripods(axes, part, there, size)
        _equal_scale(axes, position[there], size)
    else:
        say_empty(axes)
    legend_of_figure(figure, _handles(), ncols=5)
    words = "the sphere's axes are not to scale"
    note(figure, f"{part.words}; {words}" if part.words else words)
    return figure


def _path(axes: Any, part: Part, there: NDArray[np.int64]) -> None:
    line = cut(part.track.position_smooth, part.broken)
    axes.plot(*line.T, color=ALL.colour, linewidth=1.0, label="path")
    axes.plot(*part.track.position_smooth[there[:1]].T, marker="o", markersize=5, color=ALL.colour, label="start")


def _tripods(axes: Any, part: Part, there: NDArray[np.int64], size: float) -> None:
    """Draw from some places of the path the three columns of R_lab_body."""
    known = there[np.isfinite(part.track.orientation_smooth[there]).all((1, 2))]
    if not len(known):
        return
    chosen = known[np.unique(np.linspace(0, len(known) - 1, TRIPODS).round().astype(int))]
    for i, look in enumerate(COMPONENTS):
        start = part.track.position_smooth[chosen]
        tip = start + size * part.track.orientation_smooth[chosen, :, i]
        ends = np.stack([start, tip, np.full_like(tip, np.nan)], axis=1).reshape(-1, 3)
        axes.plot(*ends.T, color=look.colour, linewidth=1.6, label=f"body axis {look.name}")
        axes.plot(*tip.T, color=look.colour, marker=look.marker, markersize=3, linestyle="none", label="_")


def _equal_scale(axes: Any, position_mm: Floats, size: float) -> None:
    """Give a millimetre the same length on all axes; the box is as long as the path, and not too thin."""
    low, high = position_mm.min(0) - size, position_mm.max(0) + size
    extent = np.maximum(high - low, THINNEST * (high - low).max())
    middle = (low + high) / 2
    axes.set_box_aspect(tuple(extent), zoom=0.95)  # a tuple: it scales an array in place
    axes.set(
        xlim=middle[0] + extent[0] * np.array([-0.5, 0.5]),
        ylim=middle[1] + extent[1] * np.array([-0.5, 0.5]),
        zlim=middle[2] + extent[2] * np.array([-0.5, 0.5]),
    )
    for axis, share in zip((axes.xaxis, axes.yaxis, axes.zaxis), extent / extent.max(), strict=True):
        axis.set_major_locator(MaxNLocator(max(2, round(6 * share))))


def _handles() -> list[Any]:
    path = Line2D([], [], color=ALL.colour, linewidth=1.0, label="path")
    start = Line2D([], [], color=ALL.colour, marker="o", linestyle="none", markersize=5, label="start")
    arms = [
        Line2D([], [], color=look.colour, marker=look.marker, linewidth=1.6, label=f"body axis {look.name}")
        for look in COMPONENTS
    ]
    return [path, start, *arms]
