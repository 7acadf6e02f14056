"""The picture that comes with a check: what the cameras show, how they agree, the paint, and all findings."""

from __future__ import annotations

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
from sphereorient.preflight.diameter import expected_outline_px
from sphereorient.preflight.gap import gaps_between
from sphereorient.preflight.look import Look
from sphereorient.preflight.offset import REACH

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
    """Draw a frame of each camera with outlines, the gap against the frame offset, the paint, and the findings.

    Args:
        result: of `preflight`.
        path: of the PNG or PDF to write.
    """
    lines = _lines(result)
    heights = [PICTURE, PICTURE if result.steps is not None or result.texture is not None else 0.01]
    heights.append(LINE * (len(lines) + 2))
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    top, middle, bottom = np.ravel(figure.subfigures(3, 1, height_ratios=heights, squeeze=False))
    _cameras_part(top, result)
    _agreement_part(middle, result)
    _list_part(bottom, lines, heights[2])
    figure.suptitle(str(result.experiment.path), fontsize=10)
    figure.savefig(path, dpi=110)


def _cameras_part(part: Any, result: Preflight) -> None:
    """Per camera the whole frame and the ball, with the outline found and the one expected."""
    looks = result.looks
    chosen = _clearest(looks)
    expected = _expected(result, chosen)
    axes = part.subplots(1, 4)
    for k, ax in enumerate(axes):
        if k // 2 >= len(looks):
            ax.set_axis_off()
            continue
        look = looks[k // 2]
        _draw_frame(ax, look, chosen, expected.get(look.name), near=k % 2 == 1)
    if looks:
        axes[0].legend(loc="lower left", fontsize=7, framealpha=0.8) if axes[0].lines else None


def _clearest(looks: tuple[Look, ...]) -> int:
    """The frame in which the outlines of all cameras are found best; the first where there is none."""
    coverage = torch.stack([torch.nan_to_num(look.sightings.coverage, nan=-1.0) for look in looks]).amin(0)
    return int(coverage.argmax())


def _expected(result: Preflight, k: int) -> dict[str, NDArray[np.float64]]:
    """Outlines where two cameras and the diameter say that they are, (n, 2) px."""
    looks, diameter_mm = result.looks, result.experiment.diameter_mm
    if len(looks) != 2 or diameter_mm is None:
        return {}
    gaps = gaps_between([look.camera for look in looks], [look.sightings.centre_px[k : k + 1] for look in looks])
    place = gaps.position_lab_mm[0]
    if not bool(torch.isfinite(place).all()):
        return {}
    return {look.name: expected_outline_px(look.camera, place, diameter_mm / 2).numpy() for look in looks}


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


def _agreement_part(part: Any, result: Preflight) -> None:
    """Gap against frame offset, brightness of the views, the two views that look most alike."""
    if result.steps is None and result.texture is None:
        return
    gap, balance, pair = part.subplots(1, 3, width_ratios=[1.1, 1.5, 1.4])
    _draw_gap(gap, result)
    _draw_balance(balance, result)
    pair.set_axis_off()
    if result.alike is None:
        return
    pair.set_title(
        f"most alike, {math.degrees(result.alike.angle_rad):.0f} degrees apart: "
        f"{100 * result.alike.score:.0f} % explained",
        fontsize=9,
    )
    for k, view in enumerate(result.alike.pictures.numpy()):
        inset = pair.inset_axes((0.02 + 0.5 * k, 0.0, 0.46, 0.98))
        inset.imshow(view, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        inset.set_axis_off()


def _draw_gap(ax: Any, result: Preflight) -> None:
    steps = result.steps
    if steps is None:
        ax.set_axis_off()
        ax.text(0.5, 0.5, "one camera: no gap", ha="center", va="center", transform=ax.transAxes, fontsize=9)
        return
    ax.plot(steps.offset, steps.gap_px, "o-", ms=4, lw=1.2, color=USED, label="gap")
    ax.plot(steps.offset, steps.varying_px, ".:", ms=4, lw=1, color="#777777", label="without its constant part")
    ax.axvline(0, lw=0.8, color="#444444")
    if not math.isnan(steps.best):
        ax.axvline(steps.best, ls="--", lw=1.2, color=EXPECTED, label=f"least at {steps.best:+.2f}")
    ax.set(xlabel=f"frames later in {steps.names[1]}", ylabel="gap of the lines of sight (px)")
    ax.set(xlim=(-REACH - 0.5, REACH + 0.5), ylim=(0, None))
    ax.xaxis.set_major_locator(MaxNLocator(9, integer=True))
    ax.legend(fontsize=7, framealpha=0.8)
    ax.set_title("are the movies in step", fontsize=9)


def _draw_balance(ax: Any, result: Preflight) -> None:
    if result.texture is None or result.paint is None:
        ax.set_axis_off()
        ax.text(0.5, 0.5, "no map of the paint", ha="center", va="center", transform=ax.transAxes, fontsize=9)
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
    ax.tick_params(labelsize=7)
    ax.set_xlabel("longitude on the ball (degrees)", fontsize=8)
    ax.set_ylabel("latitude", fontsize=8)
    ax.set_title(
        f"the map; lines: brightness of the view from there, {100 * seen.min():.0f} to {100 * seen.max():.0f} %",
        fontsize=9,
    )


def _lines(result: Preflight) -> list[tuple[Severity | None, str, str, bool]]:
    """The list of findings, line by line: mark, title, text, whether it says what to do; faults first."""
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


def _list_part(part: Any, lines: list[tuple[Severity | None, str, str, bool]], height: float) -> None:
    for k, (severity, title, text, advice) in enumerate(lines):
        y = 1 - LINE * (k + 0.8) / height
        if severity is not None:
            mark, colour = MARKS[severity]
            part.text(0.012, y, mark, color=colour, fontsize=9, va="center")
            part.text(0.03, y, title, fontsize=8, weight="bold", va="center")
        part.text(0.18, y, text, fontsize=8, va="center", style="italic" if advice else "normal")
