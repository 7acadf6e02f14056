"""Cameras, pictures and the sphere in a Rerun recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import Camera
from sphereorient.experiment import Experiment, open_movies
from sphereorient.experiment.stream import CameraStream
from sphereorient.movies import Grey
from sphereorient.report.overlay import frames_of, pictures_at
from sphereorient.report.overlay_canvas import AXES, OUTLINE, TRAIL
from sphereorient.report.overlay_model import Path3D, finite_rows
from sphereorient.sphere import load_texture, reduced_texture
from sphereorient.trajectory import Trajectory, quaternions_wxyz

Floats = NDArray[np.float64]
GRID = 9  # pixels along each side of the picture that a pinhole is fitted to
FRUSTUM = 0.25  # of the distance to the ball: where the picture's plane is drawn
MESH = 64  # facets around the sphere
MAP_PX = 512  # diameter of the disk whose map the mesh carries
JPEG_QUALITY = 88
AXIS_REACH = 1.6  # radii, length of the arrows


def pinhole_near(camera: Camera, near_lab_mm: Floats) -> tuple[Floats, float] | None:
    """Return the pinhole that shows most nearly what a camera shows of the surroundings of a place.

    A viewer draws pinholes only: distortion is left out, and a wall's refraction is contained in the focal length.

    Args:
        camera: any model, also behind a port.
        near_lab_mm: (3,), a place in front of it, lab.

    Returns:
        The matrix (3, 3) of the picture, px, and the place's distance along the axis, mm; None where the place is not
        in front of the centre, as with a telecentric camera whose centre lies anywhere.
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


def log_cameras(recording: Any, cameras: Mapping[str, Camera], near_lab_mm: Floats) -> None:
    """Log each camera's place and frustum, once."""
    import rerun as rr

    for name, camera in cameras.items():
        R_lab_cam = camera.R_cam_lab.mT.numpy()
        centre_mm = -R_lab_cam @ camera.T_cam_lab_mm.numpy()
        recording.log(f"lab/{name}", rr.Transform3D(translation=centre_mm, mat3x3=R_lab_cam), static=True)
        fitted = pinhole_near(camera, near_lab_mm)
        if fitted is None:
            continue
        K, depth = fitted
        width, height = camera.image_size
        pinhole = rr.Pinhole(
            image_from_camera=K,
            resolution=[width, height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM * depth,
        )
        recording.log(f"lab/{name}/picture", pinhole, static=True)


def log_sphere(
    recording: Any, track: Trajectory, path: Path3D, experiment: Experiment | None, when: Callable[[Any], Any]
) -> None:
    """Log the sphere with its paint and axes, its pose in every frame, and the path of its centre.

    Args:
        recording: a Rerun recording.
        track: what was measured.
        path: its poses.
        experiment: for the paint; without it the sphere is plain.
        when: gives the time columns of some rows of the track.
    """
    import rerun as rr

    radius = path.radius_mm
    if experiment is None or experiment.texture_path is None:
        recording.log("lab/sphere/ball", rr.Ellipsoids3D(half_sizes=[[radius] * 3], colors=[OUTLINE]), static=True)
    else:
        map_ = reduced_texture(load_texture(experiment.texture_path), MAP_PX).numpy()
        recording.log("lab/sphere/ball", _painted(rr, radius, map_), static=True)
    arrows = rr.Arrows3D(vectors=AXIS_REACH * radius * np.eye(3), colors=AXES, labels=["x", "y", "z"])
    recording.log("lab/sphere/axes", arrows, static=True)
    rows = np.flatnonzero(path.whole)
    if len(rows):
        xyzw = np.roll(quaternions_wxyz(path.R_lab_body[rows]), -1, axis=1)  # Rerun's order, w last
        poses = rr.Transform3D.columns(translation=path.position_mm[rows], quaternion=xyzw)
        recording.send_columns("lab/sphere", when(rows), poses)
    strips = [path.position_mm[a:b] for a, b in _stretches(track, path)]
    if strips:
        recording.log("lab/path", rr.LineStrips3D(strips, colors=[TRAIL], radii=[0.02 * radius]), static=True)


def log_pictures(
    recording: Any,
    track: Trajectory,
    experiment: Experiment,
    chosen: NDArray[np.int64],
    set_time: Callable[[int], None],
    progress: Callable[[int, int], None],
) -> None:
    """Log the movies' pictures as JPEG, frame by frame; rows `chosen` of the track."""
    import rerun as rr

    names = [name for name in track.cameras if name in experiment.cameras]
    with ExitStack() as opened:
        movies = {name: opened.enter_context(movie) for name, movie in open_movies(experiment, names).items()}
        _, rows = frames_of(track, experiment, movies)
        streams = [
            CameraStream(name=name, camera=experiment.cameras[name], movie=movies[name], rows=rows[name])
            for name in names
        ]
        readers = [pictures_at(stream, chosen) for stream in streams]
        white: dict[str, float] = {}
        for done, (k, *pictures) in enumerate(zip(chosen.tolist(), *readers, strict=True), start=1):
            set_time(k)
            for name, picture in zip(names, pictures, strict=True):
                if picture is not None:
                    # One scale for the whole movie: that of the first picture.
                    top = white.setdefault(name, max(1.0, float(np.percentile(picture, 99.9))))
                    encoded = rr.EncodedImage(contents=_jpeg(picture, top), media_type="image/jpeg")
                    recording.log(f"lab/{name}/picture", encoded)
            progress(done, len(chosen))


def _jpeg(picture: Grey, white: float) -> bytes:
    bright = np.clip(picture.astype(np.float32) * (255 / white), 0, 255).astype(np.uint8)
    _, content = cv2.imencode(".jpg", bright, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return content.tobytes()


def _painted(rr: Any, radius: float, map_: NDArray[np.float32]) -> Any:
    """Return the sphere as a mesh that carries its map (docs/conventions.md: texture map)."""
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


def _stretches(track: Trajectory, path: Path3D) -> list[tuple[int, int]]:
    """First and last + 1 of the stretches of frames with a position, interrupted where the segment changes."""
    there = finite_rows(path.position_mm)
    known = np.where(there, track.segment, -2)
    cuts = np.concatenate([[0], np.flatnonzero(np.diff(known) != 0) + 1, [len(track)]])
    return [(int(a), int(b)) for a, b in pairwise(cuts) if b - a > 1 and there[a]]
