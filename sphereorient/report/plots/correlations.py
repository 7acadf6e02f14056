"""Autocorrelations within segments, with integral times."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sphereorient.report.plots.marks import SYMBOLS, band, legend_above, note, told
from sphereorient.report.plots.style import ALL, COMPONENTS, WIDTH_IN, in_style, new_figure
from sphereorient.statistics.correlation import Correlation

LOOKS = (*COMPONENTS, ALL)
SHOWN_TIMES, SHOWN_ZEROS = 4.0, 1.5  # integral times, or lags of the first zero, that are shown


@in_style
def correlations_figure(correlations: Mapping[str, Correlation]) -> Figure:
    """Draw the autocorrelations of some quantities against the lag, with bands and integral times.

    An integral time is a marker below the line of zero, with its interval; the legend tells where a curve did not reach
    zero, so that its time is a lower bound.

    Args:
        correlations: by quantity, columns x, y, z and the vector.

    Returns:
        The figure, to be written by `write_figure`.

    Source: textbook; the paper's T_L is the integral time of `velocity`.
    """
    columns = min(2, max(len(correlations), 1))
    rows = max(-(-len(correlations) // columns), 1)
    figure = new_figure(WIDTH_IN * columns / 2, 0.4 + 3.0 * rows)
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axes, (quantity, correlation) in zip(panels, correlations.items(), strict=False):
        _panel(axes, correlation)
        axes.set_ylabel(f"autocorrelation of {SYMBOLS.get(quantity, quantity)} (–)")
        axes.set_xlabel("lag (ms)")
    for axes in panels[len(correlations) :]:
        axes.remove()
    figure.align_ylabels()
    note(figure, "markers below the line of zero: integral times with intervals; each panel has its own range of lags")
    return figure


def _panel(axes: Axes, correlation: Correlation) -> None:
    lag_ms = 1e3 * correlation.lag_s
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    for i, look in enumerate(LOOKS):
        of = correlation.value.part((slice(None), i))
        axes.plot(lag_ms, of.value, label=f"{look.name}: {_time_words(correlation, i)}", **look.drawn)
        band(axes, lag_ms, of.low, of.high, look)
    for i, look in enumerate(LOOKS):
        time = correlation.integral_time_s.part(i).scaled(1e3)
        place = np.array([-0.05 * (1 + i)])  # one below the other, since they lie close together
        axes.plot([float(time.value)], place, marker=look.marker, linestyle="none", color=look.colour, label="_")
        axes.hlines(place, [float(time.low)], [float(time.high)], color=look.colour, linewidth=0.9)
    axes.set_xlim(0.0, _reach_ms(correlation))
    axes.set_ylim(bottom=min(axes.get_ylim()[0], -0.3), top=1.05)
    legend_above(axes, title="integral time")


def _time_words(correlation: Correlation, i: int) -> str:
    words = told(correlation.integral_time_s.part(i), "ms", 1e3)
    return words if words == "unknown" or correlation.reached_zero[i] else f"above {words}, zero not reached"


def _reach_ms(correlation: Correlation) -> float:
    """Return the longest lag that is shown."""
    lag_ms = 1e3 * correlation.lag_s
    below = np.flatnonzero((correlation.value.value <= 0).any(1))
    zero = float(lag_ms[below[0]]) if len(below) else float(lag_ms[-1])
    times = 1e3 * correlation.integral_time_s.value
    longest = float(np.nanmax(times, initial=0.0))
    return max(min(float(lag_ms[-1]), max(SHOWN_TIMES * longest, SHOWN_ZEROS * zero)), 1e-3)
