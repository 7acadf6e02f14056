"""PDFs of normalised components with the stretched exponential and the Gaussian."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sphereorient.errors import TrackError, refusal
from sphereorient.report.plots.marks import SYMBOLS, legend_above, legend_of_figure, points, three_digits, told
from sphereorient.report.plots.style import COMPONENTS, SECOND, WIDTH_IN, Look, in_style, new_figure
from sphereorient.statistics import Summary
from sphereorient.statistics.density import Density, stretched_exponential
from sphereorient.statistics.segments import UNITS

Floats = NDArray[np.float64]

CURVE_POINTS = 401


@in_style
def densities_figure(summary: Summary, quantities: Sequence[str] = tuple(UNITS)) -> Figure:
    """Draw the PDFs of the components of some quantities, each in its own standard deviations.

    Points are bins with counts and their intervals, curves the fitted stretched exponentials; the legend gives their
    width a and flatness F. The Gaussian is dashed.

    Args:
        summary: of two segments or more.
        quantities: names in `statistics.segments.UNITS`, a panel each.

    Returns:
        The figure, to be written by `write_figure`.

    Raises:
        TrackError: a single segment: there are no densities.

    Source: the paper, section IV; Mordant, Crawford and Bodenschatz 2004, Physica D 193, 245.
    """
    if summary.distributions is None:
        got, do = f"{summary.ensemble.segments}", "pass more tracks, or cut a long one with statistics.max_duration_s"
        raise TrackError(refusal("densities", expected="two segments or more", got=got, do=do))
    columns = min(2, len(quantities))
    rows = -(-len(quantities) // columns)
    figure = new_figure(WIDTH_IN * columns / 2, 0.5 + 2.7 * rows)
    panels = np.ravel(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False))
    for axes, quantity in zip(panels, quantities, strict=False):
        _panel(axes, quantity, summary.distributions.densities[quantity])
    for axes in panels[len(quantities) :]:
        axes.remove()
    _limits(list(panels[: len(quantities)]), [d for q in quantities for d in summary.distributions.densities[q]])
    for axes in panels[: len(quantities)][-columns:]:
        axes.set_xlabel("component (standard deviations)")
        axes.tick_params(labelbottom=True)
    legend_of_figure(figure, _handles(), ncols=3 if columns > 1 else 1)
    return figure


def _panel(axes: Axes, quantity: str, densities: Sequence[Density]) -> None:
    axes.set_yscale("log")
    for look, density in zip(COMPONENTS, densities, strict=True):
        draw_points(axes, density, look)
        fit = density.fit
        label = f"{look.name}: a = {told(fit.a)}, F = {three_digits(float(fit.flatness.value))}"
        x = np.linspace(density.edges[0], density.edges[-1], CURVE_POINTS)
        known = np.isfinite(fit.a.value)
        y = stretched_exponential(x, float(fit.a.value)) if known else np.full_like(x, np.nan)
        axes.plot(x, y, label=label, **(look.drawn | {"linewidth": 0.9}))
    draw_gaussian(axes, densities[0])
    axes.set_ylabel(f"PDF of {SYMBOLS[quantity]} (1/standard deviation)")
    handles = [
        Line2D([], [], marker=look.marker, label=line.get_label(), **(look.drawn | {"linewidth": 0.9}))
        for look, line in zip(COMPONENTS, [x for x in axes.lines if ": a = " in str(x.get_label())], strict=True)
    ]
    legend_above(axes, handles=handles)


def draw_points(axes: Axes, density: Density, look: Look, factor: float = 1.0) -> None:
    """Draw a PDF, times a factor, at the bins that have counts."""
    there = density.counts > 0
    pdf = density.pdf.part(there).scaled(factor)
    points(axes, density.centres[there], pdf, look)


def draw_gaussian(axes: Axes, density: Density, factor: float = 1.0) -> None:
    """Draw the Gaussian of unit variance over a PDF's range, times a factor."""
    x = np.linspace(density.edges[0], density.edges[-1], CURVE_POINTS)
    y = factor * np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    axes.plot(x, y, label="_gaussian", **(SECOND.drawn | {"linewidth": 1.0}))


def lowest(densities: Sequence[Density]) -> float:
    """Return the smallest density of a bin with counts; that of three standard deviations where there is none."""
    values = np.concatenate([d.pdf.value[d.counts > 0] for d in densities]) if densities else np.empty(0)
    values = values[np.isfinite(values) & (values > 0)]
    return float(values.min()) if len(values) else 4e-3


def _limits(panels: Sequence[Axes], densities: Sequence[Density]) -> None:
    """Show all that was counted: the same range in all panels."""
    reach = max((float(np.abs(d.centres[d.counts > 0]).max(initial=4.0)) for d in densities), default=4.0)
    for axes in panels:
        axes.set(xlim=(-reach - 0.5, reach + 0.5), ylim=(lowest(densities) / 3, 2.0))


def _handles() -> list[Line2D]:
    grey = Look(name="", colour="#666666", line="-", marker="o")
    return [
        Line2D([], [], linestyle="none", marker="o", color=grey.colour, label="bins with intervals"),
        Line2D([], [], color=grey.colour, label="stretched exponential, a and its flatness F"),
        Line2D([], [], label="Gaussian", **SECOND.drawn),
    ]
