"""Marks that all figures share: points and bands with intervals, legends beside the data, numbers in words."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from sphereorient.report.plots.style import GREY, Look
from sphereorient.statistics import Interval

Floats = NDArray[np.float64]

BAND = 0.2  # opacity
LETTERS_PER_INCH = 15  # of a note; narrow enough for wide letters

SYMBOLS = {
    "velocity": "v",
    "acceleration": "a",
    "omega_lab": "ω lab",
    "omega_body": "ω body",
    "alpha_lab": "α lab",
    "alpha_body": "α body",
}


def points(axes: Axes, x: Floats, of: Interval, look: Look, label: str = "", joined: bool = False) -> None:
    """Draw values as markers with their intervals as bars.

    Args:
        axes: where.
        x: (K,).
        of: (K,) values; what is NaN is not drawn, a missing bound leaves out the bar.
        look: colour and marker.
        label: for the legend; empty: not in it.
        joined: whether a line in the look's style goes through the markers.
    """
    style = look.drawn if joined else look.drawn | {"linestyle": "none"}
    axes.plot(x, of.value, marker=look.marker, label=label or "_", **style)
    there = np.isfinite(of.low) & np.isfinite(of.high) & np.isfinite(x)
    # by lines, not by errorbar: a corrected interval need not hold its value
    axes.vlines(x[there], of.low[there], of.high[there], color=look.colour, linewidth=0.8)


def band(axes: Axes, x: Floats, low: Floats, high: Floats, look: Look) -> None:
    """Shade what lies between two curves (K,), broken where one of them is NaN."""
    there = np.isfinite(low) & np.isfinite(high) & np.isfinite(x)
    if there.any():
        axes.fill_between(x, low, high, where=there.tolist(), color=look.colour, alpha=BAND, linewidth=0)


def legend_above(axes: Axes, ncols: int = 1, handles: Sequence[Any] | None = None, title: str | None = None) -> None:
    """Put the legend over the axes, where it covers nothing."""
    handles = axes.get_legend_handles_labels()[0] if handles is None else list(handles)
    if handles:
        axes.legend(
            handles=handles,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=ncols,
            title=title,
            alignment="left",
            borderaxespad=0.2,
            columnspacing=1.2,
            labelspacing=0.25,
        )


def legend_of_figure(figure: Figure, handles: Sequence[Any], ncols: int) -> None:
    """Put one legend over all panels."""
    figure.legend(handles=list(handles), loc="outside upper center", ncols=ncols, columnspacing=1.4)


def note(figure: Figure, words: str) -> None:
    """Say something below all panels, in as many lines as it takes."""
    letters = round(LETTERS_PER_INCH * figure.get_figwidth())
    figure.supxlabel(textwrap.fill(words, letters), fontsize=7.5)


def plain_logarithms(axis: Axis) -> None:
    """Write the numbers of a logarithmic axis as they are, 1, 2, 5, 10, as many as have room."""
    low, high = axis.get_view_interval()
    decades = abs(math.log10(high / low)) if low > 0 and high > 0 else 1.0
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2.5 else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: np.format_float_positional(value, precision=12, trim="-")))
    axis.set_minor_formatter(NullFormatter())


def say_empty(axes: Any, words: str = "nothing measured") -> None:
    """Say in the middle of an empty panel why it is empty."""
    write = axes.text2D if hasattr(axes, "text2D") else axes.text
    write(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", color=GREY)


def told(of: Interval, unit: str = "", factor: float = 1.0) -> str:
    """Return a scalar with its interval in words: '0.921 (0.905 to 0.938)'.

    Args:
        of: scalar; without finite bounds only the value is told.
        unit: behind the value.
        factor: from the interval's unit to this one.
    """
    value, low, high = (factor * float(x) for x in (of.value, of.low, of.high))
    behind = f" {unit}" if unit else ""
    if not math.isfinite(value):
        return "unknown"
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{value:.3g}{behind}"
    places = decimals(high - low)
    return f"{value:.{places}f}{behind} ({low:.{places}f} to {high:.{places}f})"


def decimals(width: float) -> int:
    """Return how many decimals show an interval of this width with two digits."""
    if not width > 0:
        return 3
    return min(max(1 - math.floor(math.log10(width)), 0), 6)


def three_digits(value: float) -> str:
    """Return a number with three digits or more, never as a power of ten."""
    return f"{value:.{decimals(value / 10)}f}" if math.isfinite(value) else "unknown"


def chance(p_value: float) -> str:
    """Return a p-value in words."""
    if not math.isfinite(p_value):
        return "p unknown"
    return "p < 0.001" if p_value < 1e-3 else f"p = {p_value:.{2 if p_value >= 0.1 else 3}f}"
