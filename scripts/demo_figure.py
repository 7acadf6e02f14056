"""Draw a track: frames, measured poses, and errors against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.bench import Score
from sphereorient.cameras import Camera, R_cam_view
from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment import Experiment, open_movies
from sphereorient.experiment.timeline import timeline
from sphereorient.report.plots.style import AXIS_COLOURS, new_figure
from sphereorient.sphere import load_texture, orthographic_view, reduced_texture
from sphereorient.trajectory import Reason, Trajectory

BRIGHT_COLOURS = ("#FF8C3B", "#2BE0A8", "#63C3FF")  # the hues of AXIS_COLOURS on dark pictures
TRUTH_COLOUR = "#444444"


def demo_figure(track: Trajectory, experiment: Experiment, path: Path, score: Score | None = None) -> None:
    """Draw frames with the re-rendered sphere, outline and axes, the track with its angles, and the error.

    Args:
        track: the result.
        experiment: the input; movies and texture are opened.
        path: of the PNG or PDF to write.
        score: errors against the truth, where it is known.
    """
    figure = new_figure(12, 9.5)
    top, bottom = np.ravel(figure.subfigures(2, 1, height_ratios=[0.75, 1.15], squeeze=False))
    _frames_part(top, track, experiment)
    _curves_part(bottom, track, score)
    figure.savefig(path, dpi=110)


def _frames_part(part: Any, track: Trajectory, experiment: Experiment) -> None:
    """Draw two rows per camera: crops with outline and body axes, and the sphere re-rendered at the measured pose."""
    if experiment.texture_path is None:
        do = "draw the track of an experiment with a texture"
        raise ExperimentError(refusal(str(experiment.path), expected="a texture", got="none", do=do))
    names = list(track.cameras)
    chosen = _spread_valid(track, 8 // len(names))
    texture = load_texture(experiment.texture_path)
    pictures = {}
    with ExitStack() as opened:
        movies = {name: opened.enter_context(movie) for name, movie in open_movies(experiment, names).items()}
        frames = timeline(experiment, movies)
        # Matched by time: the track may cover a part of the experiment.
        at = np.abs(frames.time_s[:, None] - track.time[chosen]).argmin(0)
        for name, movie in movies.items():
            pictures[name] = movie.sample(frames.rows[name][at].tolist())
    for beside, name in zip(part.subfigures(1, len(names), squeeze=False)[0], names, strict=True):
        axes = beside.subplots(2, len(chosen), squeeze=False)
        for column, (k, picture) in enumerate(zip(chosen, pictures[name], strict=True)):
            _draw_sighting(axes[0, column], picture, track, experiment.cameras[name], name, k)
            _draw_render(axes[1, column], texture, track, experiment.cameras[name], name, k)
            axes[0, column].set_title(f"{1e3 * track.time[k]:.1f} ms", fontsize=9)
        axes[0, 0].set_ylabel("filmed")
        axes[1, 0].set_ylabel("re-rendered")
        beside.suptitle(name, fontsize=11)
    part.supxlabel("outline and body axes as measured; solid: towards the camera, dotted: away", fontsize=9)


def _spread_valid(track: Trajectory, count: int) -> list[int]:
    blind = np.zeros(len(track), dtype=bool)
    for camera in track.cameras.values():
        blind |= np.isin(camera.reason, [Reason.MISSING, Reason.UNDECODABLE])
    valid = np.flatnonzero(track.valid & ~blind)
    if not len(valid):
        valid = np.flatnonzero(~blind)
    return [int(valid[int(i)]) for i in np.linspace(0, len(valid) - 1, min(count, len(valid)))]


def _draw_sighting(axes: Any, picture: NDArray[Any], track: Trajectory, camera: Camera, name: str, k: int) -> None:
    seen = track.cameras[name]
    u, v = seen.centre_px[k]
    radius = seen.radius_px[k]
    axes.imshow(picture, cmap="gray", vmin=0, vmax=np.percentile(picture, 99.8), interpolation="nearest")
    _bare(axes)
    if not np.isfinite(radius):  # no disk in this camera: the whole picture is shown
        return
    reach = 1.25 * radius
    axes.set(xlim=(u - reach, u + reach), ylim=(v + reach, v - reach))
    angle = np.linspace(0, 2 * np.pi, 100)
    axes.plot(u + radius * np.cos(angle), v + radius * np.sin(angle), color="#F0E442", linewidth=1)
    R_cam_body = camera.R_cam_lab.numpy() @ track.orientation[k]
    if not np.isfinite(R_cam_body).all():
        return
    for label, colour, tip in zip("xyz", BRIGHT_COLOURS, R_cam_body.T, strict=True):
        style = "-" if tip[2] < 0 else ":"
        axes.plot([u, u + radius * tip[0]], [v, v + radius * tip[1]], style, color=colour, linewidth=2)
        at = (u + 1.14 * radius * tip[0], v + 1.14 * radius * tip[1])
        axes.text(*at, label, color=colour, fontsize=9, fontweight="bold", ha="center", va="center")


def _draw_render(axes: Any, texture: torch.Tensor, track: Trajectory, camera: Camera, name: str, k: int) -> None:
    seen = track.cameras[name]
    size = max(16, round(2 * float(np.nan_to_num(seen.radius_px[k], nan=40.0))))
    ray_lab = camera.rays(torch.from_numpy(seen.centre_px[k])).direction_lab
    R_view_cam = R_cam_view(camera.R_cam_lab @ ray_lab).mT
    R_view_body = R_view_cam @ camera.R_cam_lab @ torch.from_numpy(track.orientation[k])
    if torch.isfinite(R_view_body).all():
        picture = orthographic_view(size).render(reduced_texture(texture, size), R_view_body.float()).numpy()
        half = size / 2
        axes.imshow(picture, cmap="gray", vmin=0, vmax=1.2, extent=(-half, half, half, -half), interpolation="nearest")
        axes.set(xlim=(-1.25 * half, 1.25 * half), ylim=(1.25 * half, -1.25 * half))
    axes.set_facecolor("black")
    _bare(axes)


def _bare(axes: Any) -> None:
    axes.set(xticks=[], yticks=[], aspect="equal")


def _curves_part(part: Any, track: Trajectory, score: Score | None) -> None:
    """Draw the track in six dimensions, omega, and the errors."""
    axes = part.subplots(2, 2, sharex=True)
    time_ms = 1e3 * track.time
    _curves(axes[0, 0], time_ms, track.position, "position, lab (mm)", ("x", "y", "z"))
    theta = np.rad2deg(so3.to_tait_bryan(torch.from_numpy(track.orientation)).numpy())
    _curves(axes[0, 1], time_ms, _cut_wraps(theta), "angles (degrees)", (r"$\theta_x$", r"$\theta_y$", r"$\theta_z$"))
    axes[0, 1].set(ylim=(-190, 190), yticks=range(-180, 181, 90))
    _curves(axes[1, 0], time_ms, track.omega_lab, r"$\omega$, lab (rad/s)", ("x", "y", "z"))
    if score is None:
        _cameras_apart(axes[1, 1], time_ms, track)
    else:
        _errors(axes[1, 1], time_ms, score)
    for ax in axes[1]:
        ax.set_xlabel("time (ms)")


def _curves(axes: Any, time_ms: NDArray[Any], values: NDArray[Any], label: str, names: Sequence[str]) -> None:
    for name, colour, column in zip(names, AXIS_COLOURS, values.T, strict=True):
        axes.plot(time_ms, column, ".-", color=colour, markersize=3, linewidth=1, label=name)
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    axes.legend(ncols=3, fontsize=8, loc="best")


def _cut_wraps(theta_deg: NDArray[Any]) -> NDArray[Any]:
    """Put NaN where an angle jumps from +180 to -180, so that no line crosses the panel."""
    out = theta_deg.copy()
    jump = np.abs(np.diff(theta_deg, axis=0)) > 180
    out[1:][jump] = np.nan
    return out


def _errors(axes: Any, time_ms: NDArray[Any], score: Score) -> None:
    for (name, values), colour in zip(score.camera_orientation_deg.items(), ("#56B4E9", "#E69F00"), strict=False):
        axes.plot(time_ms, values, ".", color=colour, markersize=4, label=f"{name} alone")
    axes.plot(time_ms, score.orientation_deg, "-", color="black", linewidth=1.3, label="measured")
    median = score.percentiles_deg()[0]
    axes.axhline(median, color=TRUTH_COLOUR, linestyle="--", linewidth=1, label=f"median {median:.2f}°")
    axes.set_ylabel("orientation error (degrees)")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=2, loc="best")


def _cameras_apart(axes: Any, time_ms: NDArray[Any], track: Trajectory) -> None:
    """Draw, without a truth, the distance of the two cameras' orientations, or the score of one camera."""
    seen = list(track.cameras.values())
    if len(seen) == 2:
        a, b = (torch.from_numpy(each.orientation) for each in seen)
        axes.plot(time_ms, np.rad2deg(so3.geodesic_distance(a, b).numpy()), ".-", color="black", markersize=3)
        axes.set_ylabel("distance of the cameras' orientations (degrees)")
    else:
        axes.plot(time_ms, seen[0].score, ".-", color="black", markersize=3)
        axes.set_ylabel("quality T")
    axes.grid(alpha=0.3)
