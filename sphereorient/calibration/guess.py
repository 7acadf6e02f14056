"""Where the fit begins: each camera by Zhang's method, the poses handed from camera to camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.problem import Rig
from sphereorient.calibration.tsai_method import calibrate_tsai
from sphereorient.calibration.view import PlateView
from sphereorient.cameras.brown import BrownCamera
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.pinhole import PinholeCamera
from sphereorient.cameras.port import Port, PortCamera
from sphereorient.cameras.tsai import TsaiCamera
from sphereorient.errors import CameraError, refusal

POINTS_MIN = 6  # of a picture that is used
VIEWS_MIN = 3  # of a camera: two planes leave the focal length to chance
Pose = tuple[Tensor, Tensor]  # R (3, 3) and T (3,), mm


def guess_rig(
    views: Mapping[str, Mapping[int, PlateView]],
    image_size: tuple[int, int],
    pixel_pitch_mm: tuple[float, float],
    surveyed: Mapping[int, Pose],
    ports: Mapping[str, Port],
    poses: int,
    model: str = "tsai",
) -> Rig:
    """Return cameras and plate poses to begin with.

    Args:
        views: of each camera, by row of the pose; tied ones.
        image_size: W, H px.
        pixel_pitch_mm: of the sensor.
        surveyed: R_lab_plate and T_lab_plate (mm) of the poses that define the lab.
        ports: of cameras that look through a wall.
        poses: their number.
        model: tsai, pinhole or brown.

    Returns:
        Cameras without distortion, and poses; T of a pose that no picture with enough points shows is NaN.

    Raises:
        CameraError: too few pictures of a camera, or one that shares no pose with the others.

    Source: Zhang 2000 (OpenCV's calibrateCamera).
    """
    lenses = {name: _zhang(name, seen, image_size, pixel_pitch_mm) for name, seen in views.items()}
    placed, plate = _chained({name: relative for name, (_, _, relative) in lenses.items()}, surveyed)
    cameras: dict[str, Camera] = {}
    for name, (f_px, centre, _) in lenses.items():
        cameras[name] = _camera(model, image_size, placed[name], f_px, centre, pixel_pitch_mm, ports.get(name))
    R_all = torch.eye(3, dtype=torch.float64).repeat(poses, 1, 1)
    T_all = torch.full((poses, 3), torch.nan, dtype=torch.float64)
    for row, (R, T) in plate.items():
        R_all[row], T_all[row] = R, T
    return Rig(cameras=cameras, R_lab_plate=R_all, T_lab_plate_mm=T_all)


def guess_from_points(
    x_lab_mm: Tensor,
    uv_px: Tensor,
    image_size: tuple[int, int],
    pixel_pitch_mm: tuple[float, float],
    port: Port | None = None,
    model: str = "tsai",
) -> Camera:
    """Return a camera to begin with, from points whose places in the lab are known.

    Args:
        x_lab_mm: (n, 3), lab.
        uv_px: (n, 2), where the camera shows them.
        image_size: W, H px.
        pixel_pitch_mm: of the sensor.
        port: the wall that the camera looks through.
        model: tsai, pinhole or brown.

    Raises:
        CameraError: points that do not determine a camera.

    Source: Tsai 1987.
    """
    start = calibrate_tsai(x_lab_mm, uv_px, image_size, pixel_pitch_mm)
    centre = (float(start.centre_px[0]), float(start.centre_px[1]))
    f_px = float(start.f_mm) / pixel_pitch_mm[1]
    pose = start.R_cam_lab, start.T_cam_lab_mm
    return _camera(model, image_size, pose, f_px, centre, pixel_pitch_mm, port)


def _camera(
    model: str,
    image_size: tuple[int, int],
    pose: Pose,
    f_px: float,
    centre: tuple[float, float],
    pitch: tuple[float, float],
    port: Port | None,
) -> Camera:
    """Return a camera without distortion, behind its wall if there is one, from what it would be without the wall."""
    R, T = pose
    if port is not None:
        f_px, R, T = _before_the_wall(f_px, R, T, port)
    lens = _LENSES[model](image_size, R, T, f_px, torch.tensor(centre, dtype=torch.float64), pitch)
    return lens if port is None else PortCamera(camera=lens, port=port)


def _tsai(
    image_size: tuple[int, int], R: Tensor, T: Tensor, f_px: float, centre: Tensor, pitch: tuple[float, float]
) -> Camera:
    return TsaiCamera(
        image_size=image_size,
        R_cam_lab=R,
        T_cam_lab_mm=T,
        centre_px=centre,
        f_mm=torch.tensor(f_px * pitch[1], dtype=torch.float64),
        pixel_pitch_mm=torch.tensor(pitch, dtype=torch.float64),
        sx=torch.tensor(1.0, dtype=torch.float64),
        kappa1=torch.tensor(0.0, dtype=torch.float64),
    )


def _pinhole(
    image_size: tuple[int, int], R: Tensor, T: Tensor, f_px: float, centre: Tensor, pitch: tuple[float, float]
) -> Camera:
    if pitch[0] != pitch[1]:
        do = "choose model: tsai or brown"
        got = f"pixel_pitch {pitch[0]:g}, {pitch[1]:g}"
        raise CameraError(refusal("model: pinhole", expected="square pixels", got=got, do=do))
    f = torch.tensor(f_px, dtype=torch.float64)
    return PinholeCamera(image_size=image_size, R_cam_lab=R, T_cam_lab_mm=T, centre_px=centre, f_px=f)


def _brown(
    image_size: tuple[int, int], R: Tensor, T: Tensor, f_px: float, centre: Tensor, pitch: tuple[float, float]
) -> Camera:
    return BrownCamera(
        image_size=image_size,
        R_cam_lab=R,
        T_cam_lab_mm=T,
        centre_px=centre,
        f_px=torch.tensor([f_px * pitch[1] / pitch[0], f_px], dtype=torch.float64),
        k=torch.zeros(3, dtype=torch.float64),
        p=torch.zeros(2, dtype=torch.float64),
    )


_LENSES = {"tsai": _tsai, "pinhole": _pinhole, "brown": _brown}


def _zhang(
    name: str, seen: Mapping[int, PlateView], image_size: tuple[int, int], pitch: tuple[float, float]
) -> tuple[float, tuple[float, float], dict[int, Pose]]:
    """Return focal length (px along v), centre (px) and the plate's poses before one camera."""
    rows = [row for row, view in sorted(seen.items()) if len(view) >= POINTS_MIN]
    if len(rows) < VIEWS_MIN:
        do = "take pictures of the plate in more poses, tilted differently"
        expected, got = f"{VIEWS_MIN} pictures or more with {POINTS_MIN} points of the plate", f"{len(rows)}"
        raise CameraError(refusal(f"{name}", expected=expected, got=got, do=do))
    points = [seen[row].points_plate_mm.astype(np.float32) for row in rows]
    pixels = [seen[row].uv_px.astype(np.float32) for row in rows]
    guess = np.array([[pitch[1] / pitch[0] * 3000.0, 0, image_size[0] / 2], [0, 3000.0, image_size[1] / 2], [0, 0, 1]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_FIX_PRINCIPAL_POINT  # of little use to a guess, and of great harm with a weak set of poses
    none: Any = None
    _, K, _, turns, moves = cv2.calibrateCamera(points, pixels, image_size, guess, none, flags=flags)
    relative = {}
    for row, turn, move in zip(rows, turns, moves, strict=True):
        relative[row] = so3.exp(torch.from_numpy(turn.reshape(3))), torch.from_numpy(move.reshape(3))
    return float(K[1, 1]), (float(K[0, 2]), float(K[1, 2])), relative


def _chained(
    relative: Mapping[str, Mapping[int, Pose]], surveyed: Mapping[int, Pose]
) -> tuple[dict[str, Pose], dict[int, Pose]]:
    """Hand the lab frame from the surveyed poses to cameras, from those to other poses, and so on."""
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
        got = "none that ties it to the surveyed pose"
        raise CameraError(refusal(missing[0], expected="a picture of a known pose", got=got, do=do))
    return placed, plate


def _before_the_wall(f_px: float, R: Tensor, T: Tensor, port: Port) -> tuple[float, Tensor, Tensor]:
    """Return the camera in air that sees through a wall about what a camera in the liquid would see without it.

    For rays near the normal, Snell's law is a stretch: angles in air are n times those in the liquid, and the apparent
    camera stands n times as far behind the wall.
    """
    normal, n = port.normal_lab, float(port.n_fluid)
    centre = -(R.mT @ T)
    height = float(centre @ normal) - float(port.offset_mm)
    true_height = height / n + float(port.thickness_mm) * (1 - 1 / float(port.n_glass))
    centre = centre + (true_height - height) * normal
    axis = R[2]
    along = axis - (axis @ normal) * normal
    turned = torch.nn.functional.normalize(
        n * along - (1 - (n * along).square().sum()).clamp_min(0.1).sqrt() * normal, dim=0
    )
    swing = torch.linalg.cross(axis, turned)
    size = swing.norm()
    if float(size) > 1e-12:
        R = R @ so3.exp(swing / size * torch.asin(size.clamp_max(1.0))).mT
    return f_px / n, R, -(R @ centre)
