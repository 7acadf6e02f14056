"""Cameras checked and repaired by the sphere itself: what each one says of it, from a track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.calibration.self_calibration import Repaired, Told, self_calibrate
from sphereorient.cameras import Camera, load_cameras, triangulate
from sphereorient.errors import TrackError
from sphereorient.files.yaml_file import refuse_unknown
from sphereorient.trajectory import Reason, Trajectory

TELLING = (Reason.OK, Reason.CONTRADICTS)


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraCheck:
    """How well two cameras fit together over a movie; made by `check_cameras`."""

    names: tuple[str, str]
    gap_mm: NDArray[np.float64]  # (n,), distance of the lines of sight to the sphere's centre
    miss_px: NDArray[np.float64]  # (n,), by how much each picture misses the point between them, the worse of the two

    def percentile(self, share: float) -> tuple[float, float]:
        """Return a percentile of both, mm and px."""
        return float(np.percentile(self.gap_mm, share)), float(np.percentile(self.miss_px, share))


def told_by(track: Trajectory, cameras: Mapping[str, Camera]) -> dict[str, Told]:
    """Return what each camera says of the sphere by itself.

    Raises:
        TrackError: a camera that the track does not have.
    """
    told = {}
    for name in cameras:
        if name not in track.cameras:
            raise TrackError(refuse_unknown(name, track.cameras, "track, camera"))
        camera = track.cameras[name]
        says = np.array([why in TELLING for why in camera.reason])
        told[name] = Told(
            centre_px=torch.from_numpy(np.where(says[:, None], camera.centre_px, np.nan)),
            R_lab_body=torch.from_numpy(np.where(says[:, None, None], camera.orientation, np.nan)),
        )
    return told


def refine_with_track(cameras_path: Path | str, track_path: Path | str) -> Repaired:
    """Repair cameras that were bumped after their calibration, with a track that was made with them.

    Args:
        cameras_path: cameras.yaml as it was when the track was made.
        track_path: track.h5 of both cameras.

    Raises:
        CameraError: cameras that cannot be read, or too few frames that both saw.
        TrackError: a track that cannot be read, or of other cameras.
    """
    cameras = load_cameras(cameras_path)
    track = Trajectory.load(track_path)
    used = {name: camera for name, camera in cameras.items() if name in track.cameras}
    return self_calibrate(used or cameras, told_by(track, used or cameras))


def check_cameras(cameras: Mapping[str, Camera], track: Trajectory) -> list[CameraCheck]:
    """Measure how far lines of sight to the sphere's centre miss each other, for every pair of cameras."""
    told, names, checks = told_by(track, cameras), list(cameras), []
    for k, one in enumerate(names):
        for other in names[k + 1 :]:
            both = torch.isfinite(told[one].centre_px + told[other].centre_px).all(-1)
            if bool(both.any()):
                pixels = [told[name].centre_px[both] for name in (one, other)]
                checks.append(_check((one, other), [cameras[one], cameras[other]], pixels))
    return checks


def _check(names: tuple[str, str], cameras: Sequence[Camera], pixels: Sequence[torch.Tensor]) -> CameraCheck:
    rays = [camera.rays(uv_px) for camera, uv_px in zip(cameras, pixels, strict=True)]
    middle, gap = triangulate(*rays)
    missed = [(camera.project(middle) - uv_px).norm(dim=-1) for camera, uv_px in zip(cameras, pixels, strict=True)]
    return CameraCheck(names=names, gap_mm=gap.numpy(), miss_px=torch.stack(missed).amax(0).numpy())
