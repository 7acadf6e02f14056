"""Shares of the components in the variance, in lab and body."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sphereorient.report.plots.marks import SYMBOLS, chance, legend_of_figure, points, say_empty
from sphereorient.report.plots.style import COMPONENTS, SECOND, WIDTH_IN, in_style, new_figure
from sphereorient.statistics.isotropy import Isotropy

BESIDE = 0.2  # between the components of one quantity, where quantities are 1 apart


@in_style
def isotropy_figure(isotropies: Mapping[str, Isotropy]) -> Figure:
    """Draw for each quantity the shares of its components in the variance, with intervals and the line of a third.

    Under each quantity stands the p-value of isotropy in its frame.

    Args:
        isotropies: by quantity; components of *_lab, velocity and acceleration are the lab's, of *_body the body's.

    Returns:
        The figure, to be written by `write_figure`.

    Source: the paper, Table I, with ERRATA E6.
    """
    figure = new_figure(WIDTH_IN, 3.2)
    axes = figure.subplots()
    place = np.arange(len(isotropies))
    shares = [isotropies[name].variance_share.scaled(100.0) for name in isotropies]
    for i, look in enumerate(COMPONENTS):
        for k, share in enumerate(shares):
            at = np.array([k + (i - 1) * BESIDE])
            points(axes, at, share.part(slice(i, i + 1)), look, look.name)
    axes.axhline(100 / 3, label="a third", **SECOND.drawn)
    labels = [f"{in_frame(name)}\n{chance(one.p_value)}" for name, one in isotropies.items()]
    axes.set_xticks(place, labels)
    axes.grid(visible=False, axis="x")
    axes.set_xlabel("vector and its frame, p-value of isotropy (–)")
    axes.set_ylabel("share in the variance (%)")
    if isotropies:
        axes.set_xlim(-0.5, len(place) - 0.5)
    else:
        say_empty(axes)
    handles = [
        Line2D([], [], color=look.colour, marker=look.marker, linestyle="none", label=look.name) for look in COMPONENTS
    ]
    legend_of_figure(figure, [*handles, Line2D([], [], label="isotropic: a third", **SECOND.drawn)], ncols=4)
    return figure


def in_frame(quantity: str) -> str:
    """Return a quantity's symbol with the frame of its components."""
    symbol = SYMBOLS.get(quantity, quantity)
    return symbol if " " in symbol else f"{symbol} lab"
