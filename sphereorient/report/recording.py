"""A track as a Rerun recording: cameras, pictures, the sphere along its path, and time series (docs/export.md)."""

import os
import shutil
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack, nullcontext, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import Camera
from sphereorient.errors import OutputError, error_words, refusal
from sphereorient.experiment import Experiment
from sphereorient.files.whole_file import check_ending, put_aside
from sphereorient.report.columns import package
from sphereorient.report.frame_warnings import frame_warnings
from sphereorient.report.overlay import pictures_by_row, streams_of
from sphereorient.report.overlay_model import Path3D, finite_rows, path_of
from sphereorient.report.overlay_page import AXES, OUTLINE, TRAIL
from sphereorient.sphere import load_texture, reduced_texture
from sphereorient.trajectory import Tracks, Trajectory, quaternions_wxyz
from sphereorient.trajectory.datasets import in_length

with suppress(ImportError):  # an extra: `view_track` says how to install it
    import rerun as rr
    import rerun.blueprint as rrb

Floats = NDArray[np.float64]
Advance = Callable[[int, int], None]

TIME, FRAME = "time", "row"  # timelines: seconds, and the rows of the track
PLAIN_RADIUS_MM = 9.0  # of the sphere without an experiment
GRID = 9  # pixels along each side of the picture that a pinhole is fitted to
FRUSTUM = 0.25  # of the distance to the sphere: where the picture's plane is drawn
MESH = 64  # facets around the sphere
MAP_PX = 512  # diameter of the disk whose map is on the mesh
JPEG_QUALITY = 88
AXIS_REACH = 1.6  # radii, length of the arrows
VIEWER_S = 10.0  # until the viewer answers
FADED = 90  # opacity of the lines a standard deviation above and below, of 255
# dataset of each plot; position has a covariance, the others a standard deviation *_sigma
SERIES = {
    "velocity, m per s": "velocity",
    "acceleration, m per s2": "acceleration",
    "omega lab, rad per s": "omega_lab",
    "alpha lab, rad per s2": "alpha_lab",
}


def view_track(
    tracks: Trajectory | Mapping[str, Trajectory],
    *,
    experiment: Experiment | None = None,
    save: Path | None = None,
    every: int = 1,
    pictures: bool = True,
    progress: Advance = lambda done, total: None,
) -> None:
    """Show a track, or those of several spheres by name, in Rerun's viewer, or write `save` (.rrd) without a window.

    The experiment adds cameras, texture map and pictures, the latter in one of `every` frames.

    Raises:
        OutputError: rerun-sdk is not installed, another suffix, or the file cannot be written.
        TrackError: the track is of another experiment.
    """
    package("rerun", "view")
    if save is not None:
        check_ending(save, "--save", [".rrd"])
    recording: Any = rr.RecordingStream("sphereorient", recording_id=None)
    known = Tracks.of(tracks)
    layout = _layout(known, experiment)
    with nullcontext() if save is None else put_aside(save) as aside:
        if aside is None:
            _open_viewer(recording, layout)
        else:
            recording.save(aside, default_blueprint=layout)
        try:
            _log(recording, known, experiment, every if pictures else 0, progress)
        finally:
            recording.flush()
            recording.disconnect()


def _open_viewer(recording: Any, layout: Any) -> None:
    """Start the viewer that is installed beside this Python; OutputError where it cannot open a window."""
    do = "write a recording with --save track.rrd, and open it where there is a display"
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise OutputError(refusal("view", expected="a display", got="none (DISPLAY is not set)", do=do))
    try:
        viewer = shutil.which("rerun", path=str(Path(sys.executable).parent))  # PATH may not lead there
        rr.spawn(executable_path=viewer, default_blueprint=layout, recording=recording)
        recording.flush(timeout_sec=VIEWER_S)
    except (OSError, RuntimeError) as error:
        recording.disconnect()
        raise OutputError(refusal("view", expected="a viewer that opens", got=error_words(error), do=do)) from error


def _place(name: str, *steps: str) -> list[str]:
    """Return the place of what is of one sphere: steps for the only one, else spheres, its name, steps."""
    return ["spheres", name, *steps] if name else list(steps)


def _layout(tracks: Tracks, experiment: Experiment | None) -> Any:
    space = rrb.Spatial3DView(origin="lab", name="lab")
    seen = next(iter(tracks.values())).cameras
    names = [] if experiment is None else [name for name in experiment.cameras if name in seen]
    shown = [rrb.Spatial2DView(origin=f"lab/{name}/picture", name=name) for name in names]
    plots = [
        rrb.TimeSeriesView(origin=rr.new_entity_path(["plots", *_place(ball, name)]), name=f"{ball} {name}".strip())
        for ball, track in tracks.items()
        for name in (*series_of(track), "state")
    ]
    log = rrb.TextLogView(origin="warnings", name="warnings")
    above = rrb.Horizontal(space, rrb.Vertical(*shown), column_shares=[2, 1]) if shown else space
    return rrb.Blueprint(rrb.Vertical(above, rrb.Tabs(*plots, log), row_shares=[2, 1]), collapse_panels=True)


def _log(recording: Any, tracks: Tracks, experiment: Experiment | None, every: int, progress: Advance) -> None:
    first = next(iter(tracks.values()))

    def when(rows: NDArray[np.int64]) -> list[Any]:
        return [rr.TimeColumn(TIME, duration=first.time[rows]), rr.TimeColumn(FRAME, sequence=rows)]

    recording.log("lab", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    balls = {name: None if experiment is None else experiment.of(name) for name in tracks}
    paths = {}
    for name, track in tracks.items():
        radius = PLAIN_RADIUS_MM if (ball := balls[name]) is None else ball.radius_mm
        paths[name] = path_of(track, radius if track.length_unit == "mm" else 1.0)
    if experiment is not None:
        known = np.concatenate([path.position_mm[finite_rows(path.position_mm)] for path in paths.values()])
        near = known.mean(0) if len(known) else np.zeros(3)
        cameras = {name: camera for name, camera in experiment.cameras.items() if name in first.cameras}
        _log_cameras(recording, cameras, near)
    for name, track in tracks.items():
        _log_sphere(recording, track, paths[name], balls[name], when)
        _log_series(recording, track, when)
    if experiment is not None and every:
        _log_pictures(recording, first, experiment, np.arange(0, len(first), every), progress)


def pinhole_near(camera: Camera, near_lab_mm: Floats) -> tuple[Floats, float] | None:
    """Fit a pinhole, without distortion, to a camera near a point (3,), lab, mm.

    Return the matrix (3, 3), px, and the distance along the axis, mm; None if the point is not in front (telecentric).
    """
    R, T = camera.R_cam_lab, camera.T_cam_lab_mm
    depth = float((R @ torch.from_numpy(near_lab_mm) + T)[2])
    width, height = camera.image_size
    u, v = torch.meshgrid(torch.linspace(0, width - 1.0, GRID), torch.linspace(0, height - 1.0, GRID), indexing="xy")
    uv = torch.stack([u, v], dim=-1).reshape(-1, 2).double()
    rays = camera.rays(uv)
    origin, direction = rays.origin_lab_mm @ R.mT + T, rays.direction_lab @ R.mT
    at = (origin + (depth - origin[:, 2:]) / direction[:, 2:] * direction).numpy()
    there = np.isfinite(at).all(1)
    if not depth > 0 or there.sum() < GRID:
        return None
    K = np.eye(3)
    for row in range(2):
        K[row, row], K[row, 2] = np.polyfit(at[there, row] / depth, uv.numpy()[there, row], 1)
    return (K, depth) if (np.diag(K) > 0).all() else None


def _log_cameras(recording: Any, cameras: Mapping[str, Camera], near_lab_mm: Floats) -> None:
    for name, camera in cameras.items():
        R_lab_cam = camera.R_cam_lab.mT.numpy()
        centre_mm = -R_lab_cam @ camera.T_cam_lab_mm.numpy()
        recording.log(f"lab/{name}", rr.Transform3D(translation=centre_mm, mat3x3=R_lab_cam), static=True)
        fitted = pinhole_near(camera, near_lab_mm)
        if fitted is not None:
            pinhole = rr.Pinhole(
                image_from_camera=fitted[0],
                resolution=list(camera.image_size),
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=FRUSTUM * fitted[1],
            )
            recording.log(f"lab/{name}/picture", pinhole, static=True)


def _log_sphere(
    recording: Any, track: Trajectory, path: Path3D, experiment: Experiment | None, when: Callable[[Any], Any]
) -> None:
    radius, name = path.radius_mm, track.sphere
    sphere = ["lab", *(_place(name) or ["sphere"])]
    if experiment is None or experiment.texture_path is None:
        recording.log([*sphere, "ball"], rr.Ellipsoids3D(half_sizes=[[radius] * 3], colors=[OUTLINE]), static=True)
    else:
        map_ = reduced_texture(load_texture(experiment.texture_path), MAP_PX).numpy()
        recording.log([*sphere, "ball"], _textured(radius, map_), static=True)
    arrows = rr.Arrows3D(vectors=AXIS_REACH * radius * np.eye(3), colors=AXES, labels=["x", "y", "z"])
    recording.log([*sphere, "axes"], arrows, static=True)
    rows = np.flatnonzero(path.whole)
    if len(rows):
        xyzw = np.roll(quaternions_wxyz(path.R_lab_body[rows]), -1, axis=1)  # Rerun's order, w last
        poses = rr.Transform3D.columns(translation=path.position_mm[rows], quaternion=xyzw)
        recording.send_columns(rr.new_entity_path(sphere), when(rows), poses)
    there = finite_rows(path.position_mm)
    known = np.where(there, track.segment, -2)  # the line is interrupted where the segment changes
    cuts = np.concatenate([[0], np.flatnonzero(np.diff(known) != 0) + 1, [len(track)]]).astype(int)
    strips = [path.position_mm[a:b] for a, b in pairwise(cuts) if b - a > 1 and there[a]]
    if strips:
        lines = rr.LineStrips3D(strips, colors=[TRAIL], radii=[0.02 * radius])
        recording.log(["lab", "path", *_place(name)[1:]], lines, static=True)


def _textured(radius: float, map_: NDArray[np.float32]) -> Any:
    across, down = np.linspace(0, 1, MESH + 1), np.linspace(0, 1, MESH // 2 + 1)
    u, v = np.meshgrid(across, down)
    longitude, latitude = 2 * np.pi * u - np.pi, np.pi / 2 - np.pi * v
    cos = np.cos(latitude)
    normal = np.stack([cos * np.cos(longitude), cos * np.sin(longitude), np.sin(latitude)], axis=-1).reshape(-1, 3)
    rows, columns = np.meshgrid(np.arange(MESH // 2), np.arange(MESH), indexing="ij")
    a = (rows * (MESH + 1) + columns).ravel()
    below = a + MESH + 1
    facets = np.concatenate([np.stack([a, below, below + 1], 1), np.stack([a, below + 1, a + 1], 1)])
    return rr.Mesh3D(
        vertex_positions=radius * normal,
        triangle_indices=facets,
        vertex_normals=normal,
        vertex_texcoords=np.stack([u, v], axis=-1).reshape(-1, 2),
        albedo_texture=np.repeat((255 * map_).astype(np.uint8)[..., None], 3, axis=-1),
    )


def series_of(track: Trajectory) -> dict[str, tuple[Floats, Floats]]:
    """Return values and standard deviations, (N, 3) each, by the name of their plot."""
    spread = np.sqrt(np.diagonal(track.position_cov, axis1=1, axis2=2))
    found = {"position, mm": (track.position, spread)}
    found |= {name: (getattr(track, key), getattr(track, f"{key}_sigma")) for name, key in SERIES.items()}
    return {in_length(name, track.length_unit): part for name, part in found.items()}


def _log_series(recording: Any, track: Trajectory, when: Callable[[Any], Any]) -> None:
    """Log every series as nine lines (value, one sigma above and below), states and warnings."""
    rows = np.arange(len(track))

    def send(name: str, lines: Floats, style: Any) -> None:
        place = rr.new_entity_path(["plots", *_place(track.sphere, name)])
        recording.log(place, style, static=True)
        if len(lines):
            columns = rr.Scalars.columns(scalars=lines.ravel()).partition([lines.shape[1]] * len(lines))
            recording.send_columns(place, when(rows), columns)

    names = [f"{axis}{more}" for axis in "xyz" for more in ("", " + sigma", " - sigma")]
    colours = [(*colour, opacity) for colour in AXES for opacity in (255, FADED, FADED)]
    for name, (values, sigma) in series_of(track).items():
        lines = np.stack([values, values + sigma, values - sigma], axis=-1).reshape(len(track), 9)
        send(name, lines, rr.SeriesLines(names=names, colors=colours, widths=[2.0, 1.0, 1.0] * 3))
    found = [frame_warnings(track, int(k)) for k in rows]
    states = np.stack([track.valid.astype(float), np.array([float(bool(words)) for words in found])], axis=-1)
    send("state", states, rr.SeriesLines(names=["valid", "in doubt"], colors=[AXES[1], AXES[0]]))
    warned = [k for k, words in enumerate(found) if words]
    if warned:
        levels = ["WARN" if track.valid[k] else "ERROR" for k in warned]
        columns = rr.TextLog.columns(text=[", ".join(found[k]) for k in warned], level=levels)
        place = rr.new_entity_path(["warnings", *_place(track.sphere)[1:]])
        recording.send_columns(place, when(np.array(warned)), columns)


def _log_pictures(
    recording: Any, track: Trajectory, experiment: Experiment, chosen: NDArray[np.int64], progress: Advance
) -> None:
    names = [name for name in track.cameras if name in experiment.cameras]
    with ExitStack() as opened:
        _, streams = streams_of(track, experiment, names, opened)
        white: dict[str, float] = {}
        for done, (k, pictures) in enumerate(pictures_by_row(streams, chosen), start=1):
            recording.set_time(TIME, duration=float(track.time[k]))
            recording.set_time(FRAME, sequence=k)
            for name, picture in pictures.items():
                if picture is not None:
                    # One scale for the whole movie, from the first picture.
                    top = white.setdefault(name, max(1.0, float(np.percentile(picture, 99.9))))
                    bright = np.clip(picture.astype(np.float32) * (255 / top), 0, 255).astype(np.uint8)
                    _, jpeg = cv2.imencode(".jpg", bright, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
                    encoded = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
                    recording.log(f"lab/{name}/picture", encoded)
            progress(done, len(chosen))
