"""How long segments last."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphereorient.report.plots.marks import band, legend_above, plain_logarithms, told
from sphereorient.report.plots.style import SECOND, WIDTH_IN, in_style, new_figure
from sphereorient.statistics.durations import Durations

Floats = NDArray[np.float64]

BARS: Final[dict[str, Any]] = {"facecolor": "#E0E0E0", "edgecolor": "#444444", "linewidth": 0.7}


@in_style
def durations_figure(durations: Durations) -> Figure:
    """Draw the histogram of the segments' durations, counts in logarithms, with the exponential law.

    Args:
        durations: of `statistics.durations.durations`.

    Returns:
        The figure, to be written by `write_figure`.

    Source: the paper, section IV.
    """
    figure = new_figure(WIDTH_IN * 0.7, 3.0)
    axes = figure.subplots()
    unit, factor = ("ms", 1e3) if durations.edges_s[-1] < 2 else ("s", 1.0)
    edges = factor * durations.edges_s
    counts = np.where(durations.counts > 0, durations.counts, np.nan)
    axes.set_yscale("log")
    label = f"{durations.segments:,} segments of at least {factor * durations.truncated_s:.3g} {unit}"
    axes.stairs(counts, edges, baseline=0.1, fill=True, label=label, **BARS)
    _law(axes, durations, factor, unit)
    axes.set_xlabel(f"duration ({unit})")
    axes.set_ylabel("segments (number in a bin)")
    axes.set_ylim(0.5, 2.0 * max(float(np.nanmax(counts, initial=1.0)), 1.0))
    plain_logarithms(axes.yaxis)
    legend_above(axes)
    return figure


def _law(axes: Axes, durations: Durations, factor: float, unit: str) -> None:
    """Draw the counts that the exponential law expects, with those at both ends of the decay time's interval."""
    middle = factor * (durations.edges_s[1:] + durations.edges_s[:-1]) / 2
    label = f"exponential, decay time {told(durations.decay_time_s, unit, factor)}"
    axes.plot(middle, durations.expected, label=label, **SECOND.drawn)
    ends = [_expected(durations, float(time)) for time in (durations.decay_time_s.low, durations.decay_time_s.high)]
    band(axes, middle, np.minimum(*ends), np.maximum(*ends), SECOND)


def _expected(durations: Durations, decay_s: float) -> Floats:
    """Return the counts (B,) of an exponential law with another decay time."""
    survived = np.exp(-(durations.edges_s - durations.truncated_s) / max(decay_s, 1e-300))
    return np.asarray(durations.segments * -np.diff(survived))
