"""The result of a calibration, also as lines and tables, and signs that it is wrong."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from rich.table import Column, Table
from scipy.spatial import cKDTree
from torch import Tensor

from sphereorient.calibration.document import Photo
from sphereorient.calibration.targets import PlateView
from sphereorient.cameras import Camera, ParameterCovariance, PortCamera, in_air
from sphereorient.cameras.parameters import PORT_NUMBERS, TRANSLATION

NEIGHBOURS = 4  # of a point on the plate
SHARED = 0.1  # share of the residuals' variance common to neighbours that counts as structure, above 4 sigma
FINE_PX = 0.01  # smaller structure is harmless
DROPPED, DROPPED_HERE = 0.05, 0.2  # least share of dropped points, of a camera or of one picture, that is reported
OFF_CENTRE = 0.1  # of the picture's longer side
FIELD_DEG = (1.0, 150.0)  # of view, along the longer side


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureReport:
    """The result of one picture."""

    picture: Photo
    pose: int
    view: PlateView
    residual_px: NDArray[np.float64]  # (n, 2), measured minus expected
    used: NDArray[np.bool_]  # (n,), False for outliers
    reason: str  # why it was not used; empty if used

    @property
    def lost(self) -> int:
        """Number of outliers."""
        return int((~self.used).sum())

    @property
    def rms_px(self) -> float:
        """Rms distance between measured and expected points without outliers; NaN without points."""
        return _rms_px([self])


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibrated:
    """Cameras with covariances."""

    cameras: Mapping[str, Camera]  # each with its own covariance
    covariance: ParameterCovariance  # of all cameras together, names such as cam1.f
    R_lab_plate: Tensor  # (P, 3, 3)
    T_lab_plate_mm: Tensor  # (P, 3)
    pictures: tuple[PictureReport, ...]
    scale: float  # residuals over their expected standard deviations
    verdict: tuple[str, ...] = ()  # signs of a wrong calibration, one line each

    def rms_px(self, camera: str) -> float:
        """Rms distance between one camera's measured and expected points."""
        return _rms_px([one for one in self.pictures if one.picture.camera == camera])


def _rms_px(pictures: Sequence[PictureReport]) -> float:
    missed = np.concatenate([one.residual_px[one.used] for one in pictures])
    return float(np.sqrt((missed**2).sum(1).mean())) if len(missed) else float("nan")


@dataclass(frozen=True, kw_only=True)
class Doubt:
    """Signs of a wrong calibration of one camera."""

    words: tuple[str, ...]
    structured: bool  # residuals of neighbouring points are correlated: the model is incomplete
    hopeless: bool  # structure exceeds the noise, and many points were dropped


def doubts(result: Calibrated) -> dict[str, Doubt]:
    """Return the doubtful cameras."""
    found = {name: _doubt(result, name) for name in result.cameras}
    return {name: doubt for name, doubt in found.items() if doubt.words}


def _doubt(result: Calibrated, name: str) -> Doubt:
    pictures = [one for one in result.pictures if one.picture.camera == name and not one.reason]
    rms, share = result.rms_px(name), _shared(pictures)
    structure, noise = rms * math.sqrt(share), rms * math.sqrt(1 - share)
    points, lost = sum(len(one.used) for one in pictures), sum(one.lost for one in pictures)
    worst = max(pictures, key=lambda one: one.lost / len(one.used))
    dropped = lost > DROPPED * points or worst.lost > DROPPED_HERE * len(worst.used)
    structured = structure > FINE_PX and share > SHARED + 2 / math.sqrt(points)  # of noise, sigma is 0.5 / sqrt(points)
    words = []
    if structured:
        words.append(f"residuals of neighbouring points agree, {structure:.3f} px rms beside {noise:.3f} px of noise")
    if dropped:
        most = f"{worst.lost} of {len(worst.used)} in {worst.picture.path.name}"
        words.append(f"{lost} of {points} points were dropped, {most}")
    words += _lens_words(result.cameras[name])
    return Doubt(words=tuple(words), structured=structured, hopeless=structured and structure > noise and dropped)


def _shared(pictures: Sequence[PictureReport]) -> float:
    """Return the share of the residuals' variance that is common to neighbouring points, 0 to 1."""
    common = total = 0.0
    for one in pictures:
        missed, points = one.residual_px[one.used], one.view.points_plate_mm[one.used]
        if len(missed) > NEIGHBOURS:
            near = np.asarray(cKDTree(points).query(points, k=NEIGHBOURS + 1)[1])[:, 1:]
            common += float((missed[:, None] * missed[near]).sum()) / NEIGHBOURS
            total += float((missed**2).sum())
    return min(max(common / max(total, 1e-300), 0.0), 1.0)


def _lens_words(camera: Camera) -> list[str]:
    lens = in_air(camera)
    longer, sigmas = max(camera.image_size), camera.covariance.sigmas if camera.covariance else {}
    unsure = max((sigma for name, sigma in sigmas.items() if name.startswith("c")), default=0.0)
    off = math.dist(lens.centre_px.tolist(), [(size - 1) / 2 for size in camera.image_size])
    field = math.degrees(2 * math.atan(longer / 2 / float(lens.focal_px[1])))
    words = [f"the principal point is {off:.0f} px off the middle"] if off - 3 * unsure > OFF_CENTRE * longer else []
    return words if FIELD_DEG[0] < field < FIELD_DEG[1] else [*words, f"its field of view is {field:.3g} degrees"]


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


def _values(camera: Camera) -> dict[str, float]:
    """Return the fitted numbers of lens, wall and T; for the rotation, only sigmas are meaningful."""
    known = () if camera.covariance is None else camera.covariance.names
    lens = in_air(camera)
    fields = lens.parameter_fields().items()
    found: dict[str, Tensor] = {name: getattr(lens, field)[... if k is None else k] for name, (field, k) in fields}
    found |= dict(zip(TRANSLATION, camera.T_cam_lab_mm, strict=True))
    if isinstance(camera, PortCamera):
        found |= {name: getattr(camera.port, field) for name, field in PORT_NUMBERS.items()}
    return {name: float(value) for name, value in found.items() if name in known or name in TRANSLATION}


def pictures_table(result: Calibrated) -> Table:
    """Return a row for each picture: points, outliers and rms, or why it was not used."""
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
