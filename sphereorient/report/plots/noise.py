"""How much of each variance is noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphereorient.report.plots.isotropy import in_frame
from sphereorient.report.plots.marks import legend_above, plain_logarithms, say_empty
from sphereorient.report.plots.style import COMPONENTS, SECOND, WIDTH_IN, in_style, new_figure
from sphereorient.statistics import Interval, Moments
from sphereorient.statistics.moments import WARN_SHARE

Floats = NDArray[np.float64]

BAR = 0.24  # width, where quantities are 1 apart
WORDS = {"added": "noise in the variance (%)", "removed": "variance smoothed away (%)"}


@in_style
def noise_figure(table: Mapping[str, Moments], error: Literal["added", "removed"] = "added") -> Figure:
    """Draw the share of noise in the variance of every component, with intervals and the line of 10 %.

    Args:
        table: moments by quantity.
        error: the ensemble's: whether a track's sigma is noise on top of the motion or motion that was smoothed away.

    Returns:
        The figure, to be written by `write_figure`.

    Source: docs/statistics.md, Noise.
    """
    figure = new_figure(WIDTH_IN, 3.2)
    axes = figure.subplots()
    shares = [one.noise_share.part(slice(0, 3)).scaled(100.0) for one in table.values()]
    floor = _floor(shares)
    if floor:
        axes.set_yscale("log")
    for i, look in enumerate(COMPONENTS):
        at = np.arange(len(shares)) + (i - 1) * BAR
        value, low, high = (np.array([float(getattr(s, key)[i]) for s in shares]) for key in ("value", "low", "high"))
        style: dict[str, Any] = {"color": look.colour, "edgecolor": "white", "hatch": look.hatch, "label": look.name}
        axes.bar(at, value - floor, BAR, bottom=floor, **style)
        there = np.isfinite(low) & np.isfinite(high)
        axes.vlines(at[there], np.maximum(low[there], floor), high[there], color="black", linewidth=1.0)
    axes.axhline(100 * WARN_SHARE, label=f"{100 * WARN_SHARE:.0f} %: worth a warning", **SECOND.drawn)
    _finish(axes, [in_frame(name) for name in table], WORDS[error], shares, floor)
    return figure


def _floor(shares: list[Interval]) -> float:
    """Return where bars begin on a logarithmic axis: a decade below the least; 0 where the axis is linear."""
    known = np.concatenate([share.value for share in shares]) if shares else np.empty(0)
    known = known[np.isfinite(known) & (known > 0)]
    return float(10.0 ** (np.floor(np.log10(known.min())) - (np.log10(known.min()) % 1 < 0.3))) if len(known) else 0.0


def _finish(axes: Axes, names: list[str], what: str, shares: list[Interval], floor: float) -> None:
    axes.set_xticks(np.arange(len(names)), names)
    axes.grid(visible=False, axis="x")
    axes.set_xlabel("vector and its frame (–)")
    axes.set_ylabel(what)
    tops = [float(np.nanmax(np.nan_to_num([s.value, s.high]), initial=0.0)) for s in shares]
    top = max([*tops, 100 * WARN_SHARE])
    axes.set_ylim(floor, 1.5 * top) if floor else axes.set_ylim(0.0, 1.2 * top)
    if floor:
        plain_logarithms(axes.yaxis)
    line, *bars = axes.get_legend_handles_labels()[0]
    legend_above(axes, ncols=4, handles=[*bars, line])
    if not any(np.isfinite(share.value).any() for share in shares):
        say_empty(axes, "the errors of this track are unknown")
