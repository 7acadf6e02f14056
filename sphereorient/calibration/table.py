import math
from collections.abc import Sequence
from itertools import combinations

import torch
from rich.table import Column, Table
from torch import Tensor

from sphereorient.calibration.calibrated import Calibrated
from sphereorient.calibration.self_calibration import MOVED, OBSERVED, CameraCheck, Repaired
from sphereorient.cameras import Camera, PortCamera, in_air
from sphereorient.cameras.parameters import PORT_NUMBERS, TRANSLATION
from sphereorient.errors import Reason
from sphereorient.trajectory import Trajectory

CONTRARY_SHARE = 0.5  # of the frames of both cameras; a passing reflection spoils a few, a moved camera nearly all


def parameters_table(result: Calibrated) -> Table:
    """Return the parameters of all cameras with their standard deviations."""
    numbers = (Column(name, justify="right") for name in result.cameras)
    table = Table("parameter", *numbers, title="parameters (sigma)")
    values = [_values(camera) for camera in result.cameras.values()]
    sigmas = [camera.covariance.sigmas if camera.covariance else {} for camera in result.cameras.values()]
    for name in dict.fromkeys(name for known in values for name in known):
        of_name = [(known.get(name), sigma.get(name, math.nan)) for known, sigma in zip(values, sigmas, strict=True)]
        table.add_row(name, *("" if value is None else f"{value:.7g} ({sigma:.2g})" for value, sigma in of_name))
    return table


def pictures_table(result: Calibrated) -> Table:
    """Return one row for each picture: points, outliers and rms, or why it was not used."""
    numbers = (Column(name, justify="right") for name in ("points", "outliers", "rms px"))
    table = Table("pose", "camera", "picture", *numbers, "not used because", title="pictures")
    for one in sorted(result.pictures, key=lambda one: (one.pose, one.picture.camera)):
        found = ("", "") if one.reason else (f"{one.lost}", f"{one.rms_px:.3f}")
        where = str(one.pose), one.picture.camera, one.picture.path.name
        table.add_row(*where, str(len(one.view)), *found, one.reason)
    return table


def summary(result: Calibrated) -> list[str]:
    """Return the rms of each camera, the angles between the cameras' axes, and the verdict, one line each."""
    lines = [f"{name}: rms {result.rms_px(name):.3f} px" for name in result.cameras]
    for (one, a), (other, b) in combinations(result.cameras.items(), 2):
        cosine = float(torch.dot(a.R_cam_lab[2], b.R_cam_lab[2]).clamp(-1, 1))
        lines.append(f"{one} and {other}: axes at {math.degrees(math.acos(cosine)):.2f} degrees")
    return [*lines, *(f"doubtful: {line}" for line in result.verdict)]


def repair_lines(result: Repaired) -> list[str]:
    """Return the changes of a self-calibration."""
    gaps = f"{result.gap_before_mm:.4f} mm rms, now {result.gap_after_mm:.4f} mm ({result.frames} frames)"
    lines = [f"distance between the lines of sight to the sphere: {gaps}"]
    for name, change in result.moved.items():
        turn, move = math.degrees(float(change[:3].norm())), float(change[3:].norm())
        lines.append(f"{name}: rotated by {turn:.3f} degrees, T changed by {move:.2f} mm")
        for part, value, sigma in zip(MOVED, change.tolist(), result.sigma[name].tolist(), strict=True):
            lines.append(f"  {part}: {value:+.3g} (sigma {sigma:.2g})")
    return [*lines, f"not determined by the sphere, kept: {', '.join(result.held)}"]


def check_lines(checks: Sequence[CameraCheck]) -> list[str]:
    """Return how well each pair of cameras fits together."""
    each = ((check, *check.percentile(50), *check.percentile(95)) for check in checks)
    return [
        f"{' and '.join(check.names)}: lines of sight miss each other by {gap:.4f} mm (median), {gap95:.4f} mm (95 %); "
        f"pictures by {miss:.3f} px, {miss95:.3f} px; {len(check.gap_mm)} frames"
        for check, gap, miss, gap95, miss95 in each
    ]


def contradiction_lines(track: Trajectory) -> list[str]:
    """Return advice where the cameras disagree on the sphere's position for most of a movie; else an empty list."""
    reasons = [camera.reason for camera in track.cameras.values()]
    seen = sum(all(why in OBSERVED for why in frame) for frame in zip(*reasons, strict=True))
    contrary = sum(Reason.CONTRADICTS in frame for frame in zip(*reasons, strict=True))
    if len(reasons) < 2 or contrary <= CONTRARY_SHARE * seen:
        return []
    return [
        f"The cameras contradict each other in {contrary} of the {seen} frames in which both see the sphere: one has "
        "moved since its calibration, cameras.yaml is of another set-up, or a movie has lost or doubled frames.",
        "Find out: sphereorient check EXPERIMENT reports movies that are out of step. If they are not, repair the "
        "cameras: sphereorient calibrate CAMERAS.yaml --refine-with TRACK.h5 --out REPAIRED.yaml, name REPAIRED.yaml "
        "in experiment.yaml, and track again. If that does not help, take new pictures of the plate.",
    ]


def _values(camera: Camera) -> dict[str, float]:
    """Return the fitted numbers of lens and wall, and T; of the rotation only sigmas are meaningful."""
    known = () if camera.covariance is None else camera.covariance.names
    lens = in_air(camera)
    fields = lens.parameter_fields().items()
    found: dict[str, Tensor] = {name: getattr(lens, field)[... if k is None else k] for name, (field, k) in fields}
    found |= dict(zip(TRANSLATION, camera.T_cam_lab_mm, strict=True))
    if isinstance(camera, PortCamera):
        found |= {name: getattr(camera.port, field) for name, field in PORT_NUMBERS.items()}
    return {name: float(value) for name, value in found.items() if name in known or name in TRANSLATION}
