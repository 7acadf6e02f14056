"""How far the orientations of two cameras lie apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphereorient.report.plots.marks import legend_above, plain_logarithms, say_empty
from sphereorient.report.plots.style import ALL, SECOND, WIDTH_IN, Look, in_style, new_figure
from sphereorient.statistics.cameras import CameraDistance

Floats = NDArray[np.float64]

TOO_WIDE = 15.0  # medians: even bins that reach further show the nearer distances as one bar
NEAREST = 30.0  # the smaller median over the first of the geometric bins
BINS = 36  # geometric ones


@in_style
def camera_distance_figure(distances: Sequence[CameraDistance]) -> Figure:
    """Draw the PDF of the distance of the cameras' orientations, with its median, a panel for each pair of cameras.

    Where perspective was left uncorrected for comparison, its PDF is dashed. Where even bins would show the smaller
    distances as one bar, both axes are logarithmic and the bins geometric; the PDF is per degree all the same.

    Args:
        distances: of `statistics.cameras.camera_distances`; none with one camera.

    Returns:
        The figure, to be written by `write_figure`.

    Source: the paper, section III, distance of the two cameras; the sign of the correction by ERRATA A1.
    """
    shown = list(distances)
    figure = new_figure(WIDTH_IN * 0.7, 2.9 * max(len(shown), 1))
    panels = figure.subplots(max(len(shown), 1), 1, squeeze=False)[:, 0]
    for axes in panels:
        axes.set_xlabel("distance of two cameras' orientations (degrees)")
        axes.set_ylabel("PDF (1/degree)")
    if not shown:
        say_empty(panels[0], "no two cameras to compare")
    for axes, distance in zip(panels, shown, strict=False):
        _panel(axes, distance)
    return figure


def _panel(axes: Axes, distance: CameraDistance) -> None:
    names = " and ".join(distance.cameras)
    laws = [(np.rad2deg(distance.distance_rad), distance.pdf, ALL, "perspective corrected")]
    if distance.uncorrected_rad is None:
        laws = [(*laws[0][:3], "distance")]
    elif distance.uncorrected_pdf is not None:
        laws.append((np.rad2deg(distance.uncorrected_rad), distance.uncorrected_pdf, SECOND, "not corrected"))
    laws = [law for law in laws if len(law[0])]
    if not laws:
        say_empty(axes, f"no frame in which {names} both have an orientation")
        return
    even = np.rad2deg(distance.edges_rad)
    nearest = min(float(np.median(law[0])) for law in laws)
    edges = even if even[-1] <= TOO_WIDE * nearest or not nearest else _geometric(nearest, float(even[-1]))
    for values, pdf, look, what in laws:
        _law(axes, values, edges, pdf * np.pi / 180 if edges is even else _density(values, edges), look, what)
    if edges is even:
        axes.set_xlim(0.0, float(edges[-1]))
        axes.set_ylim(bottom=0.0)
    else:
        axes.set(xscale="log", yscale="log", xlim=(edges[0], 1.2 * edges[-1]))
        plain_logarithms(axes.xaxis)
        plain_logarithms(axes.yaxis)
    legend_above(axes, title=names)


def _geometric(nearest_deg: float, top_deg: float) -> Floats:
    return np.geomspace(nearest_deg / NEAREST, top_deg * (1 + 1e-9), BINS + 1)


def _density(values_deg: Floats, edges_deg: Floats) -> Floats:
    """Return the density in bins of other widths than the record's, 1/degree; NaN where there is none."""
    counts, _ = np.histogram(values_deg, edges_deg)
    return np.where(counts > 0, counts / len(values_deg) / np.diff(edges_deg), np.nan)


def _law(axes: Axes, values_deg: Floats, edges: Floats, pdf: Floats, look: Look, what: str) -> None:
    median = float(np.median(values_deg))
    label = f"{what}: median {median:.2g}° of {len(values_deg):,} frames"
    axes.stairs(pdf, edges, color=look.colour, linestyle=look.line, linewidth=1.2, label=label)
    axes.axvline(median, color=look.colour, linestyle=look.line, linewidth=0.8)
