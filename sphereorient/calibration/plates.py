"""Calibration step by step: pictures of a plate, or tables -> points -> guess -> joint fit -> cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.calibration.bundle import Fitted, adjust
from sphereorient.calibration.document import CalibrationDocument, Picture, load_calibration
from sphereorient.calibration.guess import guess_from_points, guess_rig
from sphereorient.calibration.placing import placed
from sphereorient.calibration.points import read_tables
from sphereorient.calibration.problem import Problem, Rig, fitted_parameters, gathered
from sphereorient.calibration.see import see_plate
from sphereorient.calibration.view import PlateView
from sphereorient.cameras import Camera
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.errors import CameraError, refusal
from sphereorient.files.picture import claimed_pixels, decoded_grey
from sphereorient.files.whole_file import read_whole

LARGEST_BYTES, LARGEST_PIXELS = 300_000_000, 67_000_000  # of a picture of a plate
Progress = Callable[[str, int, int], None]
CLEARLY = 0.25  # of the distance of neighbouring points: a floating view is tied where one reading fits this well
# Standard deviations of what counts as undetermined: of focal length, distance, picture's width; rad
LOOSE = {"f": 0.01, "T": 0.01, "centre": 0.02, "rotation": 0.01}
LOOSE_PORT = {"port_offset": 5.0, "port_thickness": 5.0, "port_n_glass": 0.1, "port_n_fluid": 0.05, "port_tilt": 0.05}


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureReport:
    """What became of one picture; made by `calibrate_cameras`, read by table and figure."""

    picture: Picture
    pose: int
    view: PlateView
    residual_px: NDArray[np.float64]  # (n, 2), measured less expected
    used: NDArray[np.bool_]  # (n,), False for outliers
    reason: str  # why nothing of it was used; empty where it was

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance of measured from expected points, outliers left out; NaN without any."""
        missed = self.residual_px[self.used]
        return float(np.sqrt((missed**2).sum(1).mean())) if len(missed) else float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibrated:
    """Cameras with what is known of their errors; made by `calibrate_cameras`."""

    cameras: Mapping[str, Camera]  # each with its own covariance
    covariance: ParameterCovariance  # of all cameras together, names such as cam1.f
    R_lab_plate: Tensor  # (P, 3, 3)
    T_lab_plate_mm: Tensor  # (P, 3)
    pictures: tuple[PictureReport, ...]
    scale: float  # residuals over their expected standard deviations

    def rms_px(self, camera: str) -> float:
        """Root of the mean squared distance of one camera's measured from expected points."""
        missed = [one.residual_px[one.used] for one in self.pictures if one.picture.camera == camera]
        return float(np.sqrt((np.concatenate(missed) ** 2).sum(1).mean()))


def silent(stage: str, done: int, total: int) -> None:
    """Tell nobody."""


def calibrate_cameras(calibration: CalibrationDocument | Path | str, progress: Progress = silent) -> Calibrated:
    """Find the cameras of a calibration.yaml.

    Args:
        calibration: as loaded, or the path of its file.
        progress: told how far each stage is.

    Returns:
        Cameras in the lab that the surveyed pose defines, with covariances, and what became of each picture.

    Raises:
        CameraError: a picture that cannot be read or is of another size, no picture that shows the plate, poses that
            leave a parameter undetermined.
    """
    document = calibration if isinstance(calibration, CalibrationDocument) else load_calibration(calibration)
    views = read_tables(document) if document.points else see_pictures(document, progress)
    tied = {picture: view for picture, view in views.items() if view.state == "tied"}
    _check_seen(document, views, tied)
    progress("fit", 0, 1)
    rig = _first_rig(document, tied)
    tied = {picture: view for picture, view in tied.items() if _placed(rig, picture)}
    fitted = adjust(_problem(document, rig, tied))
    found = {} if document.points else tie_floating(document, fitted.rig, views)
    if found:
        tied |= found
        fitted = adjust(_problem(document, fitted.rig, tied))
    _check_determined(document, fitted)
    progress("fit", 1, 1)
    return _collected(document, views, tied, fitted)


def _first_rig(document: CalibrationDocument, tied: Mapping[Picture, PlateView]) -> Rig:
    size, pitch, model = document.image_size, document.pixel_pitch_mm, document.model
    if not document.points:
        views = _by_camera(document, tied)
        return guess_rig(views, size, pitch, document.surveyed, document.ports, len(document.poses), model)
    cameras = {}
    for picture, view in tied.items():
        name = picture.camera
        arrays = torch.from_numpy(view.points_plate_mm), torch.from_numpy(view.uv_px)
        try:
            cameras[name] = guess_from_points(*arrays, size, pitch, document.ports.get(name), model)
        except CameraError as error:
            raise CameraError(f"{picture.path}, {error}") from None
    (R, T) = document.surveyed[0]
    return Rig(cameras=cameras, R_lab_plate=R[None], T_lab_plate_mm=T[None])


def _placed(rig: Rig, picture: Picture) -> bool:
    """Tell whether the guess knows where the plate is: of a picture with a handful of points it does not."""
    return bool(torch.isfinite(rig.T_lab_plate_mm[picture.row]).all())


def see_pictures(document: CalibrationDocument, progress: Progress) -> dict[Picture, PlateView]:
    """Read all pictures and find the plate in them."""
    assert document.plate is not None
    plate = document.plate
    # All are read first: what is wrong with a file is said before anything is computed.
    grey = [read_grey(picture.path, document.image_size) for picture in document.pictures]
    views = {}
    with ThreadPoolExecutor(2) as pool:
        seen = pool.map(
            lambda pair: see_plate(pair[1], plate, pair[0].path.name), zip(document.pictures, grey, strict=True)
        )
        progress("pictures", 0, len(grey))
        for picture, view in zip(document.pictures, seen, strict=True):
            views[picture] = view
            progress("pictures", len(views), len(grey))
    return views


def read_grey(path: Path, image_size: tuple[int, int]) -> NDArray[Any]:
    """Read a picture, (H, W).

    Raises:
        CameraError: no such file, no picture, or one of another size.
    """
    content = read_whole(path, LARGEST_BYTES, "a picture", CameraError, "correct the path")
    pixels = claimed_pixels(content)
    # A file that claims more than any camera has is not decoded to find out.
    picture = decoded_grey(content) if pixels is not None and pixels <= LARGEST_PIXELS else None
    if picture is None:
        raise CameraError(refusal(str(path), expected="a picture", got="a file that is none", do="save it as PNG"))
    if picture.shape != image_size[::-1]:
        expected, got = (f"{w} x {h} px" for w, h in (image_size, picture.shape[::-1]))
        do = "correct image_size, or leave the picture out"
        raise CameraError(refusal(str(path), expected=expected, got=got, do=do))
    return np.asarray(picture)


def _check_seen(
    document: CalibrationDocument, views: Mapping[Picture, PlateView], tied: Mapping[Picture, PlateView]
) -> None:
    for name in document.cameras:
        of_camera = [picture for picture in views if picture.camera == name]
        if not any(picture in tied for picture in of_camera):
            reasons = [views[picture].reason for picture in of_camera]
            do = "check plate: in the file, and the pictures"
            got = f"none of {len(of_camera)}; the first: {reasons[0]}"
            raise CameraError(refusal(f"{document.path}, {name}", expected="pictures of the plate", got=got, do=do))


def _by_camera(document: CalibrationDocument, tied: Mapping[Picture, PlateView]) -> dict[str, dict[int, PlateView]]:
    return {
        name: {picture.row: view for picture, view in tied.items() if picture.camera == name}
        for name in document.cameras
    }


def _problem(document: CalibrationDocument, rig: Rig, tied: Mapping[Picture, PlateView]) -> Problem:
    views = _by_camera(document, tied)
    return Problem(
        rig=rig,
        seen={name: gathered(seen) for name, seen in views.items()},
        names={
            name: fitted_parameters(camera, document.fit_ports if name in document.ports else ())
            for name, camera in rig.cameras.items()
        },
        fixed=frozenset(document.surveyed),
    )


def tie_floating(
    document: CalibrationDocument, rig: Rig, views: Mapping[Picture, PlateView]
) -> dict[Picture, PlateView]:
    """Tie views that do not show the fiducials through cameras that saw the same pose with them.

    A view stays floating where its pose is not known, or no reading of it, or more than one, fits.
    """
    assert document.plate is not None
    known = {picture.row for picture, view in views.items() if view.state == "tied" and _placed(rig, picture)}
    tied = {}
    for picture, view in views.items():
        if view.state != "floating" or picture.row not in known:
            continue
        readings = [placed(view, document.plate, placement) for placement in view.placements]
        missed = [_missed(rig, picture, reading) for reading in readings]
        order = np.argsort(missed)
        step = _step_px(view)
        if missed[order[0]] < CLEARLY * step and (len(order) == 1 or missed[order[1]] > 2 * CLEARLY * step):
            tied[picture] = readings[order[0]]
    return tied


def _missed(rig: Rig, picture: Picture, view: PlateView) -> float:
    R, T = rig.R_lab_plate[picture.row], rig.T_lab_plate_mm[picture.row]
    expected = rig.cameras[picture.camera].project(torch.from_numpy(view.points_plate_mm) @ R.mT + T)
    return float(np.nan_to_num(np.median(np.linalg.norm(view.uv_px - expected.numpy(), axis=1)), nan=np.inf))


def _step_px(view: PlateView) -> float:
    """Typical distance of neighbouring points in the picture."""
    apart = np.linalg.norm(view.uv_px[:, None] - view.uv_px[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(1)))


def _check_determined(document: CalibrationDocument, fitted: Fitted) -> None:
    """Refuse a fit in which a camera's parameter is hardly determined, and name the loosest."""
    loose = []
    for name, camera in fitted.rig.cameras.items():
        for parameter, sigma in _sigmas(camera).items():
            share = sigma / _size_of(camera, parameter, document)
            if not share < 1:
                loose.append((share, f"{name}.{parameter} (sigma {sigma:.3g})"))
    if loose:
        named = ", ".join(text for _, text in sorted(loose, reverse=True)[:3])
        do = "add pictures of the plate in other poses: tilted about both axes, nearer and farther"
        expected = "poses that determine all parameters of the cameras"
        raise CameraError(refusal(str(document.path), expected=expected, got=f"loose: {named}", do=do))


def _sigmas(camera: Camera) -> dict[str, float]:
    return {} if camera.covariance is None else camera.covariance.sigmas


def _size_of(camera: Camera, parameter: str, document: CalibrationDocument) -> float:
    """Return the standard deviation at which a parameter counts as undetermined."""
    if parameter.startswith("T_"):
        return LOOSE["T"] * float(camera.T_cam_lab_mm.norm())
    if parameter.startswith("rotation"):
        return LOOSE["rotation"]
    if parameter.startswith(("centre", "cx", "cy")):
        return LOOSE["centre"] * document.image_size[0]
    if parameter in ("f", "f_px", "fx", "fy"):
        inner: Any = getattr(camera, "camera", camera)
        value = inner.f_mm if parameter == "f" else inner.f_px
        return LOOSE["f"] * float(torch.as_tensor(value).max())
    for name, size in LOOSE_PORT.items():
        if parameter.startswith(name):
            return size
    return float("inf")  # distortion: the others tell


def _collected(
    document: CalibrationDocument,
    views: Mapping[Picture, PlateView],
    tied: Mapping[Picture, PlateView],
    fitted: Fitted,
) -> Calibrated:
    reports = []
    begin = dict.fromkeys(document.cameras, 0)
    shares = {}
    for picture in sorted(tied, key=lambda picture: picture.row):
        first = begin[picture.camera]
        begin[picture.camera] = first + len(tied[picture])
        shares[picture] = slice(first, begin[picture.camera])
    for picture, view in views.items():
        if picture in tied:
            share, name = shares[picture], picture.camera
            residual, used = fitted.residual_px[name][share].numpy(), fitted.used[name][share].numpy()
            report = (tied[picture], residual, used, "")
        else:
            few = f"{picture.path.name}: {len(view)} points, too few to tell the pose"
            report = (view, np.zeros((0, 2)), np.zeros(0, bool), view.reason or few)
        reports.append(_report(document, picture, *report))
    count = sum(len(_sigmas(camera)) for camera in fitted.rig.cameras.values())
    return Calibrated(
        cameras=fitted.rig.cameras,
        covariance=ParameterCovariance(names=fitted.labels[:count], matrix=fitted.covariance[:count, :count]),
        R_lab_plate=fitted.rig.R_lab_plate,
        T_lab_plate_mm=fitted.rig.T_lab_plate_mm,
        pictures=tuple(reports),
        scale=fitted.scale,
    )


def _report(
    document: CalibrationDocument,
    picture: Picture,
    view: PlateView,
    residual: NDArray[np.float64],
    used: NDArray[np.bool_],
    reason: str,
) -> PictureReport:
    return PictureReport(
        picture=picture,
        pose=document.poses[picture.row],
        view=view,
        residual_px=residual,
        used=used,
        reason=reason,
    )
