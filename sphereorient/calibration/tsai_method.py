"""Calibration of one camera of Tsai's model, and the first guess of all cameras, the start of `bundle`."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.bundle import Rig
from sphereorient.calibration.document import CalibrationDocument
from sphereorient.calibration.solve import checked_points, fit_to_points, rms_px
from sphereorient.calibration.targets import PlateView
from sphereorient.cameras import Camera, PinholeCamera, Port, PortCamera
from sphereorient.cameras.brown import TsaiCamera
from sphereorient.cameras.checks import camera_error, check_image_size, check_positive
from sphereorient.cameras.io.cameras_yaml import MODELS
from sphereorient.cameras.model import middle_of_picture
from sphereorient.cameras.parameters import ROTATION, TRANSLATION
from sphereorient.errors import CameraError

FLAT = 3e-3  # relief over length below which points count as a plane
LINE = 1e-6  # width over length below which points are on a line
POINTS_OF_PLANE, POINTS_OF_SPACE = 5, 7  # Tsai's least numbers
FOCAL, TRIED = (1.0, 60.0), 15  # focal lengths tried, over the largest distance of a pixel from the picture's middle
UNCERTAIN_F = 0.1  # sigma of f over f beyond which f and T_z cannot be separated
MISFIT = 0.01  # rms over the picture's diagonal; larger than of any lens with one kappa
ADD = "add points"
Pose = tuple[Tensor, Tensor]  # R (3, 3) and T (3,), mm
FREE = ("f", "kappa1", *ROTATION, *TRANSLATION)
POINTS_MIN = 6  # least points of a usable picture
VIEWS_MIN = 3  # least pictures of a camera: two planes do not determine the focal length
SAME = ("image_size", "R_cam_lab", "T_cam_lab_mm", "centre_px")  # fields of all models


def calibrate_tsai(
    x_lab_mm: Tensor, uv_px: Tensor, image_size: tuple[int, int], pixel_pitch_mm: tuple[float, float]
) -> TsaiCamera:
    """Calibrate a camera from points (n, 3), lab, mm, and their pixels (n, 2), by least squares of f, kappa1, R and T.
    The picture has `image_size` (W, H), px, the sensor a pixel pitch along u and v, mm. s_x is 1 and the centre the
    picture's middle; `fit_to_points` fits these too. Points in one plane also fit as seen from behind: give the seen
    side. Raises CameraError (points too few, collinear, parallel to the sensor, mirrored, not finite, or of other
    pixels), ShapeError (arrays of another shape).
    Source: Tsai 1987 (model); Terzakis and Lourakis 2020 (SQPnP, the start for each of some focal lengths).
    """
    points, pixels = checked_points(x_lab_mm, uv_px)
    check_image_size("image_size", image_size)
    pitch = torch.tensor(pixel_pitch_mm, dtype=torch.float64)
    check_positive("pixel_pitch_mm", pitch)
    flat = _is_flat(points)
    centre, fitted = middle_of_picture(image_size), []
    for f_mm, R, T in _starts(points, (pixels - centre) * pitch):
        pose: dict[str, Any] = {"f_mm": f_mm, "R_cam_lab": R, "T_cam_lab_mm": T, "sx": 1.0, "kappa1": 0.0}
        start = TsaiCamera(image_size=image_size, centre_px=centre, pixel_pitch_mm=pitch, **pose)
        with suppress(CameraError):
            fitted.append(fit_to_points(start, FREE, points, pixels))
    if not fitted and flat:
        raise _parallel("none")
    if not fitted:
        do = "check the points' order and the axes' signs (lab right-handed, u to the right, v downwards)"
        raise camera_error("points", "points as a camera sees them", "their mirror image, or others", do)
    camera = min(fitted, key=lambda one: torch.tensor(rms_px(one, points, pixels)).nan_to_num(torch.inf))
    _check_fit(camera, points, pixels)
    return camera


def _is_flat(points: Tensor) -> bool:
    """Return whether points (n, 3) lie in a plane; CameraError for too few, or points on a line."""
    some = points if len(points) else points.new_zeros(1, 3)
    height, width, length = torch.linalg.eigvalsh(some.mT.cov(correction=0)).clamp_min(0).sqrt().tolist()
    flat: bool = height <= FLAT * length
    least, where = (POINTS_OF_PLANE, "in one plane") if flat else (POINTS_OF_SPACE, "in space")
    if len(points) < least:
        raise camera_error("points", f"{least} or more {where}", f"{len(points)}", ADD)
    if not width > LINE * length:
        raise camera_error("x_lab_mm", "points in a plane or in space", "points on a line", ADD)
    return flat


def _starts(points: Tensor, sensor_mm: Tensor) -> list[tuple[float, Tensor, Tensor]]:
    """Return f, R and T of the best poses: the best one, and the best of those rotated far from it."""
    middle, found = points.mean(0), []
    for f_mm in np.geomspace(*FOCAL, TRIED) * float(sensor_mm.abs().max()):
        K = np.diag([f_mm, f_mm, 1.0])
        arrays = (points - middle).numpy(), sensor_mm.numpy(), K, None
        with suppress(cv2.error):  # pixels too near to each other
            _, turns, moves, misses = cv2.solvePnPGeneric(*arrays, flags=cv2.SOLVEPNP_SQPNP)
            for turn, move, miss in zip(turns, moves, misses[:, 0], strict=True):
                R = so3.exp(torch.from_numpy(turn[:, 0]))
                found.append((float(miss), f_mm, R, torch.from_numpy(move[:, 0]) - R @ middle))
    found.sort(key=lambda one: one[0])
    best = found[:1]
    best += [one for one in found if float(so3.geodesic_distance(one[2], best[0][2])) > 0.2][:1]
    return [one[1:] for one in best]


def _check_fit(camera: TsaiCamera, points: Tensor, pixels: Tensor) -> None:
    miss_px, diagonal_px = rms_px(camera, points, pixels), float(torch.tensor(camera.image_size).double().norm())
    if not miss_px <= MISFIT * diagonal_px:
        got, do = f"rms {miss_px:.3g} px", "check their order, their signs and the pixel pitch"
        raise camera_error("points", f"pixels of these points, to {MISFIT * diagonal_px:.2g} px", got, do)
    assert camera.covariance is not None
    f_mm, sigma_mm = float(camera.f_mm), camera.covariance.sigmas["f"]
    if not sigma_mm <= UNCERTAIN_F * f_mm:
        raise _parallel(f"{f_mm:.3g} mm, sigma {sigma_mm:.2g}")


def _parallel(got: str) -> CameraError:
    do = "tilt the plate by 20 degrees or more, or add points at other depths"
    return camera_error("f", "points at different depths, to separate f from T_z", got, do)


def guess_rig(document: CalibrationDocument, views: Mapping[str, Mapping[int, PlateView]]) -> Rig:
    """Return cameras without distortion and plate poses from the tied views of each camera, keyed by row of the pose.
    T is NaN for a pose without enough points; CameraError for too few pictures, or a camera that shares no pose.
    Source: Zhang 2000 (OpenCV's calibrateCamera).
    """
    lenses = {name: _zhang(name, seen, document) for name, seen in views.items()}
    placed, plate = _chained({name: relative for name, (_, _, relative) in lenses.items()}, document.surveyed)
    cameras: dict[str, Camera] = {}
    for name, (f_px, centre_px, _) in lenses.items():
        R, T = placed[name]
        pose: dict[str, Any] = {"image_size": document.keys.image_size, "R_cam_lab": R, "T_cam_lab_mm": T}
        cameras[name] = _camera(document, name, PinholeCamera(f_px=f_px, centre_px=centre_px, **pose))
    unknown = torch.eye(3, dtype=torch.float64), torch.full((3,), torch.nan, dtype=torch.float64)
    R_all, T_all = zip(*(plate.get(row, unknown) for row in range(len(document.poses))), strict=True)
    return Rig(cameras=cameras, R_lab_plate=torch.stack(R_all), T_lab_plate_mm=torch.stack(T_all))


def guess_from_points(document: CalibrationDocument, name: str, x_lab_mm: Tensor, uv_px: Tensor) -> Camera:
    """Return a camera without distortion from lab points (n, 3), mm, and pixels (n, 2), by Tsai 1987 (CameraError)."""
    found = calibrate_tsai(x_lab_mm, uv_px, document.keys.image_size, document.keys.pixel_pitch)
    same: dict[str, Any] = {name: getattr(found, name) for name in SAME}
    return _camera(document, name, PinholeCamera(f_px=found.f_mm / document.keys.pixel_pitch[1], **same))


def _camera(document: CalibrationDocument, name: str, start: PinholeCamera) -> Camera:
    """Return a camera of the document's model, behind its port if it has one, from a pinhole camera in the liquid.
    Distortion starts at the defaults of the model.
    """
    port, (pitch_u, pitch_v), kind = document.ports.get(name), document.keys.pixel_pitch, MODELS[document.keys.model]
    start = start if port is None else _in_air(start, port)
    fields: dict[str, Any] = {key.field: (key.default,) * len(key.parts) or key.default for key in kind.KEYS}
    square = any(key.field == "f_px" and key.place is None for key in kind.KEYS)
    if square and pitch_u != pitch_v:
        got, do = f"pixel_pitch {pitch_u:g}, {pitch_v:g}", "choose model: tsai or brown"
        raise camera_error(f"model: {kind.MODEL}", "square pixels", got, do)
    f_px = start.f_px if square else torch.stack([start.f_px * pitch_v / pitch_u, start.f_px])
    focal = {"f_px": f_px, "f_mm": start.f_px * pitch_v, "pixel_pitch_mm": (pitch_u, pitch_v)}
    fields |= {field: value for field, value in focal.items() if field in fields}
    lens = kind(**fields | {field: getattr(start, field) for field in SAME})
    return lens if port is None else PortCamera(camera=lens, port=port)


def _zhang(
    name: str, seen: Mapping[int, PlateView], document: CalibrationDocument
) -> tuple[Tensor, Tensor, dict[int, Pose]]:
    """Return focal length (px along v), centre (px) and the plate's poses in one camera's frame."""
    rows = [row for row, view in sorted(seen.items()) if len(view) >= POINTS_MIN]
    if len(rows) < VIEWS_MIN:
        got, do = f"{len(rows)}", "take pictures of the plate in more poses, tilted differently"
        raise camera_error(name, f"{VIEWS_MIN} pictures or more with {POINTS_MIN} points of the plate", got, do)
    points = [seen[row].points_plate_mm.astype(np.float32) for row in rows]
    pixels = [seen[row].uv_px.astype(np.float32) for row in rows]
    (width, height), (pitch_u, pitch_v) = document.keys.image_size, document.keys.pixel_pitch
    guess = np.array([[pitch_v / pitch_u * 3000.0, 0, width / 2], [0, 3000.0, height / 2], [0, 0, 1]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_FIX_PRINCIPAL_POINT  # a free one hardly improves the guess, and spoils it for weak sets of poses
    none: Any = None
    _, K, _, turns, moves = cv2.calibrateCamera(points, pixels, document.keys.image_size, guess, none, flags=flags)
    turn, move = (torch.from_numpy(np.stack(parts)[..., 0]) for parts in (turns, moves))
    relative = {row: (so3.exp(turn[k]), move[k]) for k, row in enumerate(rows)}
    lens = torch.from_numpy(K)
    return lens[1, 1], lens[:2, 2], relative


def _chained(
    relative: Mapping[str, Mapping[int, Pose]], surveyed: Mapping[int, Pose]
) -> tuple[dict[str, Pose], dict[int, Pose]]:
    """Propagate the lab frame from the surveyed poses to cameras, from these to other poses, and so on."""
    plate, placed = dict(surveyed), dict[str, Pose]()
    grown = True
    while grown:
        grown = False
        for name, poses in relative.items():
            known = [row for row in poses if row in plate]
            if name not in placed and known:
                (R_cam_plate, T_cam_plate), (R_lab_plate, T_lab_plate) = poses[known[0]], plate[known[0]]
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


def _in_air(start: PinholeCamera, port: Port) -> PinholeCamera:
    """Return the camera in air for one in the liquid, by Snell's law for small angles."""
    R, centre, normal, n = start.R_cam_lab, start.centre_lab_mm, port.normal_lab, float(port.n_fluid)
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
    return replace(start, f_px=start.f_px / n, R_cam_lab=R, T_cam_lab_mm=-(R @ centre))
