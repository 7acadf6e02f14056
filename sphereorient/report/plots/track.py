"""A track in six dimensions against time, and its path through space with the sphere's axes."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sphereorient.experiment.recording import spread_frames
from sphereorient.report.plots import style as look
from sphereorient.trajectory import Trajectory, runs_of
from sphereorient.trajectory.datasets import in_length
from sphereorient.trajectory.rotations import Floats, tait_bryan, tait_bryan_sigma

MOST_FRAMES = 2000  # more are indistinguishable on a page
GAP = 1.5  # typical steps: a longer one is a gap
SIGMAS = 2.0  # half width of the bands
NOT_VALID: Final[dict[str, Any]] = {"facecolor": "#E8E8E8", "edgecolor": look.SHADE, "hatch": "//////", "linewidth": 0}
LATE_S, LONG_S = 10.0, 2.0  # from here on times are in seconds
WRAP_DEG = 90.0  # a larger step between frames means that the angle wrapped, or passed its pole
RATES = {
    "velocity": "velocity, lab (m/s)",
    "omega_lab": "ω, lab (rad/s)",
    "acceleration": "acceleration, lab (m/s²)",
    "alpha_lab": "α, lab (rad/s²)",
}


def track_figures(of: look.Reported) -> Iterator[look.Plan]:
    """Yield the tracks of the recording with most valid frames, and their path."""
    _, tracks, _ = of
    name, track = max(tracks.items(), key=lambda item: int(item[1].valid.sum()))
    recording = name.removesuffix(track.sphere)
    together = {key: one for key, one in tracks.items() if key.removesuffix(one.sphere) == recording}
    caption, paper = "As measured (dots) and smooth, with bands of two standard errors.", " (Figure 7 of the paper)"
    for number, (key, one) in enumerate(together.items(), start=1):
        label, title = ("track", paper) if number == 1 else (f"track_{number}", "")
        yield label, f"Track{look.of_tracks([key], tracks)}{title}", caption, partial(track_figure, one)
    if not track.held:
        draw = partial(path_figure, *together.values())
        yield "path", f"Path{look.of_tracks(together, tracks)}", "With the sphere's axes.", draw


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackPart:
    """Frames of a track that are drawn; made by `shown_part`."""

    track: Trajectory  # these frames only
    words: str  # name of the part; empty for the whole track
    broken: NDArray[np.bool_]  # (n - 1,), whether the line to the next frame is interrupted


@look.in_style
def track_figure(track: Trajectory) -> Figure:
    """Draw position, Tait-Bryan angles, velocities and accelerations against time: measured, and smooth with 2 sigma;
    of a fixed ball the rotation alone; of a long track `shown_part`. Frames that are not valid are shaded. Source: the
    paper, figure of a sample track; the angles by docs/errata.md E1.
    """
    part = shown_part(track)
    track = part.track
    late = len(track) > 0 and (float(np.ptp(track.time)) > LONG_S or float(track.time.max()) > LATE_S)
    unit, time = ("s", track.time) if late else ("ms", 1e3 * track.time)
    figure = look.new_figure(look.WIDTH_IN, 7.6)
    panels = figure.subplots(3, 1 if track.held else 2, sharex=True, squeeze=False)
    if not track.held:
        _dots(panels[0, 0], time, track.position)
        sigma = np.sqrt(np.maximum(np.diagonal(track.position_smooth_cov, axis1=1, axis2=2), 0.0))
        _curves(panels[0, 0], time, track.position_smooth, sigma, part.broken)
        panels[0, 0].set_ylabel(in_length("position, lab (mm)", track.length_unit))
    _angles(panels[0, -1], time, part)
    shown = ("omega_lab", "alpha_lab") if track.held else tuple(RATES)
    for axes, name in zip(panels[1:].ravel(), shown, strict=True):
        _curves(axes, time, getattr(track, name), getattr(track, f"{name}_sigma"), part.broken)
        axes.set_ylabel(in_length(RATES[name], track.length_unit))
    half = float(np.median(np.diff(time))) / 2 if len(time) > 1 else 0.5
    runs = [(time[a] - half, time[b - 1] - time[a] + 2 * half) for a, b in runs_of(~track.valid)]
    for axes in panels.ravel():
        if runs:
            across = axes.get_xaxis_transform()
            axes.broken_barh(runs, (0, 1), transform=across, zorder=0, label="not valid", **NOT_VALID)
        axes.margins(x=0.01)
        if not any(np.isfinite(np.asarray(line.get_ydata(), np.float64)).any() for line in axes.lines):
            look.say_empty(axes)
            axes.set_yticks([])
    for axes in panels[-1]:
        axes.set_xlabel(f"time ({unit})")
    figure.align_ylabels()
    band: dict[str, Any] = {"color": look.COMPONENTS[0].colour, "alpha": look.BAND, "linewidth": 0}
    handles = [
        *(style.handle(style.name) for style in look.COMPONENTS),
        look.PLAIN.handle("measured", marker=".", linestyle="none"),
        Patch(label=f"± {SIGMAS:.0f} standard deviations", **band),
        Patch(label="frame not valid", **NOT_VALID),
    ]
    look.legend_of_figure(figure, handles, ncols=6)
    if part.words:
        look.note(figure, part.words)
    return figure


@look.in_style
def path_figure(*tracks: Trajectory) -> Figure:
    """Draw the paths of tracks of one recording, lab, to scale, with body axes; of a long track `shown_part`."""
    parts = [shown_part(track) for track in tracks]
    figure = look.new_figure(look.WIDTH_IN, 5.6)
    axes: Any = figure.add_subplot(projection="3d")
    axes.set(**{f"{axis}label": f"{axis}, lab ({tracks[0].length_unit})" for axis in "xyz"})
    whole = np.concatenate([part.track.position_smooth for part in parts])
    whole = whole[np.isfinite(whole).all(1)]
    styles = [look.ALL, *(replace(look.ALL, colour=colour) for colour in look.BALLS)]
    named = [(part, styles[k % len(styles)], part.track.sphere or "path") for k, part in enumerate(parts)]
    if len(whole):
        size = 0.09 * max(float(np.ptp(whole, axis=0).max()), 1.0)  # of the path's largest extent
        for part, style, name in named:
            position = part.track.position_smooth
            there = np.flatnonzero(np.isfinite(position).all(1))
            axes.plot(*_cut(position, part.broken).T, color=style.colour, linewidth=1.0, label=name)
            axes.plot(*position[there[:1]].T, marker="o", markersize=5, color=style.colour, label="start")
            _tripods(axes, part.track, there, size)
        _equal_scale(axes, whole, size)
    else:
        look.say_empty(axes)
    start = look.ALL.handle("start", marker="o", linestyle="none", markersize=5)
    paths = [style.handle(name, linewidth=1.0) for _, style, name in named]
    arm: dict[str, Any] = {"linestyle": "-", "linewidth": 1.6}
    arms = [style.handle(f"body axis {style.name}", marker=style.marker, **arm) for style in look.COMPONENTS]
    look.legend_of_figure(figure, [*paths, start, *arms], ncols=5)
    words = "the sphere's axes are not to scale"
    look.note(figure, f"{parts[0].words}; {words}" if parts[0].words else words)
    return figure


def shown_part(track: Trajectory, most: int = MOST_FRAMES) -> TrackPart:
    """Return the whole track, or the `most` consecutive frames of its longest segment with the most valid ones."""
    rows, words = np.arange(len(track)), ""
    if len(track) > most:
        which = "none of them in a segment"
        if (frames := np.bincount(track.segment + 1)[1:]).any():
            rows = np.flatnonzero(track.segment == frames.argmax())
            which = "the longest segment" if len(rows) <= most else f"the best {most:,} frames of the longest segment"
        if len(rows) > most:
            total = np.concatenate([[0], np.cumsum(track.valid[rows])])
            start = int((total[most:] - total[:-most]).argmax())
            rows = rows[start : start + most]
        words = f"shown: frames {rows[0]:,} to {rows[-1]:,} of {len(track):,}, {which}"
    part = track.at(rows)
    steps = np.diff(track.time)
    typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    broken = np.asarray((np.diff(part.time) > GAP * typical) | (np.diff(part.segment) != 0))
    return TrackPart(track=part, words=words, broken=broken)


def _cut(values: Floats, broken: NDArray[np.bool_]) -> Floats:
    """Insert a row of NaN into values (N, ...) where the line is broken, (N - 1,)."""
    return np.insert(values, np.flatnonzero(broken) + 1, np.nan, axis=0)


def _angles(axes: Axes, time: Floats, part: TrackPart) -> None:
    track = part.track
    smooth = np.rad2deg(tait_bryan(track.orientation_smooth))
    sigma = np.rad2deg(tait_bryan_sigma(track.orientation_smooth, track.orientation_smooth_cov))
    _dots(axes, time, np.rad2deg(tait_bryan(track.orientation)))
    for i in range(3):
        jumps = np.abs(np.diff(smooth[:, i])) > WRAP_DEG
        _curve(axes, time, smooth[:, i], sigma[:, i], part.broken | jumps, i)
    known = smooth[np.isfinite(smooth)]
    if not len(known) or np.ptp(known) > WRAP_DEG:
        axes.set(ylim=(-185, 185), yticks=range(-180, 181, 90))
    else:
        _limit(axes, smooth, sigma)
    axes.set_ylabel(r"angles $\theta_x$, $\theta_y$, $\theta_z$ (degrees)")


def _curves(axes: Axes, time: Floats, values: Floats, sigma: Floats, broken: NDArray[np.bool_]) -> None:
    for i in range(3):
        _curve(axes, time, values[:, i], sigma[:, i], broken, i)
    _limit(axes, values, sigma)


def _limit(axes: Axes, values: Floats, sigma: Floats) -> None:
    """Limit an axis by the values: bands widen at the ends of segments."""
    known, errors = values[np.isfinite(values)], sigma[np.isfinite(sigma)]
    if len(known):
        rest = 0.05 * float(np.ptp(known)) + (SIGMAS * float(np.median(errors)) if len(errors) else 0.0)
        rest = rest or 0.05 * abs(float(known[0])) or 1.0
        axes.set_ylim(float(known.min()) - rest, float(known.max()) + rest)


def _curve(axes: Axes, time: Floats, values: Floats, sigma: Floats, broken: NDArray[np.bool_], i: int) -> None:
    style = look.COMPONENTS[i]
    x, y, half = (_cut(part, broken) for part in (time, values, SIGMAS * sigma))
    axes.plot(x, y, label=style.name, **style.drawn)
    look.band(axes, x, y - half, y + half, style)


def _dots(axes: Axes, time: Floats, values: Floats) -> None:
    for style, column in zip(look.COMPONENTS, values.T, strict=True):
        axes.plot(time, column, ".", color=style.colour, alpha=0.35, markersize=2.5, markeredgewidth=0, label="_")


def _tripods(axes: Any, track: Trajectory, there: NDArray[np.int64], size: float) -> None:
    known = there[np.isfinite(track.orientation_smooth[there]).all((1, 2))]
    chosen = known[spread_frames(range(len(known)), 14)]
    start = track.position_smooth[chosen]
    for i, style in enumerate(look.COMPONENTS):
        tip = start + size * track.orientation_smooth[chosen, :, i]
        ends = np.stack([start, tip, np.full_like(tip, np.nan)], axis=1).reshape(-1, 3)
        axes.plot(*ends.T, color=style.colour, linewidth=1.6, label=f"body axis {style.name}")
        axes.plot(*tip.T, color=style.colour, marker=style.marker, markersize=3, linestyle="none", label="_")


def _equal_scale(axes: Any, position_mm: Floats, size: float) -> None:
    """Give all axes the same scale; the box fits the path, and is not too thin."""
    low, high = position_mm.min(0) - size, position_mm.max(0) + size
    # Least length of the box's shortest side, as a share of the largest extent.
    extent = np.maximum(high - low, 0.35 * (high - low).max())
    middle = (low + high) / 2
    axes.set_box_aspect(tuple(extent), zoom=0.95)  # a tuple: it scales an array in place
    limits = (centre + np.array([-0.5, 0.5]) * length for centre, length in zip(middle, extent, strict=True))
    axes.set(**dict(zip(("xlim", "ylim", "zlim"), limits, strict=True)))
    for axis, share in zip((axes.xaxis, axes.yaxis, axes.zaxis), extent / extent.max(), strict=True):
        axis.set_major_locator(MaxNLocator(max(2, round(6 * share))))
