"""Two cameras at right angles, with and without walls, and their views of a plate held in many poses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.bundle import Fitted, Problem, Rig, adjust, disk_centre_shift, fitted_parameters, gathered
from sphereorient.calibration.document import CalibrationDocument, CalibrationKeys
from sphereorient.calibration.targets import DotPlate, PlateView
from sphereorient.calibration.tsai_method import guess_rig
from sphereorient.cameras import Camera, PinholeCamera, Port, PortCamera, TsaiCamera, triangulate
from sphereorient.cameras.brown import BrownCamera
from sphereorient.cameras.parameters import with_parameters

SIZE, PITCH = (650, 650), (0.02, 0.02)
PLATE = DotPlate(
    columns=7,
    rows=7,
    pitch_mm=14.0,
    dot_diameter_mm=3.2,
    fiducial_diameter_mm=5.0,
    fiducials=((0, 0), (2, 0), (0, 1)),
)
R_FIRST = so3.exp(torch.tensor([torch.pi / 4, 0.0, 0.0], dtype=torch.float64))  # seen equally well by both
PLACES = {
    "cam1": torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64),  # looks along +y, lab z up
    "cam2": torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=torch.float64),  # looks along -z
}
Views = dict[str, dict[int, PlateView]]


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def lens(model: str, R: Tensor, T: Tensor, f_px: float = 2250.0, kappa1: float = 2.2e-4) -> Camera:
    place = {"image_size": SIZE, "R_cam_lab": R, "T_cam_lab_mm": T}
    centre = vector(322.0, 327.5)
    if model == "pinhole":
        return PinholeCamera(**place, centre_px=centre, f_px=vector(f_px)[0])
    if model == "brown":
        k, p = vector(-0.3, 1.0, 0.0), vector(1e-3, -5e-4)
        return BrownCamera(**place, centre_px=centre, f_px=vector(f_px, 1.002 * f_px), k=k, p=p)
    return TsaiCamera(
        **place,
        centre_px=centre,
        f_mm=vector(f_px * PITCH[1])[0],
        pixel_pitch_mm=vector(*PITCH),
        sx=vector(1.0)[0],
        kappa1=vector(kappa1)[0],
    )


def port(name: str) -> Port:
    normal = -PLACES[name][2]
    return Port(normal=normal, offset_mm=120.0, thickness_mm=12.0, n_glass=1.49, n_fluid=1.36)


def cameras(model: str = "tsai", walls: bool = False, turned_deg: float = 0.5) -> dict[str, Camera]:
    """Cameras a little off the axes, so that no slope is zero by symmetry."""
    made: dict[str, Camera] = {}
    for k, (name, R) in enumerate(PLACES.items()):
        off = so3.exp(torch.deg2rad(turned_deg * vector(1.0, -0.7 + k, 0.5)))
        camera = lens(model, off @ R, vector(3.0, -2.0 + k, 520.0 + 8 * k), 1750.0 if walls else 2250.0)
        made[name] = PortCamera(camera=camera, port=port(name)) if walls else camera
    return made


def poses(count: int, rng: torch.Generator, tilt_deg: float = 25.0, shift_mm: float = 15.0) -> tuple[Tensor, Tensor]:
    """Plate poses: the first is surveyed, the others are tilted and shifted at random."""
    turn = torch.deg2rad(tilt_deg * (2 * torch.rand(count, 3, generator=rng, dtype=torch.float64) - 1))
    move = shift_mm * (2 * torch.rand(count, 3, generator=rng, dtype=torch.float64) - 1)
    turn[0], move[0] = 0.0, 0.0
    return so3.exp(turn) @ R_FIRST, move


def planted(rng: torch.Generator, model: str = "tsai", walls: bool = False, count: int = 8, **kind: float) -> Rig:
    R, T = poses(count, rng, **kind)
    return Rig(cameras=cameras(model, walls), R_lab_plate=R, T_lab_plate_mm=T)


def view(rig: Rig, name: str, row: int, rng: torch.Generator, noise_px: float = 0.03) -> PlateView:
    """Return the view of one camera of one pose: centroids with noise."""
    index = PLATE.indices
    points, width = torch.from_numpy(PLATE.points(index)), torch.from_numpy(PLATE.diameters(index))
    camera, R, T = rig.cameras[name], rig.R_lab_plate[row], rig.T_lab_plate_mm[row]
    uv = camera.project(points @ R.mT + T) + disk_centre_shift(camera, R, T, points, width)
    uv = uv + noise_px * torch.randn(uv.shape, generator=rng, dtype=torch.float64)
    whole = ((uv > 5) & (uv < torch.tensor(SIZE) - 5)).all(-1)
    return PlateView(
        points_plate_mm=points[whole].numpy(),
        uv_px=uv[whole].numpy(),
        sigma_px=np.full(int(whole.sum()), max(noise_px, 1e-3)),
        diameter_mm=width[whole].numpy(),
        index=index[whole.numpy()],
    )


def views(rig: Rig, rng: torch.Generator, noise_px: float = 0.03) -> Views:
    rows = range(len(rig.R_lab_plate))
    return {name: {row: view(rig, name, row, rng, noise_px) for row in rows} for name in rig.cameras}


def document(
    rig: Rig, model: str = "tsai", ports: Mapping[str, Port] | None = None, pitch: tuple[float, float] = PITCH
) -> CalibrationDocument:
    """Content of a calibration.yaml of the rig."""
    return CalibrationDocument(
        path=Path("calibration.yaml"),
        keys=CalibrationKeys(image_size=SIZE, pixel_pitch=pitch, model=model),
        plate=PLATE,
        poses=tuple(range(len(rig.R_lab_plate))),
        surveyed={0: (rig.R_lab_plate[0], rig.T_lab_plate_mm[0])},
        pictures=(),
        points={},
        cameras=tuple(rig.cameras),
        ports=ports or {},
    )


def problem(rig: Rig, seen: Views, of_port: tuple[str, ...] = ()) -> Problem:
    names = {name: fitted_parameters(camera, of_port) for name, camera in rig.cameras.items()}
    return Problem(
        rig=rig, seen={name: gathered(rows) for name, rows in seen.items()}, names=names, fixed=frozenset({0})
    )


def calibrated(rig: Rig, seen: Views, model: str = "tsai", ports: Mapping[str, Port] | None = None) -> Fitted:
    """Guess and fit, as from pictures."""
    return adjust(problem(guess_rig(document(rig, model, ports), seen), seen))


def triangulated_error_mm(found: Mapping[str, Camera], true: Mapping[str, Camera], half_mm: float = 30.0) -> float:
    """Rms error of points in a cube, seen by the true cameras and triangulated by the found ones."""
    points = half_mm * (2 * torch.rand(300, 3, generator=torch.Generator().manual_seed(1)).double() - 1)
    rays = [found[name].rays(true[name].project(points)) for name in true]
    return float((triangulate(*rays)[0] - points).norm(dim=-1).square().mean().sqrt())


def bumped(camera: Camera, turn_rad: Tensor, move_mm: Tensor) -> Camera:
    names = ("rotation_x", "rotation_y", "rotation_z", "T_x", "T_y", "T_z")
    return with_parameters(camera, names, torch.cat([turn_rad, move_mm]))


def change_of(found: Camera, true: Camera, names: tuple[str, ...]) -> Tensor:
    """Return the small changes (P,) from one camera to the other, as for `with_parameters`."""
    inner_found, inner_true = (getattr(camera, "camera", camera) for camera in (found, true))
    turn = so3.log(true.R_cam_lab @ found.R_cam_lab.mT)
    values = {f"rotation_{axis}": turn[k] for k, axis in enumerate("xyz")}
    values |= {f"T_{axis}": (true.T_cam_lab_mm - found.T_cam_lab_mm)[k] for k, axis in enumerate("xyz")}
    for name, (field, place) in inner_true.parameter_fields().items():
        away = getattr(inner_true, field) - getattr(inner_found, field)
        values[name] = away if place is None else away[place]
    return torch.stack([values[name] for name in names])
