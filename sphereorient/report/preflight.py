"""The picture of a check: the cameras' views, their agreement, the texture map, and all findings."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sphereorient.preflight import Preflight, Severity
from sphereorient.preflight.diameter import expected_outline_px
from sphereorient.preflight.gap import gaps_between
from sphereorient.preflight.look import Look
from sphereorient.preflight.offset import REACH
from sphereorient.report.plots.style import AXIS_COLOURS, GREY, in_style, new_figure, say_empty, write_figure

EXPECTED, FOUND, USED = AXIS_COLOURS
# Shape and colour: readable without colours, and by colour-blind readers.
MARKS = {Severity.OK: ("\u25cf", FOUND), Severity.WARNING: ("\u25b2", "#E69F00"), Severity.FAULT: ("\u2716", EXPECTED)}
WIDTH, PICTURE, LINE = 13.0, 3.3, 0.165  # inches: of the figure, of a row of pictures, of a line of text
CHARACTERS = 145  # in a line of the list


@in_style
def preflight_figure(result: Preflight, path: Path) -> None:
    """Draw a frame of each camera with outlines, the gap against the frame offset, the texture map, and the findings.

    Args:
        result: of `preflight`.
        path: of the PNG or PDF to write.
    """
    lines = _lines(result)
    compared = result.steps is not None or result.texture is not None
    heights = [PICTURE, PICTURE if compared else 0.01, LINE * (len(lines) + 2)]
    figure = new_figure(WIDTH, sum(heights))
    top, middle, bottom = np.ravel(figure.subfigures(3, 1, height_ratios=heights, squeeze=False))
    _cameras_part(top, result)
    if compared:
        gap, balance, pair = middle.subplots(1, 3, width_ratios=[1.1, 1.5, 1.4])
        _draw_gap(gap, result)
        _draw_balance(balance, result)
        _draw_alike(pair, result)
    for k, (severity, title, text, advice) in enumerate(lines):
        y = 1 - LINE * (k + 0.8) / heights[2]
        if severity is not None:
            mark, colour = MARKS[severity]
            bottom.text(0.012, y, mark, color=colour, fontsize=9, va="center")
            bottom.text(0.03, y, title, weight="bold", va="center")
        bottom.text(0.18, y, text, va="center", style="italic" if advice else "normal")
    figure.suptitle(str(result.experiment.path), fontsize=10)
    write_figure(figure, path, dpi=110)


def _cameras_part(part: Any, result: Preflight) -> None:
    """Draw for each camera the whole frame and the sphere, with the outline found and the one expected."""
    looks, expected, k = result.looks, {}, 0
    if looks:  # the frame with the clearest outlines in all cameras
        coverage = torch.stack([torch.nan_to_num(look.sightings.coverage, nan=-1.0) for look in looks]).amin(0)
        k = int(coverage.argmax())
    diameter_mm = result.experiment.diameter_mm
    if len(looks) == 2 and diameter_mm is not None:
        gaps = gaps_between([look.camera for look in looks], [look.sightings.centre_px[k : k + 1] for look in looks])
        position = gaps.position_lab_mm[0]
        if bool(torch.isfinite(position).all()):
            outlines = {look.name: expected_outline_px(look.camera, position, diameter_mm / 2) for look in looks}
            expected = {name: outline.numpy() for name, outline in outlines.items()}
    axes = part.subplots(1, 4)
    for place, ax in enumerate(axes):
        ax.grid(visible=False)
        if place // 2 >= len(looks):
            ax.set_axis_off()
            continue
        look = looks[place // 2]
        _draw_frame(ax, look, k, expected.get(look.name), near=place % 2 == 1)
    if looks and axes[0].lines:
        axes[0].legend(loc="lower left", frameon=True, framealpha=0.8)


def _draw_frame(ax: Any, look: Look, k: int, expected: NDArray[np.float64] | None, near: bool) -> None:
    picture, (outline, reason) = look.picture[k], look.found[k]
    ax.set(xticks=[], yticks=[])
    if picture is None:
        picture = np.zeros(look.movie.frame_shape)
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
        what = f"frame {int(look.frame[k])}" if outline is not None else f"no ball: {reason}"
        ax.set_title(f"{look.name}, {what}", fontsize=9)
        return
    reach = 1.35 * outline.radius_px
    ax.set(xlim=(outline.u_px - reach, outline.u_px + reach), ylim=(outline.v_px + reach, outline.v_px - reach))
    ax.set_title(f"{look.name}: {2 * outline.radius_px:.1f} px across", fontsize=9)


def _draw_gap(ax: Any, result: Preflight) -> None:
    steps = result.steps
    if steps is None:
        ax.set_axis_off()
        say_empty(ax, "one camera: no gap")
        return
    ax.plot(steps.offset, steps.gap_px, "o-", ms=4, lw=1.2, color=USED, label="gap")
    ax.plot(steps.offset, steps.varying_px, ".:", ms=4, lw=1, color=GREY, label="without its constant part")
    ax.axvline(0, lw=0.8, color="#444444")
    if not math.isnan(steps.best):
        ax.axvline(steps.best, ls="--", lw=1.2, color=EXPECTED, label=f"least at {steps.best:+.2f}")
    ax.set(xlabel=f"frames later in {steps.names[1]}", ylabel="gap of the lines of sight (px)")
    ax.set(xlim=(-REACH - 0.5, REACH + 0.5), ylim=(0, None))
    ax.xaxis.set_major_locator(MaxNLocator(9, integer=True))
    ax.legend(frameon=True, framealpha=0.8)
    ax.set_title("synchronisation of the movies", fontsize=9)


def _draw_balance(ax: Any, result: Preflight) -> None:
    """Draw the texture map with the brightness of the views."""
    ax.grid(visible=False)
    if result.texture is None or result.paint is None:
        ax.set_axis_off()
        say_empty(ax, "no map of the paint")
        return
    span = (-180, 180, -90, 90)
    ax.imshow(result.texture.numpy(), cmap="gray", vmin=0, vmax=1, extent=span, interpolation="nearest")
    seen = result.paint.view_brightness.numpy()
    longitude = (np.arange(seen.shape[1]) + 0.5) * (360 / seen.shape[1]) - 180
    latitude = 90 - (np.arange(seen.shape[0]) + 0.5) * (180 / seen.shape[0])
    if seen.max() - seen.min() > 1e-6:
        drawn = ax.contour(longitude, latitude, 100 * seen, levels=6, colors=EXPECTED, linewidths=1.2)
        ax.clabel(drawn, fmt="%.0f %%", fontsize=7)
    ax.set(xticks=[-180, -90, 0, 90, 180], yticks=[-90, 0, 90])
    ax.set(xlabel="longitude on the ball (degrees)", ylabel="latitude (degrees)")
    ax.set_title(
        f"the map; lines: brightness of the view from there, {100 * seen.min():.0f} to {100 * seen.max():.0f} %",
        fontsize=9,
    )


def _draw_alike(ax: Any, result: Preflight) -> None:
    """Draw the two views that look most alike."""
    ax.set_axis_off()
    if (alike := result.alike) is None:
        return
    title = f"most alike, {math.degrees(alike.angle_rad):.0f} degrees apart: {100 * alike.score:.0f} % explained"
    ax.set_title(title, fontsize=9)
    for k, view in enumerate(alike.pictures.numpy()):
        inset = ax.inset_axes((0.02 + 0.5 * k, 0.0, 0.46, 0.98))
        inset.imshow(view, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        inset.set_axis_off()


def _lines(result: Preflight) -> list[tuple[Severity | None, str, str, bool]]:
    """Return the findings line by line, faults first: mark, title, text, whether it is the remedy."""
    lines: list[tuple[Severity | None, str, str, bool]] = []
    order = list(Severity)
    for finding in sorted(result.findings, key=lambda one: -order.index(one.severity)):
        mark: Severity | None = finding.severity
        title = finding.title
        for text in textwrap.wrap(finding.measured, CHARACTERS):
            lines.append((mark, title, text, False))
            mark, title = None, ""
        if finding.advice:
            lines += [(None, "", text, True) for text in textwrap.wrap(f"do: {finding.advice}", CHARACTERS)]
    return lines
