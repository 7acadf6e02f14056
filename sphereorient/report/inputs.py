"""Figures of the inputs: a movie's frames, a calibration, and the check before a run."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sphereorient.calibration.calibrated import Calibrated, PictureReport
from sphereorient.calibration.comparison import LATEST
from sphereorient.experiment.recording import spread_frames
from sphereorient.files.picture import decoded_grey
from sphereorient.movies import Movie
from sphereorient.movies.survey import BRIGHT_QUANTILE, Survey, SurveyedFrame
from sphereorient.preflight import Finding, Preflight, Severity
from sphereorient.preflight.cameras import expected_outline_px, sample_positions
from sphereorient.preflight.first_look import FirstLook
from sphereorient.preflight.sample import MovieSample
from sphereorient.report.plots.style import AXIS_COLOURS, in_style, new_figure, say_empty, write_figure
from sphereorient.report.texture_map import draw_map

Floats = NDArray[np.float64]
EXPECTED, FOUND, USED = AXIS_COLOURS
OUTLIER = "#CC79A7"
# Shape and colour: readable without colours, and by colour-blind readers.
MARKS = {Severity.OK: ("\u25cf", FOUND), Severity.WARNING: ("\u25b2", "#E69F00"), Severity.FAULT: ("\u2716", EXPECTED)}
WIDTH = 13.0  # inches, of the figures, and of:
COLUMNS, TITLE, HEAD = 6, 0.27, 0.8  # of a contact sheet: frames in a row; the line above a frame, the title
PICTURE, LINE = 3.3, 0.165  # of a check: a row of pictures, a line of text
SHOWN = 3  # pictures of each camera
NEAR = 1.4  # of the radius: half the side of a picture of the ball
CHARACTERS = 145  # in a line of the list


@in_style
def contact_sheet(movie: Movie, seen: Survey, path: Path) -> None:
    """Draw the frames of a survey of a movie, on one scale of grey, into a PNG or PDF."""
    rows = math.ceil(len(seen.frames) / COLUMNS)
    height, width = movie.frame_shape
    figure = new_figure(WIDTH, HEAD + rows * ((WIDTH / COLUMNS) * height / width + TITLE))
    known = [(frame.small, frame.fault) for frame in seen.frames if frame.small is not None]
    good = [grey for grey, fault in known if not fault] or [grey for grey, _ in known]
    values = np.concatenate([part.ravel() for part in good]) if good else np.zeros(1)
    black = float(values.min())
    white = max(float(np.quantile(values, BRIGHT_QUANTILE)), black + 1)
    title = f"{movie.path.name}: {len(movie)} frames of {width} x {height} px, {8 * movie.dtype.itemsize} bit\n"
    figure.suptitle(f"{title}grey levels {black:.0f} (black) to {white:.0f} (white)", fontsize=11)
    axes = np.ravel(figure.subplots(rows, COLUMNS, squeeze=False))
    for ax, frame in zip(axes, seen.frames, strict=False):
        _draw_frame(ax, frame, movie, black, white)
    for ax in axes[len(seen.frames) :]:
        ax.set_axis_off()
    write_figure(figure, path, dpi=110)


def _draw_frame(ax: Any, frame: SurveyedFrame, movie: Movie, black: float, white: float) -> None:
    height, width = movie.frame_shape
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)  # row 0 on top
    picture = np.zeros((1, 1)) if frame.small is None else frame.small
    ax.imshow(picture, cmap="gray", vmin=black, vmax=white, extent=edges, interpolation="nearest")
    ax.set(xticks=[], yticks=[], xlim=edges[:2], ylim=edges[2:])
    title = f"{frame.number}"
    if movie.times_s is not None:
        time_s = float(movie.times_s[frame.number])
        title += f", {time_s:.6g} s" if abs(time_s) >= 1 or not time_s else f", {1e3 * time_s:.5g} ms"
    ax.set_title(title, fontsize=8, pad=2)
    if frame.fault:
        ax.set_title(f"{title}: {frame.fault}", fontsize=8, pad=2, color=EXPECTED, fontweight="bold")
        for spine in ax.spines.values():
            spine.set(color=EXPECTED, linewidth=2)


@in_style
def calibration_figure(result: Calibrated, path: Path) -> None:
    """Draw the pictures with points found and expected, and all residuals, into a PNG or PDF."""
    names = list(result.cameras)
    figure = new_figure(4.2 * (SHOWN + 2), 4.3 * len(names))
    if result.verdict:
        figure.suptitle("\n".join(["doubtful", *result.verdict]), color=OUTLIER)
    axes = figure.subplots(len(names), SHOWN + 2, squeeze=False)
    for row, name in zip(axes, names, strict=True):
        used = [one for one in result.pictures if one.picture.camera == name and not one.reason]
        chosen = [used[k] for k in spread_frames(range(len(used)), SHOWN)]
        for ax in row:
            ax.grid(visible=False)
        for ax, one in zip(row, chosen, strict=False):
            _draw_picture(ax, one)
        for ax in row[len(chosen) : SHOWN]:
            ax.set_axis_off()
        row[0].set_ylabel(name, fontsize=12)
        place = np.concatenate([np.zeros((0, 2)), *(one.view.uv_px[one.used] for one in used)])
        missed = np.concatenate([np.zeros((0, 2)), *(one.residual_px[one.used] for one in used)])
        _draw_residuals(row[SHOWN], place, missed, result.cameras[name].image_size)
        _draw_histogram(row[SHOWN + 1], missed, result.rms_px(name))
    write_figure(figure, path, dpi=110)


def _draw_picture(ax: Any, one: PictureReport) -> None:
    picture = decoded_grey(one.picture.path.read_bytes())
    if picture is not None:  # a table of points has no picture
        ax.imshow(picture, cmap="gray")
    else:
        ax.set_aspect("equal")
        ax.invert_yaxis()
    found = one.view.uv_px
    ax.plot(*(found - one.residual_px).T, "+", ms=7, mew=0.9, color=EXPECTED, label="expected")
    ax.plot(*found.T, "o", ms=4, mfc="none", mew=0.8, color=FOUND, label="found")
    if not one.used.all():
        ax.plot(*found[~one.used].T, "x", ms=8, color=OUTLIER, label="left out")
    ax.set(xticks=[], yticks=[])
    ax.set_title(f"pose {one.pose}: {len(found)} points, rms {one.rms_px:.3f} px", fontsize=9)
    ax.legend(loc="lower right", frameon=True, framealpha=0.8)


def _draw_residuals(ax: Any, place: Floats, missed: Floats, image_size: tuple[int, int]) -> None:
    usual = float(np.sqrt((missed**2).sum(1).mean())) if len(missed) else 1.0
    # An arrow of the usual length spans a fortieth of the picture.
    times = image_size[0] / 40 / max(usual, 1e-9)
    style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.002, "color": EXPECTED, "alpha": 0.7}
    ax.quiver(*place.T, *(times * missed.T), **style)
    ax.set(xlim=(0, image_size[0]), ylim=(image_size[1], 0), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    ax.set_title(f"found minus expected, {times:.0f} times", fontsize=9)


def _draw_histogram(ax: Any, missed: Floats, rms_px: float) -> None:
    reach = 4 * max(rms_px, 1e-6) / np.sqrt(2)
    for part, colour, label in zip(missed.T, (FOUND, EXPECTED), ("u", "v"), strict=True):
        ax.hist(part, np.linspace(-reach, reach, 41), histtype="step", lw=1.5, color=colour, label=label)
    ax.set(xlabel="found minus expected (px)", ylabel="points")
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_title(f"all pictures: rms {rms_px:.3f} px", fontsize=9)
    ax.legend()


@in_style
def first_look_figure(looks: Sequence[FirstLook], path: Path) -> None:
    """Draw a frame of each movie, whole and enlarged at the ball, into a PNG or PDF."""
    figure = new_figure(2.6 * PICTURE, PICTURE * len(looks) + 0.3)
    for look, (whole, near) in zip(looks, figure.subplots(len(looks), 2, squeeze=False), strict=True):
        for ax in (whole, near):
            _show(ax, look.picture)
        if look.outline is None:
            near.set_axis_off()
            whole.set_title(f"{look.name}: no ball was found", fontsize=9)
            continue
        _outlined(whole, look.outline.circle)
        _outlined(near, look.outline.circle, near=True)
        if look.differs and look.given is not None:
            _outlined(near, look.given, lw=1.0, ls="--", color=EXPECTED)
        where, frame = ("is fixed", "") if look.stays else ("moves", f" in frame {look.frame}")
        doubt = "DOUBTFUL outline" if look.doubtful else "outline"
        whole.set_title(f"{look.name}, {Path(look.movie.path).name}: the ball {where}", fontsize=9)
        dashed = f"; given (dashed): {2 * look.given[2]:.1f} px" if look.differs and look.given else ""
        near.set_title(f"{doubt}{frame}, {2 * look.outline.radius_px:.1f} px across{dashed}", fontsize=9)
    write_figure(figure, path, dpi=110)


def _show(ax: Any, picture: NDArray[Any]) -> None:
    """Show a whole picture: black is 0, white nearly the brightest level, so that glints do not darken it."""
    height, width = picture.shape
    ax.imshow(picture, cmap="gray", vmin=0, vmax=max(1.0, float(np.percentile(picture, 99.8))))
    ax.set(xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def _outlined(ax: Any, circle: tuple[float, float, float], near: bool = False, **style: Any) -> None:
    """Draw an outline by centre and radius, px; `near`: enlarged at the ball."""
    angle, style = np.linspace(0, 2 * np.pi, 181), {"lw": 1.4, "color": FOUND} | style
    u, v, radius = circle
    ax.plot(u + radius * np.cos(angle), v + radius * np.sin(angle), **style)
    if near:
        ax.set(xlim=(u - NEAR * radius, u + NEAR * radius), ylim=(v + NEAR * radius, v - NEAR * radius))


def preflight_figure(result: Preflight, path: Path) -> None:
    """Write a PNG or PDF: a frame of each camera with outlines, the gap by offset, texture map, and findings."""
    lines = _lines(result)
    agreement = bool(result.scans) or result.texture is not None
    heights = [PICTURE, PICTURE if agreement else 0.01, LINE * (len(lines) + 2)]
    figure = new_figure(WIDTH, sum(heights))
    top, middle, bottom = np.ravel(figure.subfigures(3, 1, height_ratios=heights, squeeze=False))
    (_cameras_part if result.samples else _scene_part)(top, result)
    if agreement:
        gap, balance, pair = middle.subplots(1, 3, width_ratios=[1.1, 1.5, 1.4])
        _draw_gap(gap, result)
        _draw_texture(balance, result)
        _draw_pair(pair, result)
    _list_part(bottom, lines, heights[2])
    figure.suptitle(str(result.experiment.path), fontsize=10)
    write_figure(figure, path, dpi=110)


def _cameras_part(part: Any, result: Preflight) -> None:
    coverage = torch.stack([torch.nan_to_num(one.sightings.coverage, nan=-1.0) for one in result.samples]).amin(0)
    k = int(coverage.argmax())
    several = max(2, len(result.samples))
    axes = part.subplots(1, 2 * several)
    for ax in axes[2 * len(result.samples) :]:
        ax.set_axis_off()
    diameter_mm = result.experiment.diameter_mm
    position = sample_positions(result.samples)[k] if result.scans else torch.full((3,), torch.nan)
    for sample, pair in zip(result.samples, axes.reshape(several, 2), strict=False):
        expected = None  # by all cameras and the diameter, (n, 2) px
        if diameter_mm is not None and bool(torch.isfinite(position).all()):
            expected = expected_outline_px(sample.camera, position, diameter_mm / 2).numpy()
        for ax, near in zip(pair, (False, True), strict=True):
            _draw_ball(ax, sample, k, expected, near)
    if axes[0].lines:
        axes[0].legend(loc="lower left", fontsize=7, framealpha=0.8)


def _scene_part(part: Any, result: Preflight) -> None:
    for ax, view in zip(part.subplots(1, max(1, len(result.scene)), squeeze=False)[0], result.scene, strict=False):
        _show(ax, view.picture)
        for outline in view.disks:
            _outlined(ax, outline.circle, lw=1.2)
        for name, (u, v) in view.balls.items():
            ax.text(u, v, name, color=EXPECTED, fontsize=10, ha="center", va="center", clip_on=True)
        ax.set_title(f"{view.name}, frame {view.frame}: disks, and the balls found by their paint", fontsize=9)


def _draw_ball(ax: Any, sample: MovieSample, k: int, expected: Floats | None, near: bool) -> None:
    picture, (outline, reason) = sample.picture[k], sample.found[k]
    _show(ax, np.zeros(sample.stream.movie.frame_shape) if picture is None else picture)
    if outline is not None:
        _outlined(ax, outline.circle, near, label="outline found")
    if expected is not None:
        closed = np.concatenate([expected, expected[:1]])
        ax.plot(*closed.T, "--", lw=1.4, color=EXPECTED, label="expected from all cameras and the diameter")
    what = f", no ball: {reason}" if outline is None else f", frame {int(sample.frame[k])}"
    if near and outline is not None:
        what = f": {2 * outline.radius_px:.1f} px across"
    ax.set_title(f"{sample.name}{what}", fontsize=9)


def _draw_gap(ax: Any, result: Preflight) -> None:
    if not result.scans:
        ax.set_axis_off()
        say_empty(ax, "one camera: no gap")
        return
    ax.axvline(0, lw=0.8, color="#444444")
    single = len(result.scans) == 1
    for k, scan in enumerate(result.scans):
        of = "" if single else f", {scan.names[1]}"
        ax.plot(scan.offset, scan.gap_px, "o-", ms=4, lw=1.2, color=USED if single else f"C{k}", label=f"gap{of}")
        if single:
            ax.plot(scan.offset, scan.varying_px, ".:", ms=4, lw=1, color="#777777", label="without its constant part")
        if not math.isnan(scan.best):
            ax.axvline(scan.best, ls="--", lw=1.2, color=EXPECTED, label=f"least at {scan.best:+.2f}{of}")
    late = result.scans[0].names[1] if single else f"the other movie than in {result.scans[0].names[0]}"
    ax.set(xlabel=f"frames later in {late}", ylabel="gap of the lines of sight (px)", ylim=(0, None))
    ax.set_xlim(-LATEST - 0.5, LATEST + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(9, integer=True))
    ax.legend(fontsize=7, framealpha=0.8)
    ax.set_title("synchronisation of the movies", fontsize=9)


def _draw_texture(ax: Any, result: Preflight) -> None:
    if result.texture is None or result.measures is None:
        ax.set_axis_off()
        say_empty(ax, "no texture map")
        return
    seen = 100 * result.measures.view_brightness.numpy()
    longitude = (np.arange(seen.shape[1]) + 0.5) * (360 / seen.shape[1]) - 180
    latitude = 90 - (np.arange(seen.shape[0]) + 0.5) * (180 / seen.shape[0])
    title = f"texture map; lines: brightness of the view from there, {seen.min():.0f} to {seen.max():.0f} %"
    draw_map(ax, result.texture, title, interpolation="nearest")
    ax.title.set_fontsize(9)
    ax.tick_params(labelsize=7)
    ax.set_xlabel("longitude on the ball (degrees)", fontsize=8)
    if np.ptp(seen) > 1e-4:
        drawn = ax.contour(longitude, latitude, seen, levels=6, colors=EXPECTED, linewidths=1.2)
        ax.clabel(drawn, fmt="%.0f %%", fontsize=7)


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


def _lines(result: Preflight) -> list[tuple[Finding | None, str, str]]:
    """Return the findings line by line, faults first: the finding that starts there, text, font style."""
    lines: list[tuple[Finding | None, str, str]] = []
    order = list(Severity)
    for finding in sorted(result.findings, key=lambda one: -order.index(one.severity)):
        texts = [(text, "normal") for text in textwrap.wrap(finding.measured, CHARACTERS) or [""]]
        if finding.advice:
            texts += [(text, "italic") for text in textwrap.wrap(f"do: {finding.advice}", CHARACTERS)]
        lines += [(None if k else finding, *text) for k, text in enumerate(texts)]
    return lines


def _list_part(part: Any, lines: list[tuple[Finding | None, str, str]], height: float) -> None:
    for k, (finding, text, style) in enumerate(lines):
        y = 1 - LINE * (k + 0.8) / height
        if finding is not None:
            mark, colour = MARKS[finding.severity]
            part.text(0.012, y, mark, color=colour, fontsize=9, va="center")
            part.text(0.03, y, finding.title, fontsize=8, weight="bold", va="center")
        part.text(0.18, y, text, fontsize=8, va="center", style=style)
