"""Figures of isotropy and quality: orientations, noise, kernel widths, camera distances."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphereorient.report.plots import style as look
from sphereorient.statistics import Moments
from sphereorient.statistics.cameras import CameraDistance
from sphereorient.statistics.isotropy import EulerDensity, Isotropy, Uniformity
from sphereorient.statistics.moments import WARN_SHARE
from sphereorient.statistics.noise import WidthCurve
from sphereorient.statistics.segments import UNITS
from sphereorient.trajectory.datasets import in_length

Floats = NDArray[np.float64]

BAR, BESIDE = 0.24, 0.2  # width of a bar, distance of components, where quantities are 1 apart
NOISE_WORDS = {"added": "noise in the variance (%)", "removed": "variance smoothed away (%)"}
WIDTHS_OF = ("acceleration", "alpha_lab")


def quality_figures(of: look.Reported) -> Iterator[look.Plan]:
    """Yield the figures of this file in a report."""
    summary, _, distances = of
    if any(len(one.distance_rad) for one in distances):
        title = "Distance of the cameras (Figure 8 of the paper)"
        caption = "PDF of the angle between two cameras' own orientations."
        yield "camera_distance", title, caption, partial(camera_distance_figure, distances)
    if summary.ensemble.segments:
        caption = "Share of each variance that is noise, or was smoothed away."
        yield "noise", "Noise", caption, partial(noise_figure, summary.table, summary.ensemble.error)
    if (more := summary.distributions) is None:
        return
    caption = "Rms and flatness by the width of a Gaussian kernel; a plateau is the motion's value."
    yield "kernel_widths", "Kernel widths", caption, partial(widths_figure, more.widths)
    caption = "Euler angles against the law of uniform orientations."
    yield "angles", "Angles (Figure 10 of the paper)", caption, partial(angles_figure, more.angles, more.uniformity)
    caption = "Shares of the components in the variance, in the lab and in the body."
    yield "isotropy", "Isotropy", caption, partial(isotropy_figure, more.isotropies)


@look.in_style
def angles_figure(angles: Sequence[EulerDensity], uniformity: Uniformity) -> Figure:
    """Draw PDFs of the Euler angles and of uniform rotations. Source: the paper, section II; docs/errata.md E1."""
    figure = look.new_figure(look.WIDTH_IN, 2.9)
    panels = figure.subplots(1, len(angles), sharey=True, squeeze=False)[0]
    for axes, angle, style in zip(panels, angles, look.COMPONENTS, strict=True):
        edges_deg = np.rad2deg(angle.edges_rad)
        look.points(axes, (edges_deg[1:] + edges_deg[:-1]) / 2, angle.pdf.scaled(np.pi / 180), style, angle.name)
        axes.stairs(angle.uniform * np.pi / 180, edges_deg, baseline=None, **look.SECOND.drawn)
        ticks = np.arange(edges_deg[0], edges_deg[-1] + 1, 45 if edges_deg[-1] < 100 else 90)
        axes.set(xlim=(edges_deg[0], edges_deg[-1]), xticks=ticks, xlabel=rf"$\theta_{angle.name[-1]}$ (degrees)")
    panels[0].set(ylabel="PDF (1/degree)", ylim=(0.0, None))
    bins = look.PLAIN.handle("bins with intervals", marker="o", linestyle="none")
    look.legend_of_figure(figure, [bins, look.SECOND.handle("all orientations equally likely")], ncols=2)
    words, of = "uniformity of the orientations could not be tested", uniformity
    if np.isfinite(of.p_value):
        found = "the orientations agree with uniformity" if of.uniform else "the orientations are not uniform"
        words = f"{found}: {look.p_value_text(of.p_value)}, test on SO(3) of {of.samples:,} frames "
        words += f"in {of.segments:,} segments, worth {of.effective:,.0f} independent orientations"
    look.note(figure, words)
    return figure


@look.in_style
def isotropy_figure(isotropies: Mapping[str, Isotropy]) -> Figure:
    """Draw each component's share in the variance, and p-values. Source: the paper, Table I, with docs/errata.md E6."""
    figure = look.new_figure(look.WIDTH_IN, 3.2)
    axes = figure.subplots()
    for k, one in enumerate(isotropies.values()):
        share = one.variance_share.scaled(100.0)
        for i, style in enumerate(look.COMPONENTS):
            look.points(axes, np.array([k + (i - 1) * BESIDE]), share.part(slice(i, i + 1)), style, style.name)
    axes.axhline(100 / 3, label="a third", **look.SECOND.drawn)
    labels = [f"{look.in_frame(name)}\n{look.p_value_text(one.p_value)}" for name, one in isotropies.items()]
    axes.set_xticks(np.arange(len(labels)), labels)
    axes.grid(visible=False, axis="x")
    axes.set(xlabel="vector and its frame, p-value of isotropy (–)", ylabel="share in the variance (%)")
    axes.set_xlim(-0.5, len(labels) - 0.5)
    handles = [style.handle(style.name, marker=style.marker, linestyle="none") for style in look.COMPONENTS]
    look.legend_of_figure(figure, [*handles, look.SECOND.handle("isotropic: a third")], ncols=4)
    return figure


@look.in_style
def noise_figure(table: Mapping[str, Moments], error: Literal["added", "removed"] = "added") -> Figure:
    """Draw the share of noise in each variance; `error`: `Ensemble.error`. Source: docs/statistics.md, Noise."""
    figure = look.new_figure(look.WIDTH_IN, 3.2)
    axes = figure.subplots()
    shares = [one.noise_share.part(slice(0, 3)).scaled(100.0) for one in table.values()]
    known = np.concatenate([np.empty(0), *(share.value for share in shares)])
    known = np.log10(known[np.isfinite(known) & (known > 0)])
    # Where bars begin on a logarithmic axis, a decade below the least; 0: the axis is linear.
    floor = float(10.0 ** (np.floor(known.min()) - (known.min() % 1 < 0.3))) if len(known) else 0.0
    bars = []
    for i, style in enumerate(look.COMPONENTS):
        at = np.arange(len(shares)) + (i - 1) * BAR
        value, low, high = (np.array([float(getattr(s, key)[i]) for s in shares]) for key in ("value", "low", "high"))
        drawn: dict[str, Any] = {"color": style.colour, "edgecolor": "white", "hatch": style.hatch}
        bars.append(axes.bar(at, value - floor, BAR, bottom=floor, label=style.name, **drawn))
        there = np.isfinite(low) & np.isfinite(high)
        axes.vlines(at[there], np.maximum(low[there], floor), high[there], color="black", linewidth=1.0)
    limit = axes.axhline(100 * WARN_SHARE, label=f"{100 * WARN_SHARE:.0f} %: worth a warning", **look.SECOND.drawn)
    axes.set_xticks(np.arange(len(table)), [look.in_frame(name) for name in table])
    axes.grid(visible=False, axis="x")
    axes.set(xlabel="vector and its frame (–)", ylabel=NOISE_WORDS[error])
    top = max([100 * WARN_SHARE, *(float(np.nan_to_num([s.value, s.high]).max()) for s in shares)])
    axes.set(yscale="log" if floor else "linear", ylim=(floor, (1.5 if floor else 1.2) * top))
    if floor:
        look.plain_logarithms(axes.yaxis)
    look.legend_above(axes, ncols=4, handles=[*bars, limit])
    if not any(np.isfinite(share.value).any() for share in shares):
        look.say_empty(axes, "the errors of this track are unknown")
    return figure


@look.in_style
def widths_figure(widths: Mapping[str, WidthCurve]) -> Figure:
    """Draw rms, flatness and share of noise of a and alpha, else of velocity, against the kernel's width.
    Filled markers are corrected for the expected noise; their plateau over several widths is the motion's value.
    Source: Voth et al. 2002, J. Fluid Mech. 469, 121; the paper, section III.
    """
    shown = [name for name in WIDTHS_OF if name in widths] or list(widths)[:1]
    figure = look.new_figure(look.WIDTH_IN * len(shown) / 2, 6.6)
    panels = figure.subplots(3, len(shown), sharex="col", squeeze=False)
    for column, name in zip(panels.T, shown, strict=True):
        _widths_column(column, widths[name])
    figure.align_ylabels()
    x, y, z = (style.handle(style.name, marker=style.marker) for style in look.COMPONENTS)
    corrected = look.PLAIN.handle("corrected for noise", marker="o")
    measured = look.PLAIN.handle("as measured", marker="o", markerfacecolor="white", linestyle="none")
    limit = look.SECOND.handle(f"{100 * WARN_SHARE:.0f} % of the variance")
    look.legend_of_figure(figure, [x, corrected, y, measured, z, limit], ncols=3)
    return figure


def _widths_column(panels: NDArray[np.object_], curve: WidthCurve) -> None:
    rms, flatness, share = panels
    symbol, unit = look.SYMBOLS[curve.quantity], look.superscript(in_length(UNITS[curve.quantity], curve.length_unit))
    width_ms = 1e3 * curve.width_s
    nudge = 0.04 * float(np.min(np.diff(width_ms))) if len(width_ms) > 1 else 0.0
    open_ = {"markerfacecolor": "white", "linestyle": "none"}
    for i, style in enumerate(look.COMPONENTS):
        x, column = width_ms + (i - 1) * nudge, (slice(None), i)
        for axes, kind in ((rms, "rms"), (flatness, "flatness")):
            corrected, measured = getattr(curve, f"corrected_{kind}"), getattr(curve, kind)
            look.points(axes, x, corrected.part(column), style, f"{style.name}, corrected", joined=True)
            label = f"{style.name}, measured"
            axes.plot(x, measured.value[column], marker=style.marker, color=style.colour, label=label, **open_)
        look.points(share, x, curve.noise_share.part(column).scaled(100.0), style, style.name, joined=True)
    share.axhline(100 * WARN_SHARE, label="_10 %", **look.SECOND.drawn)
    if (curve.noise_share.value > 0).any():
        share.set_yscale("log")
        look.plain_logarithms(share.yaxis)
    rms.set(ylim=(0.0, None), ylabel=f"rms of {symbol} ({unit})")  # from zero, so that a plateau looks level
    flatness.set_ylabel(f"flatness of {symbol} (–)")
    share.set(xlabel="kernel width σ (ms)", ylabel=f"noise in the variance of {symbol} (%)")


@look.in_style
def camera_distance_figure(distances: Sequence[CameraDistance]) -> Figure:
    """Draw the PDF of the distance of the cameras' orientations and its median, a panel for each pair of cameras.
    Source: the paper, section III, distance of the two cameras; the sign of the correction by docs/errata.md A1.
    """
    figure = look.new_figure(look.WIDTH_IN * 0.7, 2.9 * len(distances))
    panels = figure.subplots(len(distances), 1, squeeze=False)[:, 0]
    for axes, distance in zip(panels, distances, strict=True):
        axes.set(xlabel="distance of two cameras' orientations (degrees)", ylabel="PDF (1/degree)")
        _distance_panel(axes, distance)
    return figure


def _distance_panel(axes: Axes, distance: CameraDistance) -> None:
    names = " and ".join(distance.cameras)
    corrected = "distance" if distance.uncorrected_rad is None else "perspective corrected"
    known: list[tuple[Any, Any, look.LineStyle, str]] = [
        (distance.distance_rad, distance.pdf, look.ALL, corrected),
        (distance.uncorrected_rad, distance.uncorrected_pdf, look.SECOND, "not corrected"),
    ]
    laws = [(np.rad2deg(of), pdf, style, what) for of, pdf, style, what in known if of is not None and len(of)]
    if not laws:
        look.say_empty(axes, f"no frame in which {names} both have an orientation")
        return
    edges = np.rad2deg(distance.edges_rad)
    nearest = min(float(np.median(law[0])) for law in laws)
    # Medians: even bins with a longer range show the smaller distances as one bar.
    even = edges[-1] <= 15.0 * nearest or not nearest
    if not even:
        # The smaller median over the first of the geometric bins.
        edges = np.geomspace(nearest / 30.0, edges[-1] * (1 + 1e-9), 36 + 1)
    for values, pdf, style, what in laws:
        if even:
            pdf = pdf * np.pi / 180
        else:  # NaN in empty bins
            counts, _ = np.histogram(values, edges)
            pdf = np.where(counts > 0, counts / len(values) / np.diff(edges), np.nan)
        median = float(np.median(values))
        label = f"{what}: median {median:.2g}° of {len(values):,} frames"
        axes.stairs(pdf, edges, color=style.colour, linestyle=style.line, linewidth=1.2, label=label)
        axes.axvline(median, color=style.colour, linestyle=style.line, linewidth=0.8)
    if even:
        axes.set(xlim=(0.0, float(edges[-1])), ylim=(0.0, None))
    else:
        axes.set(xscale="log", yscale="log", xlim=(edges[0], 1.2 * edges[-1]))
        look.plain_logarithms(axes.xaxis)
        look.plain_logarithms(axes.yaxis)
    look.legend_above(axes, title=names)
