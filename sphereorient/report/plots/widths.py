"""The effect of the kernel's width on rms and flatness: is there a plateau."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sphereorient.report.plots.marks import SYMBOLS, legend_of_figure, plain_logarithms, points
from sphereorient.report.plots.style import COMPONENTS, GREY, SECOND, WIDTH_IN, in_style, new_figure
from sphereorient.statistics.moments import WARN_SHARE
from sphereorient.statistics.segments import UNITS
from sphereorient.statistics.widths import WidthCurve

SHOWN = ("acceleration", "alpha_lab")


@in_style
def widths_figure(widths: Mapping[str, WidthCurve]) -> Figure:
    """Draw rms, flatness and share of noise of a and alpha against the width of the smoothing kernel.

    Filled markers are corrected for the noise that the measurements' own errors foretell, open ones are as measured.
    Where the corrected curves are level over several widths, there is a plateau.

    Args:
        widths: by quantity; acceleration and alpha_lab are drawn, and velocity where neither is there.

    Returns:
        The figure, to be written by `write_figure`.

    Source: Voth et al. 2002, J. Fluid Mech. 469, 121; the paper, section III.
    """
    shown = [name for name in SHOWN if name in widths] or list(widths)[:1]
    figure = new_figure(WIDTH_IN * max(len(shown), 1) / 2, 6.6)
    panels = figure.subplots(3, max(len(shown), 1), sharex="col", squeeze=False)
    for column, name in zip(panels.T, shown, strict=True):
        _column(column[0], column[1], column[2], widths[name])
    figure.align_ylabels()
    legend_of_figure(figure, _handles(), ncols=3)
    return figure


def _column(rms: Axes, flatness: Axes, share: Axes, curve: WidthCurve) -> None:
    symbol, unit = SYMBOLS[curve.quantity], UNITS[curve.quantity].replace("^2", "²")
    width_ms = 1e3 * curve.width_s
    nudge = 0.04 * float(np.min(np.diff(width_ms))) if len(width_ms) > 1 else 0.0
    for i, look in enumerate(COMPONENTS):
        x, column = width_ms + (i - 1) * nudge, (slice(None), i)
        for axes, corrected, measured in (
            (rms, curve.corrected_rms, curve.rms),
            (flatness, curve.corrected_flatness, curve.flatness),
        ):
            points(axes, x, corrected.part(column), look, f"{look.name}, corrected", joined=True)
            axes.plot(
                x,
                measured.value[column],
                marker=look.marker,
                markerfacecolor="white",
                color=look.colour,
                linestyle="none",
                label=f"{look.name}, measured",
            )
        points(share, x, curve.noise_share.part(column).scaled(100.0), look, look.name, joined=True)
    share.axhline(100 * WARN_SHARE, label="_10 %", **SECOND.drawn)
    if (curve.noise_share.value > 0).any():
        share.set_yscale("log")
        plain_logarithms(share.yaxis)
    rms.set_ylim(bottom=0.0)  # what looks level is level
    rms.set_ylabel(f"rms of {symbol} ({unit})")
    flatness.set_ylabel(f"flatness of {symbol} (–)")
    share.set_ylabel(f"noise in the variance of {symbol} (%)")
    share.set_xlabel("kernel width σ (ms)")


def _handles() -> list[Line2D]:
    lines = [Line2D([], [], marker=look.marker, label=look.name, **look.drawn) for look in COMPONENTS]
    corrected = Line2D([], [], color=GREY, marker="o", label="corrected for noise")
    measured = Line2D([], [], color=GREY, marker="o", markerfacecolor="white", linestyle="none", label="as measured")
    limit = Line2D([], [], label=f"{100 * WARN_SHARE:.0f} % of the variance", **SECOND.drawn)
    return [lines[0], corrected, lines[1], measured, lines[2], limit]
