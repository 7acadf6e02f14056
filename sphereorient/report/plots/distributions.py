"""Figures of distributions and correlations: PDFs, increments, autocorrelations, durations of the segments."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphereorient.errors import TrackError, refusal
from sphereorient.report.plots import style as look
from sphereorient.statistics import Moments, Summary
from sphereorient.statistics.density import Density, stretched_exponential
from sphereorient.statistics.lags import Correlation
from sphereorient.statistics.segments import UNITS, Durations
from sphereorient.statistics.summary import Distributions

Floats = NDArray[np.float64]

FOUR = (*look.COMPONENTS, look.ALL)
CURVE_POINTS = 401  # of a smooth curve
SHOWN_TIMES, SHOWN_ZEROS = 4.0, 1.5  # shown range of lags, in integral times or lags of the first zero
BARS: Final[dict[str, Any]] = {"facecolor": "#E0E0E0", "edgecolor": "#444444", "linewidth": 0.7}


def distribution_figures(of: look.Reported) -> Iterator[look.Plan]:
    """Yield the figures of this file in a report."""
    summary, _, _ = of
    if (more := summary.distributions) is None:
        return
    caption = "PDFs of the components in their standard deviations, the stretched exponential and the Gaussian."
    draw = partial(densities_figure, summary, list(more.densities))
    yield "densities", "PDFs (Figures 11 and 12 of the paper)", caption, draw
    caption = "Increments of omega over lags: PDFs, shifted by decades, and flatness."
    yield "increments", "Increments (Figure 11 of the paper)", caption, partial(increments_figure, more, summary.table)
    caption = "Autocorrelations and integral times."
    yield "correlations", "Correlations", caption, partial(correlations_figure, more.correlations)
    if more.durations is not None:
        draw = partial(durations_figure, more.durations)
        yield "durations", "Durations (Figure 9 of the paper)", "Of the segments.", draw


@look.in_style
def densities_figure(summary: Summary, quantities: Sequence[str] = tuple(UNITS)) -> Figure:
    """Draw the PDFs of the components of some quantities, in standard deviations, with the fit and the Gaussian.
    Raise TrackError if there is a single segment, which has no densities.
    Source: the paper, section IV; Mordant, Crawford and Bodenschatz 2004, Physica D 193, 245.
    """
    if summary.distributions is None:
        got, do = f"{summary.ensemble.segments}", "pass more tracks, or cut a long one with statistics.max_duration_s"
        raise TrackError(refusal("densities", expected="two segments or more", got=got, do=do))
    figure, panels = look.panel_grid(len(quantities), 2.7, 0.5, shared=True)
    drawn = {quantity: summary.distributions.densities[quantity] for quantity in quantities}
    counted = [density for densities in drawn.values() for density in densities]
    for axes, (quantity, densities) in zip(panels, drawn.items(), strict=True):
        _densities_panel(axes, quantity, densities)
        axes.set(xlim=_reach(counted), ylim=(_lowest(counted) / 3, 2.0))
    columns = min(2, len(quantities))
    for axes in panels[-columns:]:
        axes.set_xlabel("component (standard deviations)")
        axes.tick_params(labelbottom=True)
    handles = [
        look.PLAIN.handle("bins with intervals", linestyle="none", marker="o"),
        look.PLAIN.handle("stretched exponential, a and its flatness F"),
        look.SECOND.handle("Gaussian"),
    ]
    look.legend_of_figure(figure, handles, ncols=3 if columns > 1 else 1)
    return figure


def _densities_panel(axes: Axes, quantity: str, densities: Sequence[Density]) -> None:
    axes.set_yscale("log")
    handles = []
    for style, density in zip(look.COMPONENTS, densities, strict=True):
        there = density.counts > 0
        look.points(axes, density.centres[there], density.pdf.part(there), style)
        fit, a = density.fit, float(density.fit.a.value)
        label = f"{style.name}: a = {look.interval_text(fit.a)}, F = {look.three_digits(float(fit.flatness.value))}"
        x = np.linspace(density.edges[0], density.edges[-1], CURVE_POINTS)
        y = stretched_exponential(x, a) if np.isfinite(a) else np.full_like(x, np.nan)
        axes.plot(x, y, label=label, **(style.drawn | {"linewidth": 0.9}))
        handles.append(style.handle(label, marker=style.marker, linewidth=0.9))
    _gaussian(axes, densities[0])
    axes.set_ylabel(f"PDF of {look.SYMBOLS[quantity]} (1/standard deviation)")
    look.legend_above(axes, handles=handles)


def _gaussian(axes: Axes, density: Density, factor: float = 1.0) -> None:
    x = np.linspace(density.edges[0], density.edges[-1], CURVE_POINTS)
    y = factor * np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    axes.plot(x, y, label="_gaussian", **(look.SECOND.drawn | {"linewidth": 1.0}))


def _lowest(densities: Sequence[Density]) -> float:
    values = np.concatenate([d.pdf.value[d.counts > 0] for d in densities]) if densities else np.empty(0)
    values = values[np.isfinite(values) & (values > 0)]
    return float(values.min()) if len(values) else 4e-3


def _reach(densities: Sequence[Density]) -> tuple[float, float]:
    reach = max((float(np.abs(d.centres[d.counts > 0]).max(initial=4.0)) for d in densities), default=4.0)
    return -reach - 0.5, reach + 0.5


@look.in_style
def increments_figure(distributions: Distributions, table: Mapping[str, Moments] | None = None) -> Figure:
    """Draw the PDFs of increments of omega, each a decade above that of the next shorter lag, and flatness against lag,
    with lines at the flatness in `table`. Source: the paper, section IV, with docs/errata.md E7.
    """
    figure = look.new_figure(look.WIDTH_IN, 4.6)
    left, right = figure.subplots(1, 2)
    _shifted_densities(left, distributions)
    steps, lag_ms = distributions.increments, 1e3 * distributions.increments.lag_s
    for i, style in enumerate(FOUR):
        of = steps.flatness.part((slice(None), i))
        look.curve(right, lag_ms, of, style, marker=style.marker, label=style.name)
    right.set(xscale="log", xlabel="lag (ms)", ylabel="flatness of increments of ω, lab (–)")
    levels = {"Gaussian": (3.0, look.SECOND.line)}
    for name, key, line in (("ω lab", "omega_lab", (0, (1, 1.5))), ("α lab", "alpha_lab", (0, (8, 2)))):
        if table and key in table:  # the three components as one sample, each about its mean
            var = table[key].rms.value[:3] ** 2
            levels[name] = float((table[key].flatness.value[:3] * var**2).mean() / var.mean() ** 2), line
    for name, (level, line) in levels.items():
        if np.isfinite(level):
            right.axhline(level, color=look.GREY, linestyle=line, linewidth=1.0, label=f"{name}: {level:.3g}")
    look.plain_logarithms(right.xaxis)
    look.legend_above(right, ncols=2)
    return figure


def _shifted_densities(axes: Axes, distributions: Distributions) -> None:
    steps, shown = distributions.increments, distributions.increment_densities
    lag_ms = dict(zip(steps.lag_frames.tolist(), (1e3 * steps.lag_s).tolist(), strict=True))
    axes.set_yscale("log")
    lags = sorted(shown)
    for k, lag in enumerate(lags):
        density, factor = shown[lag], 10.0**k
        there = density.counts > 0
        pdf = density.pdf.part(there).scaled(factor)
        # Bars of shifted PDFs end at this part of the value: those down to zero would cross the other curves.
        look.points(axes, density.centres[there], replace(pdf, low=np.maximum(pdf.low, pdf.value / 4.0)), look.X)
        _gaussian(axes, density, factor)
        top = float(np.nanmax(density.pdf.value, initial=0.4))
        axes.text(0, 1.25 * top * factor, f"{lag_ms[lag]:.2g} ms", ha="center", va="bottom")
    bottom = min((_lowest([shown[lag]]) * 10.0**k for k, lag in enumerate(lags)), default=1e-3)
    axes.set(ylim=(bottom / 3, 8 * 10.0 ** max(len(lags) - 1, 0)), xlim=_reach(list(shown.values())))
    axes.set_xlabel(r"increment of $\omega_x$, lab (standard deviations)")
    axes.set_ylabel("PDF, shifted by decades (1/standard deviation)")
    bins = look.X.handle("bins with intervals, drawn down to ¼ of the value", marker=look.X.marker, linestyle="none")
    look.legend_above(axes, handles=[bins, look.SECOND.handle("Gaussian")])


@look.in_style
def correlations_figure(correlations: Mapping[str, Correlation]) -> Figure:
    """Draw autocorrelations against the lag, with bands; markers below zero are integral times. Source: textbook."""
    figure, panels = look.panel_grid(len(correlations), 3.0, 0.4)
    for axes, (quantity, correlation) in zip(panels, correlations.items(), strict=True):
        _correlation_panel(axes, correlation)
        axes.set(xlabel="lag (ms)", ylabel=f"autocorrelation of {look.SYMBOLS.get(quantity, quantity)} (–)")
    figure.align_ylabels()
    words = "markers below the line of zero: integral times with intervals; each panel has its own range of lags"
    look.note(figure, words)
    return figure


def _correlation_panel(axes: Axes, correlation: Correlation) -> None:
    lag_ms = 1e3 * correlation.lag_s
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    for i, style in enumerate(FOUR):
        words = look.interval_text(correlation.integral_time_s.part(i), "ms", 1e3)
        if words != "unknown" and not correlation.reached_zero[i]:
            words = f"above {words}, no zero"
        look.curve(axes, lag_ms, correlation.value.part((slice(None), i)), style, label=f"{style.name}: {words}")
    for i, style in enumerate(FOUR):
        time = correlation.integral_time_s.part(i).scaled(1e3)
        place = np.array([-0.05 * (1 + i)])  # one below the other, as they are close
        axes.plot([float(time.value)], place, marker=style.marker, linestyle="none", color=style.colour, label="_")
        axes.hlines(place, [float(time.low)], [float(time.high)], color=style.colour, linewidth=0.9)
    below = np.flatnonzero((correlation.value.value <= 0).any(1))
    zero = float(lag_ms[below[0] if len(below) else -1])
    longest = float(np.nanmax(1e3 * correlation.integral_time_s.value, initial=0.0))
    end = max(min(float(lag_ms[-1]), max(SHOWN_TIMES * longest, SHOWN_ZEROS * zero)), 1e-3)
    axes.set(xlim=(0.0, end), ylim=(min(axes.get_ylim()[0], -0.3), 1.05))
    look.legend_above(axes, title="integral time")


@look.in_style
def durations_figure(durations: Durations) -> Figure:
    """Draw the histogram of the segments' durations, counts on a logarithmic axis, with the exponential law."""
    figure = look.new_figure(look.WIDTH_IN * 0.7, 3.0)
    axes = figure.subplots()
    unit, factor = ("ms", 1e3) if durations.edges_s[-1] < 2 else ("s", 1.0)
    edges = factor * durations.edges_s
    counts = np.where(durations.counts > 0, durations.counts, np.nan)
    axes.set_yscale("log")
    label = f"{durations.segments:,} segments of at least {factor * durations.truncated_s:.3g} {unit}"
    axes.stairs(counts, edges, baseline=0.1, fill=True, label=label, **BARS)
    middle, decay = (edges[1:] + edges[:-1]) / 2, durations.decay_time_s
    label = f"exponential, decay time {look.interval_text(decay, unit, factor)}"
    axes.plot(middle, durations.expected, label=label, **look.SECOND.drawn)
    ends = [durations.law(float(time)) for time in (decay.low, decay.high)]
    look.band(axes, middle, np.minimum(*ends), np.maximum(*ends), look.SECOND)
    axes.set(xlabel=f"duration ({unit})", ylabel="segments (number in a bin)")
    axes.set_ylim(0.5, 2.0 * max(float(np.nanmax(counts, initial=1.0)), 1.0))
    look.plain_logarithms(axes.yaxis)
    look.legend_above(axes)
    return figure
