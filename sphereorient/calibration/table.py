"""What a calibration found, as a short table on the screen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import torch
from rich.table import Table

from sphereorient.calibration.plates import Calibrated
from sphereorient.calibration.self_calibration import MOVED, Repaired
from sphereorient.calibration.sphere import TELLING, CameraCheck
from sphereorient.cameras import Camera
from sphereorient.trajectory import Reason, Trajectory

CONTRARY_SHARE = 0.5  # of the frames of both cameras; a passing reflection spoils a few, a bumped camera nearly all


def parameters_table(result: Calibrated) -> Table:
    """Return the parameters of all cameras with their standard deviations."""
    table = Table(title="parameters (sigma)")
    table.add_column("parameter")
    names: list[str] = []
    for camera in result.cameras.values():
        names += [name for name in _values(camera) if name not in names]
    for camera_name in result.cameras:
        table.add_column(camera_name, justify="right")
    for name in names:
        cells = []
        for camera in result.cameras.values():
            value, sigma = _values(camera).get(name), _sigma(camera, name)
            cells.append("" if value is None else f"{value:.7g} ({sigma:.2g})")
        table.add_row(name, *cells)
    return table


def pictures_table(result: Calibrated) -> Table:
    """Return what became of each picture."""
    table = Table(title="pictures")
    for column in ("pose", "camera", "picture"):
        table.add_column(column)
    for column in ("points", "outliers", "rms px"):
        table.add_column(column, justify="right")
    table.add_column("not used because")
    for one in sorted(result.pictures, key=lambda one: (one.pose, one.picture.camera)):
        outliers = "" if one.reason else str(int((~one.used).sum()))
        rms = "" if one.reason else f"{one.rms_px:.3f}"
        row = (str(one.pose), one.picture.camera, one.picture.path.name, str(len(one.view)), outliers, rms, one.reason)
        table.add_row(*row)
    return table


def summary(result: Calibrated) -> list[str]:
    """Return rms of each camera and the angles between the cameras' axes, one line each."""
    lines = [f"{name}: rms {result.rms_px(name):.3f} px" for name in result.cameras]
    for (one, a), (other, b) in combinations(result.cameras.items(), 2):
        lines.append(f"{one} and {other}: axes at {_angle_deg(a, b):.2f} degrees")
    return lines


def repair_lines(result: Repaired) -> list[str]:
    """Return what a self-calibration did."""
    lines = [
        f"lines of sight to the sphere missed each other by {result.gap_before_mm:.4f} mm rms, "
        f"now by {result.gap_after_mm:.4f} mm ({result.frames} frames)"
    ]
    for name, change in result.moved.items():
        turn, move = math.degrees(float(change[:3].norm())), float(change[3:].norm())
        lines.append(f"{name}: turned by {turn:.3f} degrees, T changed by {move:.2f} mm")
        for part, value, sigma in zip(MOVED, change.tolist(), result.sigma[name].tolist(), strict=True):
            lines.append(f"  {part}: {value:+.3g} (sigma {sigma:.2g})")
    return [*lines, f"not determined by the sphere, kept: {', '.join(result.held)}"]


def check_lines(checks: Sequence[CameraCheck]) -> list[str]:
    """Return how well the cameras fit together."""
    lines = []
    for check in checks:
        (gap, miss), (gap95, miss95) = check.percentile(50), check.percentile(95)
        lines.append(
            f"{' and '.join(check.names)}: lines of sight miss each other by {gap:.4f} mm (median), {gap95:.4f} mm "
            f"(95 %); pictures by {miss:.3f} px, {miss95:.3f} px; {len(check.gap_mm)} frames"
        )
    return lines


def contradiction_lines(track: Trajectory) -> list[str]:
    """Return what to do where the cameras see the ball in different places for most of a movie; else nothing."""
    reasons = [camera.reason for camera in track.cameras.values()]
    seen = sum(all(why in TELLING for why in frame) for frame in zip(*reasons, strict=True))
    contrary = sum(Reason.CONTRADICTS in frame for frame in zip(*reasons, strict=True))
    if len(reasons) < 2 or contrary <= CONTRARY_SHARE * seen:
        return []
    return [
        f"The cameras contradict each other in {contrary} of the {seen} frames in which both see the sphere: one has "
        "moved since its calibration, cameras.yaml is of another set-up, or a movie has lost or doubled frames.",
        "Find out: sphereorient check EXPERIMENT tells movies that are out of step. If they are not, repair the "
        "cameras: sphereorient calibrate CAMERAS.yaml --refine-with TRACK.h5 --out REPAIRED.yaml, name REPAIRED.yaml "
        "in experiment.yaml, and track again. If that does not help, take new pictures of the plate.",
    ]


def _values(camera: Camera) -> dict[str, float]:
    """Numbers of the lens and the place; the rotation is told by its sigmas alone."""
    inner = getattr(camera, "camera", camera)
    found: dict[str, float] = {}
    for name, (field, place) in inner.parameter_fields().items():
        value = getattr(inner, field)
        found[name] = float(value if place is None else value[place])
    known = () if camera.covariance is None else camera.covariance.names
    found = {name: value for name, value in found.items() if name in known}
    found |= {f"T_{axis}": float(value) for axis, value in zip("xyz", camera.T_cam_lab_mm, strict=True)}
    port = getattr(camera, "port", None)
    if port is not None:
        numbers = {"port_offset": "offset_mm", "port_thickness": "thickness_mm"}
        numbers |= {"port_n_glass": "n_glass", "port_n_fluid": "n_fluid"}
        found |= {name: float(getattr(port, field)) for name, field in numbers.items() if name in known}
    return found


def _sigma(camera: Camera, name: str) -> float:
    return float("nan") if camera.covariance is None else camera.covariance.sigmas.get(name, float("nan"))


def _angle_deg(one: Camera, other: Camera) -> float:
    cosine = float(torch.dot(one.R_cam_lab[2], other.R_cam_lab[2]).clamp(-1, 1))
    return math.degrees(math.acos(cosine))
