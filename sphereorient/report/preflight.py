"""The figure of a check: pictures of the cameras, their agreement, the texture map, and all findings."""

import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sphereorient.preflight import Preflight, Severity
from sphereorient.preflight.cameras import REACH, expected_outline_px, sample_gaps
from sphereorient.preflight.sample import MovieSample

FOUND, EXPECTED, USED = "#009E73", "#D55E00", "#0072B2"  # Okabe and Ito's
# Shape and colour both: readable without colours, and by colour-blind readers.
MARKS = {
    Severity.OK: ("\u25cf", "#009E73"),
    Severity.WARNING: ("\u25b2", "#E69F00"),
    Severity.FAULT: ("\u2716", "#D55E00"),
}
WIDTH, PICTURE, LINE = 13.0, 3.3, 0.165  # inches: of the figure, of a row of pictures, of a line of text
CHARACTERS = 145  # in a line of the list


def preflight_figure(result: Preflight, path: Path) -> None:
    """Write a PNG or PDF: a frame of each camera with outlines, the gap by offset, texture map, and findings."""
    lines = _lines(result)
    agreement = result.scan is not None or result.texture is not None
    heights = [PICTURE, PICTURE if agreement else 0.01, LINE * (len(lines) + 2)]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    top, middle, bottom = np.ravel(figure.subfigures(3, 1, height_ratios=heights, squeeze=False))
    _cameras_part(top, result)
    if agreement:
        gap, balance, pair = middle.subplots(1, 3, width_ratios=[1.1, 1.5, 1.4])
        _draw_gap(gap, result)
        _draw_texture(balance, result)
        _draw_pair(pair, result)
    _list_part(bottom, lines, heights[2])
    figure.suptitle(str(result.experiment.path), fontsize=10)
    figure.savefig(path, dpi=110)


def _cameras_part(part: Any, result: Preflight) -> None:
    coverage = torch.stack([torch.nan_to_num(one.sightings.coverage, nan=-1.0) for one in result.samples]).amin(0)
    k = int(coverage.argmax())
    axes = part.subplots(1, 4)
    for ax in axes[2 * len(result.samples) :]:
        ax.set_axis_off()
    for sample, pair in zip(result.samples, axes.reshape(2, 2), strict=False):
        expected = _expected_px(result, sample, k)
        for ax, near in zip(pair, (False, True), strict=True):
            _draw_frame(ax, sample, k, expected, near)
    if axes[0].lines:
        axes[0].legend(loc="lower left", fontsize=7, framealpha=0.8)


def _expected_px(result: Preflight, sample: MovieSample, k: int) -> NDArray[np.float64] | None:
    """Return the outline expected from both cameras and the diameter, (n, 2) px; None if unknown."""
    if result.scan is None or result.experiment.diameter_mm is None:
        return None
    position = sample_gaps(result.samples).position_lab_mm[k]
    if not bool(torch.isfinite(position).all()):
        return None
    return expected_outline_px(sample.camera, position, result.experiment.diameter_mm / 2).numpy()


def _draw_frame(ax: Any, sample: MovieSample, k: int, expected: NDArray[np.float64] | None, near: bool) -> None:
    picture, (outline, reason) = sample.picture[k], sample.found[k]
    ax.set(xticks=[], yticks=[])
    if picture is None:
        picture = np.zeros(sample.stream.movie.frame_shape)
    ax.imshow(picture, cmap="gray", vmin=0, vmax=max(1.0, float(np.percentile(picture, 99.8))))
    if outline is not None:
        angle = np.linspace(0, 2 * np.pi, 181)
        u, v = outline.u_px + outline.radius_px * np.cos(angle), outline.v_px + outline.radius_px * np.sin(angle)
        ax.plot(u, v, lw=1.4, color=FOUND, label="outline found")
    if expected is not None:
        closed = np.concatenate([expected, expected[:1]])
        ax.plot(*closed.T, "--", lw=1.4, color=EXPECTED, label="expected from both cameras and the diameter")
    height, width = picture.shape
    if not near or outline is None:
        ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        what = f"frame {int(sample.frame[k])}" if outline is not None else f"no ball: {reason}"
        ax.set_title(f"{sample.name}, {what}", fontsize=9)
        return
    reach = 1.35 * outline.radius_px
    ax.set(xlim=(outline.u_px - reach, outline.u_px + reach), ylim=(outline.v_px + reach, outline.v_px - reach))
    ax.set_title(f"{sample.name}: {2 * outline.radius_px:.1f} px across", fontsize=9)


def _draw_gap(ax: Any, result: Preflight) -> None:
    scan = result.scan
    if scan is None:
        _no_data(ax, "one camera: no gap")
        return
    ax.plot(scan.offset, scan.gap_px, "o-", ms=4, lw=1.2, color=USED, label="gap")
    ax.plot(scan.offset, scan.varying_px, ".:", ms=4, lw=1, color="#777777", label="without its constant part")
    ax.axvline(0, lw=0.8, color="#444444")
    if not math.isnan(scan.best):
        ax.axvline(scan.best, ls="--", lw=1.2, color=EXPECTED, label=f"least at {scan.best:+.2f}")
    ax.set(xlabel=f"frames later in {scan.names[1]}", ylabel="gap of the lines of sight (px)")
    ax.set(xlim=(-REACH - 0.5, REACH + 0.5), ylim=(0, None))
    ax.xaxis.set_major_locator(MaxNLocator(9, integer=True))
    ax.legend(fontsize=7, framealpha=0.8)
    ax.set_title("are the movies in step", fontsize=9)


def _draw_texture(ax: Any, result: Preflight) -> None:
    if result.texture is None or result.measures is None:
        _no_data(ax, "no map of the paint")
        return
    span = (-180, 180, -90, 90)
    ax.imshow(result.texture.numpy(), cmap="gray", vmin=0, vmax=1, extent=span, interpolation="nearest")
    seen = 100 * result.measures.view_brightness.numpy()
    longitude = (np.arange(seen.shape[1]) + 0.5) * (360 / seen.shape[1]) - 180
    latitude = 90 - (np.arange(seen.shape[0]) + 0.5) * (180 / seen.shape[0])
    if np.ptp(seen) > 1e-4:
        drawn = ax.contour(longitude, latitude, seen, levels=6, colors=EXPECTED, linewidths=1.2)
        ax.clabel(drawn, fmt="%.0f %%", fontsize=7)
    ax.set(xticks=[-180, -90, 0, 90, 180], yticks=[-90, 0, 90])
    ax.tick_params(labelsize=7)
    ax.set_xlabel("longitude on the ball (degrees)", fontsize=8)
    ax.set_ylabel("latitude", fontsize=8)
    title = f"the map; lines: brightness of the view from there, {seen.min():.0f} to {seen.max():.0f} %"
    ax.set_title(title, fontsize=9)


def _draw_pair(ax: Any, result: Preflight) -> None:
    ax.set_axis_off()
    if result.similar is None:
        return
    angle, explained = math.degrees(result.similar.angle_rad), 100 * result.similar.score
    ax.set_title(f"most alike, {angle:.0f} degrees apart: {explained:.0f} % explained", fontsize=9)
    for k, view in enumerate(result.similar.pictures.numpy()):
        inset = ax.inset_axes((0.02 + 0.5 * k, 0.0, 0.46, 0.98))
        inset.imshow(view, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        inset.set_axis_off()


def _no_data(ax: Any, text: str) -> None:
    ax.set_axis_off()
    ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes, fontsize=9)


def _lines(result: Preflight) -> list[tuple[Severity | None, str, str, bool]]:
    """Return the findings line by line, faults first: mark, title, text, whether it is advice."""
    lines: list[tuple[Severity | None, str, str, bool]] = []
    order = list(Severity)
    for finding in sorted(result.findings, key=lambda one: -order.index(one.severity)):
        first, *more = textwrap.wrap(finding.measured, CHARACTERS) or [""]
        lines.append((finding.severity, finding.title, first, False))
        lines += [(None, "", text, False) for text in more]
        if finding.advice:
            lines += [(None, "", text, True) for text in textwrap.wrap(f"do: {finding.advice}", CHARACTERS)]
    return lines


def _list_part(part: Any, lines: list[tuple[Severity | None, str, str, bool]], height: float) -> None:
    for k, (severity, title, text, advice) in enumerate(lines):
        y = 1 - LINE * (k + 0.8) / height
        if severity is not None:
            mark, colour = MARKS[severity]
            part.text(0.012, y, mark, color=colour, fontsize=9, va="center")
            part.text(0.03, y, title, fontsize=8, weight="bold", va="center")
        part.text(0.18, y, text, fontsize=8, va="center", style="italic" if advice else "normal")
