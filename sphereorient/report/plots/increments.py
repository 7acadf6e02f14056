"""Increments of omega: their PDFs over several lags, and their flatness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sphereorient.report.plots.densities import draw_gaussian, lowest
from sphereorient.report.plots.marks import band, legend_above, plain_logarithms, points
from sphereorient.report.plots.style import ALL, COMPONENTS, GREY, SECOND, WIDTH_IN, X, in_style, new_figure
from sphereorient.statistics import Moments
from sphereorient.statistics.density import Density
from sphereorient.statistics.increments import Increments
from sphereorient.statistics.summary import Distributions

LOOKS = (*COMPONENTS, ALL)
SHORTEST = 4.0  # bars end at this part of the value


@in_style
def increments_figure(distributions: Distributions, table: Mapping[str, Moments] | None = None) -> Figure:
    """Draw PDFs of the increments of omega at the shown lags, and their flatness against the lag.

    The PDFs are of the x component in standard deviations, each a decade above the one of the next shorter lag. The
    flatness goes from that of alpha at short lags towards that of omega and the Gaussian's 3.

    Args:
        distributions: increments of omega_lab, columns x, y, z and all together.
        table: moments by quantity; gives the lines at the flatness of omega and alpha. None leaves them out.

    Returns:
        The figure, to be written by `write_figure`.

    Source: the paper, section IV, with ERRATA E7.
    """
    figure = new_figure(WIDTH_IN, 4.6)
    left, right = figure.subplots(1, 2)
    _densities(left, distributions)
    _flatness(right, distributions.increments)
    _levels(right, table or {})
    plain_logarithms(right.xaxis)
    legend_above(right, ncols=2)
    return figure


def _densities(axes: Axes, distributions: Distributions) -> None:
    steps, shown = distributions.increments, distributions.increment_densities
    lag_ms = dict(zip(steps.lag_frames.tolist(), (1e3 * steps.lag_s).tolist(), strict=True))
    axes.set_yscale("log")
    lags = sorted(shown)
    for k, lag in enumerate(lags):
        density = shown[lag]
        _points(axes, density, 10.0**k)
        draw_gaussian(axes, density, 10.0**k)
        top = float(np.nanmax(density.pdf.value, initial=0.4))
        axes.text(0, 1.25 * top * 10.0**k, f"{lag_ms[lag]:.2g} ms", ha="center", va="bottom", fontsize=6.5)
    bottom = min((lowest([shown[lag]]) * 10.0**k for k, lag in enumerate(lags)), default=1e-3)
    axes.set_ylim(bottom / 3, 8 * 10.0 ** max(len(lags) - 1, 0))
    reach = max((float(np.abs(d.centres[d.counts > 0]).max(initial=4.0)) for d in shown.values()), default=4.0)
    axes.set_xlim(-reach - 0.5, reach + 0.5)
    axes.set_xlabel(r"increment of $\omega_x$, lab (standard deviations)")
    axes.set_ylabel("PDF, shifted by decades (1/standard deviation)")
    legend_above(axes, handles=_handles())


def _points(axes: Axes, density: Density, factor: float) -> None:
    """Draw a shifted PDF at the bins with counts; bars that reach zero would run through the other curves."""
    there = density.counts > 0
    pdf = density.pdf.part(there).scaled(factor)
    points(axes, density.centres[there], replace(pdf, low=np.maximum(pdf.low, pdf.value / SHORTEST)), X)


def _handles() -> list[Line2D]:
    return [
        Line2D(
            [],
            [],
            color=X.colour,
            marker=X.marker,
            linestyle="none",
            label="bins with intervals, drawn down to ¼ of the value",
        ),
        Line2D([], [], label="Gaussian", **SECOND.drawn),
    ]


def _flatness(axes: Axes, steps: Increments) -> None:
    lag_ms = 1e3 * steps.lag_s
    for i, look in enumerate(LOOKS):
        of = steps.flatness.part((slice(None), i))
        axes.plot(lag_ms, of.value, marker=look.marker, label=look.name, **look.drawn)
        band(axes, lag_ms, of.low, of.high, look)
    axes.set_xscale("log")
    axes.set_xlabel("lag (ms)")
    axes.set_ylabel("flatness of increments of ω, lab (–)")


def _levels(axes: Axes, table: Mapping[str, Moments]) -> None:
    """Draw the flatness between which that of increments goes, with their names at the right end."""
    levels = {"Gaussian": 3.0}
    names = {"ω lab": "omega_lab", "α lab": "alpha_lab"}
    levels |= {name: together(table[key]) for name, key in names.items() if key in table}
    styles = {"Gaussian": SECOND.line, "ω lab": (0, (1, 1.5)), "α lab": (0, (8, 2))}
    for name, level in levels.items():
        if np.isfinite(level):
            axes.axhline(level, color=GREY, linestyle=styles[name], linewidth=1.0, label=f"{name}: {level:.3g}")


def together(of: Moments) -> float:
    """Return the flatness of all three components taken as one sample, about their means."""
    var = of.rms.value[:3] ** 2
    return float((of.flatness.value[:3] * var**2).mean() / var.mean() ** 2)
