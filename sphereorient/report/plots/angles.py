"""Euler angles against the law of attitudes that are all equally likely."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sphereorient.report.plots.marks import chance, legend_of_figure, note, points
from sphereorient.report.plots.style import COMPONENTS, GREY, SECOND, WIDTH_IN, Look, in_style, new_figure
from sphereorient.statistics.attitude import EulerDensity, Uniformity


@in_style
def angles_figure(angles: Sequence[EulerDensity], uniformity: Uniformity) -> Figure:
    """Draw the PDFs of the three Euler angles beside those of uniform attitudes, and say what the test found.

    Args:
        angles: theta_x, theta_y, theta_z, of `statistics.attitude.euler_densities`.
        uniformity: of `statistics.attitude.uniformity`.

    Returns:
        The figure, to be written by `write_figure`.

    Source: the paper, section II; the angles by ERRATA E1.
    """
    figure = new_figure(WIDTH_IN, 2.9)
    panels = figure.subplots(1, len(angles), sharey=True, squeeze=False)[0]
    for axes, angle, look in zip(panels, angles, COMPONENTS, strict=True):
        _panel(axes, angle, look)
    panels[0].set_ylabel("PDF (1/degree)")
    panels[0].set_ylim(bottom=0.0)
    legend_of_figure(
        figure,
        [
            Line2D([], [], color=GREY, marker="o", linestyle="none", label="bins with intervals"),
            Line2D([], [], label="all attitudes equally likely", **SECOND.drawn),
        ],
        ncols=2,
    )
    note(figure, _words(uniformity))
    return figure


def _panel(axes: Axes, angle: EulerDensity, look: Look) -> None:
    edges_deg = np.rad2deg(angle.edges_rad)
    points(axes, (edges_deg[1:] + edges_deg[:-1]) / 2, angle.pdf.scaled(np.pi / 180), look, angle.name)
    axes.stairs(
        angle.uniform * np.pi / 180, edges_deg, baseline=None, color=SECOND.colour, linestyle=SECOND.line, linewidth=1.1
    )
    axes.set_xlabel(rf"$\theta_{angle.name[-1]}$ (degrees)")
    step = 45 if edges_deg[-1] < 100 else 90
    axes.set(xlim=(edges_deg[0], edges_deg[-1]), xticks=np.arange(edges_deg[0], edges_deg[-1] + 1, step))


def _words(of: Uniformity) -> str:
    if not np.isfinite(of.p_value):
        return "uniformity of the attitudes could not be tested"
    found = "nothing speaks against uniform attitudes" if of.uniform else "the attitudes are not uniform"
    return (
        f"{found}: {chance(of.p_value)}, test on SO(3) of {of.samples:,} frames in {of.segments:,} segments, "
        f"worth {of.effective:,.0f} independent attitudes"
    )
