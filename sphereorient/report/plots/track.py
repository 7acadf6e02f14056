"""A track in six dimensions against time, with its errors."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.report.plots.marks import BAND, band, legend_of_figure, note, say_empty
from sphereorient.report.plots.part import Part, cut, shown_part
from sphereorient.report.plots.style import COMPONENTS, GREY, SHADE, WIDTH_IN, in_style, new_figure
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]

SIGMAS = 2.0  # half width of the bands
NOT_VALID: Final[dict[str, Any]] = {"facecolor": "#E8E8E8", "edgecolor": SHADE, "hatch": "//////", "linewidth": 0.0}
LATE_S, LONG_S = 10.0, 2.0  # from here on times are given in seconds
WRAP_DEG = 90.0  # no sphere turns so far from frame to frame: the angle has wrapped, or passed its pole
RATES = {
    "velocity": "velocity, lab (m/s)",
    "omega_lab": "ω, lab (rad/s)",
    "acceleration": "acceleration, lab (m/s²)",
    "alpha_lab": "α, lab (rad/s²)",
}


@in_style
def track_figure(track: Trajectory) -> Figure:
    """Draw position, Tait-Bryan angles, velocities and accelerations against time.

    Lines are the smooth motion with bands of two standard deviations, dots what was measured in single frames. Gaps
    stay open; frames that are not valid are shaded. Of a long track the best 2,000 frames of its longest segment are
    drawn, and the figure says so.

    Args:
        track: what was measured.

    Returns:
        The figure, to be written by `write_figure`.

    Source: the paper, figure of a sample track; the angles by ERRATA E1.
    """
    part = shown_part(track)
    figure = new_figure(WIDTH_IN, 7.6)
    panels = figure.subplots(3, 2, sharex=True)
    unit, time = _time(part.track)
    _position(panels[0, 0], time, part)
    _angles(panels[0, 1], time, part)
    for axes, (name, label) in zip(panels[1:].ravel(), RATES.items(), strict=True):
        sigma = getattr(part.track, f"{name}_sigma")
        _curves(axes, time, getattr(part.track, name), sigma, part.broken)
        axes.set_ylabel(label)
    for axes in panels.ravel():
        _shade(axes, time, part.track.valid)
        axes.margins(x=0.01)
        if _is_empty(axes):
            say_empty(axes)
            axes.set_yticks([])
    for axes in panels[-1]:
        axes.set_xlabel(f"time ({unit})")
    figure.align_ylabels()
    legend_of_figure(figure, _handles(), ncols=6)
    if part.words:
        note(figure, part.words)
    return figure


def _time(track: Trajectory) -> tuple[str, Floats]:
    """Return the times in numbers of few digits, and their unit."""
    late = len(track) > 0 and (float(np.ptp(track.time)) > LONG_S or float(track.time.max()) > LATE_S)
    return ("s", track.time) if late else ("ms", 1e3 * track.time)


def _position(axes: Axes, time: Floats, part: Part) -> None:
    track = part.track
    _dots(axes, time, track.position)
    _curves(axes, time, track.position_smooth, _sigma(track.position_smooth_cov), part.broken)
    axes.set_ylabel("position, lab (mm)")


def _angles(axes: Axes, time: Floats, part: Part) -> None:
    track = part.track
    smooth = tait_bryan_deg(track.orientation_smooth)
    sigma = _sigma_deg(track.orientation_smooth, track.orientation_smooth_cov)
    _dots(axes, time, tait_bryan_deg(track.orientation))
    for i in range(3):
        jumps = np.abs(np.diff(smooth[:, i])) > WRAP_DEG
        _curve(axes, time, smooth[:, i], sigma[:, i], part.broken | jumps, i)
    axes.set(ylim=(-185, 185), yticks=range(-180, 181, 90))
    axes.set_ylabel(r"angles $\theta_x$, $\theta_y$, $\theta_z$ (degrees)")


def tait_bryan_deg(R_lab_body: Floats) -> Floats:
    """Return theta_x, theta_y, theta_z (N, 3), degrees, of orientations (N, 3, 3); NaN where these are."""
    theta_rad = so3.to_tait_bryan(torch.from_numpy(R_lab_body)).numpy()
    known = np.isfinite(R_lab_body.reshape(-1, 9)).all(1, keepdims=True)  # of NaN it makes theta_z = 0, as at a pole
    return np.where(known, np.rad2deg(theta_rad), np.nan)


def _sigma_deg(R_lab_body: Floats, cov_lab_rad2: Floats) -> Floats:
    """Return the standard deviations of the angles, (N, 3), degrees, by delta_lab = H dtheta; NaN near the poles.

    Source: ERRATA E3.
    """
    theta = np.deg2rad(tait_bryan_deg(R_lab_body))
    there = np.isfinite(theta).all(1) & (np.abs(np.cos(theta[:, 1])) > 0.02)
    out = np.full_like(theta, np.nan)
    inverse = np.linalg.inv(so3.rate_matrix_lab(torch.from_numpy(theta[there])).numpy())
    out[there] = np.rad2deg(_sigma(inverse @ cov_lab_rad2[there] @ inverse.swapaxes(1, 2)))
    return out


def _sigma(cov: Floats) -> Floats:
    return np.asarray(np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0)))


def _curves(axes: Axes, time: Floats, values: Floats, sigma: Floats, broken: NDArray[np.bool_]) -> None:
    """Draw three components (N, 3) and limit the axis to them: at the ends of segments the bands are far wider."""
    for i in range(3):
        _curve(axes, time, values[:, i], sigma[:, i], broken, i)
    known = values[np.isfinite(values)]
    if len(known):
        errors = sigma[np.isfinite(sigma)]
        rest = 0.05 * float(np.ptp(known)) + (SIGMAS * float(np.median(errors)) if len(errors) else 0.0)
        rest = rest or 0.05 * abs(float(known[0])) or 1.0
        axes.set_ylim(float(known.min()) - rest, float(known.max()) + rest)


def _curve(axes: Axes, time: Floats, values: Floats, sigma: Floats, broken: NDArray[np.bool_], i: int) -> None:
    look = COMPONENTS[i]
    x, y, half = (cut(part, broken) for part in (time, values, SIGMAS * sigma))
    axes.plot(x, y, label=look.name, **look.drawn)
    band(axes, x, y - half, y + half, look)


def _dots(axes: Axes, time: Floats, values: Floats) -> None:
    for look, column in zip(COMPONENTS, values.T, strict=True):
        axes.plot(time, column, ".", color=look.colour, alpha=0.35, markersize=2.5, markeredgewidth=0, label="_")


def _is_empty(axes: Axes) -> bool:
    return not any(np.isfinite(np.asarray(line.get_ydata(), np.float64)).any() for line in axes.lines)


def _shade(axes: Axes, time: Floats, valid: NDArray[np.bool_]) -> None:
    """Shade runs of frames that are not valid, half a step to either side."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], valid, [True]]).astype(np.int8)))
    if not len(edges):
        return
    half = float(np.median(np.diff(time))) / 2 if len(time) > 1 else 0.5
    runs = [(time[a] - half, time[b - 1] - time[a] + 2 * half) for a, b in edges.reshape(-1, 2)]
    across = axes.get_xaxis_transform()
    axes.broken_barh(runs, (0, 1), transform=across, zorder=0, label="not valid", **NOT_VALID)


def _handles() -> list[Any]:
    lines = [Line2D([], [], label=look.name, **look.drawn) for look in COMPONENTS]
    dot = Line2D([], [], color=GREY, marker=".", linestyle="none", label="measured")
    return [
        *lines,
        dot,
        Patch(color=COMPONENTS[0].colour, alpha=BAND, linewidth=0, label=f"± {SIGMAS:.0f} standard deviations"),
        Patch(label="frame not valid", **NOT_VALID),
    ]
