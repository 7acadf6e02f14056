from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.bundle import Rig
from sphereorient.calibration.document import CalibrationDocument
from sphereorient.calibration.targets import PlateView
from sphereorient.calibration.tsai_method import calibrate_tsai
from sphereorient.cameras import Camera, Port, PortCamera
from sphereorient.cameras.checks import camera_error
from sphereorient.cameras.io.cameras_yaml import MODELS

POINTS_MIN = 6  # of a picture that is used
VIEWS_MIN = 3  # of a camera: two planes do not determine the focal length
Pose = tuple[Tensor, Tensor]  # R (3, 3) and T (3,), mm


@dataclass(frozen=True, kw_only=True, eq=False)
class _Start:
    f_px: float  # along v
    centre_px: tuple[float, float]
    R_cam_lab: Tensor  # (3, 3)
    T_cam_lab_mm: Tensor  # (3,)


def guess_rig(document: CalibrationDocument, views: Mapping[str, Mapping[int, PlateView]]) -> Rig:
    """Return cameras without distortion and plate poses from the tied views of each camera, keyed by row of the pose.
    T is NaN for a pose without enough points; CameraError for too few pictures or a camera that shares no pose.
    Source: Zhang 2000 (OpenCV's calibrateCamera).
    """
    lenses = {name: _zhang(name, seen, document) for name, seen in views.items()}
    placed, plate = _chained({name: relative for name, (_, _, relative) in lenses.items()}, document.surveyed)
    cameras: dict[str, Camera] = {}
    for name, (f_px, centre, _) in lenses.items():
        R, T = placed[name]
        cameras[name] = _camera(document, name, _Start(f_px=f_px, centre_px=centre, R_cam_lab=R, T_cam_lab_mm=T))
    R_all = torch.eye(3, dtype=torch.float64).repeat(len(document.poses), 1, 1)
    T_all = torch.full((len(document.poses), 3), torch.nan, dtype=torch.float64)
    for row, (R, T) in plate.items():
        R_all[row], T_all[row] = R, T
    return Rig(cameras=cameras, R_lab_plate=R_all, T_lab_plate_mm=T_all)


def guess_from_points(document: CalibrationDocument, name: str, x_lab_mm: Tensor, uv_px: Tensor) -> Camera:
    """Return a camera without distortion from lab points (n, 3), mm, and pixels (n, 2), by Tsai 1987 (CameraError)."""
    found = calibrate_tsai(x_lab_mm, uv_px, document.image_size, document.pixel_pitch_mm)
    start = _Start(
        f_px=float(found.f_mm) / document.pixel_pitch_mm[1],
        centre_px=(float(found.centre_px[0]), float(found.centre_px[1])),
        R_cam_lab=found.R_cam_lab,
        T_cam_lab_mm=found.T_cam_lab_mm,
    )
    return _camera(document, name, start)


def _camera(document: CalibrationDocument, name: str, start: _Start) -> Camera:
    port, kind = document.ports.get(name), MODELS[document.model]
    start = start if port is None else _in_air(start, port)
    fields: dict[str, Any] = kind.ideal_lens(start.f_px, document.pixel_pitch_mm)
    fields |= {"centre_px": start.centre_px, "R_cam_lab": start.R_cam_lab, "T_cam_lab_mm": start.T_cam_lab_mm}
    lens = kind(image_size=document.image_size, **fields)
    return lens if port is None else PortCamera(camera=lens, port=port)


def _zhang(
    name: str, seen: Mapping[int, PlateView], document: CalibrationDocument
) -> tuple[float, tuple[float, float], dict[int, Pose]]:
    """Return focal length (px along v), centre (px) and the plate's poses in one camera's frame."""
    rows = [row for row, view in sorted(seen.items()) if len(view) >= POINTS_MIN]
    if len(rows) < VIEWS_MIN:
        got, do = f"{len(rows)}", "take pictures of the plate in more poses, tilted differently"
        raise camera_error(name, f"{VIEWS_MIN} pictures or more with {POINTS_MIN} points of the plate", got, do)
    points = [seen[row].points_plate_mm.astype(np.float32) for row in rows]
    pixels = [seen[row].uv_px.astype(np.float32) for row in rows]
    (width, height), (pitch_u, pitch_v) = document.image_size, document.pixel_pitch_mm
    guess = np.array([[pitch_v / pitch_u * 3000.0, 0, width / 2], [0, 3000.0, height / 2], [0, 0, 1]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_FIX_PRINCIPAL_POINT  # hardly improves the guess, and spoils it with a weak set of poses
    none: Any = None
    _, K, _, turns, moves = cv2.calibrateCamera(points, pixels, document.image_size, guess, none, flags=flags)
    relative = {}
    for row, turn, move in zip(rows, turns, moves, strict=True):
        relative[row] = so3.exp(torch.from_numpy(turn.reshape(3))), torch.from_numpy(move.reshape(3))
    return float(K[1, 1]), (float(K[0, 2]), float(K[1, 2])), relative


def _chained(
    relative: Mapping[str, Mapping[int, Pose]], surveyed: Mapping[int, Pose]
) -> tuple[dict[str, Pose], dict[int, Pose]]:
    """Propagate the lab frame from the surveyed poses to cameras, from those to other poses, and so on."""
    plate, placed = dict(surveyed), dict[str, Pose]()
    grown = True
    while grown:
        grown = False
        for name, poses in relative.items():
            known = [row for row in poses if row in plate]
            if name not in placed and known:
                R_cam_plate, T_cam_plate = poses[known[0]]
                R_lab_plate, T_lab_plate = plate[known[0]]
                R = R_cam_plate @ R_lab_plate.mT
                placed[name] = R, T_cam_plate - R @ T_lab_plate
                grown = True
            if name in placed:
                R, T = placed[name]
                for row in set(poses) - set(plate):
                    plate[row] = R.mT @ poses[row][0], R.mT @ (poses[row][1] - T)
                    grown = True
    missing = [name for name in relative if name not in placed]
    if missing:
        do = "take a picture of one pose with both cameras, or let each see a surveyed pose"
        raise camera_error(missing[0], "a picture of a known pose", "none that ties it to the surveyed pose", do)
    return placed, plate


def _in_air(start: _Start, port: Port) -> _Start:
    """Return the camera in air for one in the liquid: small-angle Snell, angles times n, distance to the wall / n."""
    R, T, normal, n = start.R_cam_lab, start.T_cam_lab_mm, port.normal_lab, float(port.n_fluid)
    centre = -(R.mT @ T)
    height = float(centre @ normal) - float(port.offset_mm)
    true_height = height / n + float(port.thickness_mm) * (1 - 1 / float(port.n_glass))
    centre = centre + (true_height - height) * normal
    axis = R[2]
    along = axis - (axis @ normal) * normal
    across = (1 - (n * along).square().sum()).clamp_min(0.1).sqrt() * normal
    swing = torch.linalg.cross(axis, torch.nn.functional.normalize(n * along - across, dim=0))
    size = swing.norm()
    if float(size) > 1e-12:
        R = R @ so3.exp(swing / size * torch.asin(size.clamp_max(1.0))).mT
    return _Start(f_px=start.f_px / n, centre_px=start.centre_px, R_cam_lab=R, T_cam_lab_mm=-(R @ centre))
