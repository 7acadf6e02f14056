"""Calibration from pictures of a plate or tables of points: points -> guess -> joint fit -> cameras."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sphereorient.calibration.boards import see_plate
from sphereorient.calibration.bundle import Fitted, Problem, Rig, adjust, fitted_parameters, gathered
from sphereorient.calibration.calibrated import Calibrated, PictureReport, doubts
from sphereorient.calibration.document import CalibrationDocument, Photo, load_calibration, read_points
from sphereorient.calibration.solve import SIGMA_PX
from sphereorient.calibration.targets import PlateView, placed
from sphereorient.calibration.tsai_method import guess_from_points, guess_rig
from sphereorient.cameras import ParameterCovariance, Port, PortCamera, centre_lab_mm, in_air
from sphereorient.cameras.checks import camera_error, named
from sphereorient.cameras.parameters import PORT_TILT
from sphereorient.errors import CameraError
from sphereorient.files.picture import claimed_pixels, decoded_grey
from sphereorient.files.threads import Progress, counted, side_by_side
from sphereorient.files.whole_file import read_whole

LARGEST_BYTES, LARGEST_PIXELS = 300_000_000, 67_000_000  # of a picture of a plate
WALL = 0.3  # of the way from the plates to the camera: start of the search for a wall
CLEARLY = 0.25  # of the distance of neighbouring points: misfit within which a floating view is tied
# Sigma from which a parameter counts as undetermined, by the beginning of its name: shares of focal length, distance
# and picture's width; mm, rad and indices. Undetermined distortion shows in these.
LOOSE_SHARE = {"f": 0.01, "T_": 0.01, "centre": 0.02, "cx": 0.02, "cy": 0.02}
LOOSE = {"rotation": 0.01, "port_offset": 5.0, "port_thickness": 5.0, "port_n_glass": 0.1, "port_n_fluid": 0.05}
LOOSE |= {"port_tilt": 0.05}


def calibrate_cameras(calibration: CalibrationDocument | Path | str, progress: Progress | None = None) -> Calibrated:
    """Calibrate the cameras of a calibration.yaml, loaded or by path, in the lab that the surveyed pose defines.
    `progress` is called with stage, done and total.

    Raises:
        CameraError: an unreadable picture or one of another size, no plate in them, or undetermined parameters.
    """
    progress = progress or (lambda stage, done, total: None)
    document = calibration if isinstance(calibration, CalibrationDocument) else load_calibration(calibration)
    views = _read_tables(document) if document.points else see_pictures(document, progress)
    tied = {picture: view for picture, view in views.items() if view.state == "tied"}
    _check_seen(document, views)
    progress("fit", 0, 1)
    rig = _first_rig(document, tied)
    tied = {picture: view for picture, view in tied.items() if picture.row in rig.posed}
    fitted = adjust(_problem(document, rig, tied))
    found = {} if document.points else tie_floating(document, fitted.rig, views)
    if found:
        tied |= found
        fitted = adjust(_problem(document, fitted.rig, tied))
    _check_determined(document, fitted)
    progress("fit", 1, 1)
    return _judged(document, tied, _collected(document, views, tied, fitted), progress)


def _read_tables(document: CalibrationDocument) -> dict[Photo, PlateView]:
    views = {}
    for name, path in document.points.items():
        table = read_points(path)
        zeros, index = np.zeros(len(table)), np.pad(np.arange(len(table))[:, None], ((0, 0), (0, 1)))
        view = PlateView(table[:, :3], table[:, 3:], zeros + SIGMA_PX, zeros, index)
        views[Photo(camera=name, row=0, path=path)] = view
    return views


def see_pictures(document: CalibrationDocument, progress: Progress) -> dict[Photo, PlateView]:
    """Read all pictures and find the plate in them."""
    assert document.plate is not None
    plate = document.plate
    # Read all files first, to report a faulty one before the long computation.
    grey = [read_plate_picture(picture.path, document.keys.image_size) for picture in document.pictures]

    def see(k: int) -> PlateView:
        return see_plate(grey[k], plate, document.pictures[k].path.name, document.pictures[k].clicked_px)

    views = counted("pictures", side_by_side(see, range(len(grey))), len(grey), progress)
    return dict(zip(document.pictures, views, strict=True))


def read_plate_picture(path: Path, image_size: tuple[int, int] | None = None) -> NDArray[Any]:
    """Return a picture's grey levels (H, W); CameraError if unreadable, too large, or not of `image_size` (W, H)."""
    content = read_whole(path, LARGEST_BYTES, "a picture", CameraError, "correct the path")
    pixels = claimed_pixels(content)
    # Do not decode a file that claims more pixels than any camera has.
    picture = decoded_grey(content) if pixels is not None and pixels <= LARGEST_PIXELS else None
    if picture is None:
        raise camera_error(str(path), "a picture", "a file that is no picture or too large", "save it as PNG")
    if image_size is not None and picture.shape != image_size[::-1]:
        expected, got = (f"{w} x {h} px" for w, h in (image_size, picture.shape[::-1]))
        raise camera_error(str(path), expected, got, "correct image_size, or leave the picture out")
    return np.asarray(picture)


def _check_seen(document: CalibrationDocument, views: Mapping[Photo, PlateView]) -> None:
    for name in document.cameras:
        own = [view for picture, view in views.items() if picture.camera == name]
        if all(view.state != "tied" for view in own):
            got, do = f"none of {len(own)}; the first: {own[0].reason}", "check plate: in the file, and the pictures"
            raise camera_error(f"{document.path}, {name}", "pictures of the plate", got, do)


def _first_rig(document: CalibrationDocument, tied: Mapping[Photo, PlateView]) -> Rig:
    if not document.points:
        return guess_rig(document, _by_camera(document, tied))
    cameras = {}
    for picture, view in tied.items():
        arrays = torch.from_numpy(view.points_plate_mm), torch.from_numpy(view.uv_px)
        with named(str(picture.path)):
            cameras[picture.camera] = guess_from_points(document, picture.camera, *arrays)
    R, T = document.surveyed[0]
    return Rig(cameras=cameras, R_lab_plate=R[None], T_lab_plate_mm=T[None])


def _by_camera(document: CalibrationDocument, tied: Mapping[Photo, PlateView]) -> dict[str, dict[int, PlateView]]:
    return {name: {one.row: view for one, view in tied.items() if one.camera == name} for name in document.cameras}


def _problem(document: CalibrationDocument, rig: Rig, tied: Mapping[Photo, PlateView]) -> Problem:
    of_port = {name: document.keys.fit_ports if name in document.ports else () for name in rig.cameras}
    return Problem(
        rig=rig,
        seen={name: gathered(seen) for name, seen in _by_camera(document, tied).items()},
        names={name: fitted_parameters(camera, of_port[name]) for name, camera in rig.cameras.items()},
        fixed=frozenset(document.surveyed),
    )


def tie_floating(document: CalibrationDocument, rig: Rig, views: Mapping[Photo, PlateView]) -> dict[Photo, PlateView]:
    """Tie views without fiducials through cameras that saw the same pose, if exactly one placement fits."""
    assert document.plate is not None
    known = {picture.row for picture, view in views.items() if view.state == "tied" and picture.row in rig.posed}
    tied = {}
    for picture, view in views.items():
        if view.state != "floating" or picture.row not in known:
            continue
        candidates = [placed(view, document.plate, placement) for placement in view.placements]
        missed = [_missed(rig, picture, candidate) for candidate in candidates]
        order = np.argsort(missed)
        tree: Any = cKDTree(view.uv_px)
        step = float(np.median(tree.query(view.uv_px, k=2)[0][:, 1]))  # to the neighbouring point
        if missed[order[0]] < CLEARLY * step and (len(order) == 1 or missed[order[1]] > 2 * CLEARLY * step):
            tied[picture] = candidates[order[0]]
    return tied


def _missed(rig: Rig, picture: Photo, view: PlateView) -> float:
    expected = rig.cameras[picture.camera].project(rig.placed(picture.row, view.points_plate_mm)).numpy()
    return float(np.nan_to_num(np.median(np.linalg.norm(view.uv_px - expected, axis=1)), nan=np.inf))


def _check_determined(document: CalibrationDocument, fitted: Fitted) -> None:
    loose = []
    for name, camera in fitted.rig.cameras.items():
        lens = in_air(camera)
        focal = float(getattr(lens, lens.KEYS[0].field).max())  # the first key of all models that are calibrated
        scale = {"f": focal, "T_": float(camera.T_cam_lab_mm.norm())}
        limits = {begin: share * scale.get(begin, camera.image_size[0]) for begin, share in LOOSE_SHARE.items()} | LOOSE
        for parameter, sigma in (camera.covariance.sigmas if camera.covariance else {}).items():
            share = sigma / next((limit for begin, limit in limits.items() if parameter.startswith(begin)), np.inf)
            if not share < 1:
                loose.append((share, f"{name}.{parameter} (sigma {sigma:.3g})"))
    if loose:
        got = f"loose: {', '.join(text for _, text in sorted(loose, reverse=True)[:3])}"
        do = "add pictures of the plate in other poses: tilted about both axes, nearer and farther"
        raise camera_error(str(document.path), "poses that determine all parameters of the cameras", got, do)


def _collected(
    document: CalibrationDocument, views: Mapping[Photo, PlateView], tied: Mapping[Photo, PlateView], fitted: Fitted
) -> Calibrated:
    reports = []
    for picture, view in views.items():
        residual, used = np.zeros((0, 2)), np.zeros(0, dtype=bool)
        reason = view.reason or f"{picture.path.name}: {len(view)} points, too few to determine the pose"
        if picture in tied:
            name, view, reason = picture.camera, tied[picture], ""
            rows = fitted.problem.seen[name].pose == picture.row
            residual, used = fitted.residual_px[name][rows].numpy(), fitted.used[name][rows].numpy()
        pose = document.poses[picture.row]
        report = PictureReport(picture=picture, pose=pose, view=view, residual_px=residual, used=used, reason=reason)
        reports.append(report)
    count = sum(len(names) for names in fitted.problem.names.values())
    names, matrix = tuple(fitted.problem.labels[:count]), fitted.covariance[:count, :count]
    return Calibrated(
        cameras=fitted.rig.cameras,
        covariance=ParameterCovariance(names=names, matrix=matrix),
        R_lab_plate=fitted.rig.R_lab_plate,
        T_lab_plate_mm=fitted.rig.T_lab_plate_mm,
        pictures=tuple(reports),
        scale=fitted.scale,
    )


def _judged(
    document: CalibrationDocument, tied: Mapping[Photo, PlateView], result: Calibrated, progress: Progress
) -> Calibrated:
    """Add signs of a wrong calibration, with the likeliest cause; CameraError if it cannot be trusted."""
    found = doubts(result)
    lines = [f"{name}: {'; '.join(doubt.words)}" for name, doubt in found.items()]
    structured = [name for name, doubt in found.items() if doubt.structured]
    if structured:
        progress("cause", 0, 1)
        lines.append(_cause(document, tied, result, structured))
        progress("cause", 1, 1)
    if any(doubt.hopeless for doubt in found.values()):
        *faults, do = lines
        raise camera_error(str(document.path), "residuals of noise alone", "; ".join(faults), do)
    return replace(result, verdict=tuple(lines))


def _cause(
    document: CalibrationDocument, tied: Mapping[Photo, PlateView], result: Calibrated, structured: Sequence[str]
) -> str:
    """Return advice: the change of lens or wall that removes the structure of the residuals, if there is one."""
    ports = {name: _wall_before(result, name) for name in structured} | dict(document.ports)
    wall = {"fit_ports": ("port_offset", "port_n_fluid", *PORT_TILT)}
    trials: dict[Callable[[Any], str], CalibrationDocument] = {
        lambda _: "`model: brown`": replace(document, keys=document.keys.model_copy(update={"model": "brown"})),
        _wall_words: replace(document, keys=document.keys.model_copy(update=wall), ports=ports),
    }
    name, causes = max(structured, key=result.rms_px), []
    for cause, other in trials.items():
        with suppress(CameraError):
            again = _collected(other, tied, tied, adjust(_problem(other, _first_rig(other, tied), tied)))
            if not any(doubt.structured for doubt in doubts(again).values()):
                causes.append((again.scale, f"{cause(again.cameras[name])} (rms {again.rms_px(name):.3f} px)"))
    if not causes:
        return "check that the plate is flat, its pitch, the focus of the pictures, and the walls under `ports`"
    words = ", or ".join(text for _, text in sorted(causes))
    return f"{name} (rms {result.rms_px(name):.3f} px) is explained by {words}"


def _wall_words(camera: PortCamera) -> str:
    offset, n_fluid = float(camera.port.offset_mm), float(camera.port.n_fluid)
    return f"a flat wall: describe it under `ports`, about {{offset: {offset:.0f}, n_fluid: {n_fluid:.2f}}}"


def _wall_before(result: Calibrated, name: str) -> Port:
    """Return a thin wall across a camera's axis, between the camera and its plates, with water behind it."""
    camera = result.cameras[name]
    normal = -camera.R_cam_lab[2]
    middle = centre_lab_mm(camera)
    placed = [
        result.R_lab_plate[one.picture.row] @ torch.from_numpy(one.view.points_plate_mm).mean(0)
        + result.T_lab_plate_mm[one.picture.row]
        for one in result.pictures
        if one.picture.camera == name and not one.reason
    ]
    plates, lens = float(torch.stack(placed).mean(0) @ normal), float(middle @ normal)
    numbers: dict[str, Any] = {"offset_mm": plates + WALL * (lens - plates), "thickness_mm": 0.0}
    return Port(normal=normal / normal.norm(), **numbers, n_glass=torch.tensor(1.5), n_fluid=torch.tensor(1.33))
