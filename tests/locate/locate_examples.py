"""Planted disks, shared by the tests of this room: exact to a fraction of a pixel by supersampling."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import PinholeCamera
from sphereorient.locate import Background, LocateSettings, Sightings
from sphereorient.locate.outline import Blob, Outline, fit_outline
from sphereorient.trajectory import Reason

Grey = NDArray[np.float32]
Paint = Callable[[Grey, Grey], Grey]  # (x, y) in radii from the centre, x right, y down -> grey levels

SHAPE = (170, 200)  # H, W
DIAMETER = 78.0  # px, as in the paper
BACK, BLACK, WHITE = 15.0, 20.0, 170.0  # grey levels
NOISE = 1.5
SUPERSAMPLING = 8
PLACES = [(99.37, 84.81), (88.0, 80.5), (104.62, 77.13)]
SETTINGS = LocateSettings()


def white(x: Grey, y: Grey) -> Grey:
    return np.full_like(x, WHITE)


def checker(x: Grey, y: Grey) -> Grey:
    """Fields of a third of a radius, as on paper glued to a ball."""
    return np.where((np.floor(3 * x) + np.floor(3 * y)) % 2 == 0, WHITE, 0.45 * WHITE).astype(np.float32)


def blobs(x: Grey, y: Grey) -> Grey:
    """Waves thresholded to patches of black and white; black is a little brighter than the background."""
    wave = np.sin(4.1 * x + 1.3 * y) + np.sin(3.7 * y - 2.2 * x + 1) + np.sin(5.3 * x + 4.4 * y - 0.7)
    return np.where(wave > -0.3, WHITE, BLACK + 20).astype(np.float32)


def lit_from_the_left(paint: Paint) -> Paint:
    """Uneven light: a third of it on the right."""
    return lambda x, y: (paint(x, y) * (0.65 - 0.32 * x)).astype(np.float32)


def fine_grid(shape: tuple[int, int]) -> tuple[Grey, Grey]:
    """Rows and columns of the samples inside pixels, px; whole numbers are pixel centres."""
    at = (np.arange(SUPERSAMPLING, dtype=np.float32) + 0.5) / SUPERSAMPLING - 0.5
    rows = (np.arange(shape[0], dtype=np.float32)[:, None] + at).reshape(-1, 1)
    columns = (np.arange(shape[1], dtype=np.float32)[:, None] + at).reshape(1, -1)
    return rows, columns


def plant(
    paint: Paint,
    u: float,
    v: float,
    radius: float = DIAMETER / 2,
    shape: tuple[int, int] = SHAPE,
    back: float = BACK,
    also: Callable[[Grey, Grey, Grey], Grey] | None = None,
) -> Grey:
    """Paint a disk before an even background, without noise; `also(grey, rows, columns)` adds to the fine picture."""
    rows, columns = fine_grid(shape)
    x, y = (columns - np.float32(u)) / np.float32(radius), (rows - np.float32(v)) / np.float32(radius)
    grey = np.where(x**2 + y**2 <= 1, paint(*np.broadcast_arrays(x, y)), np.float32(back)).astype(np.float32)
    if also is not None:
        grey = also(grey, rows, columns)
    return cv2.resize(grey, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def filmed(picture: Grey, seed: int = 0, noise: float = NOISE, blur_px: float = 0.55) -> NDArray[np.uint8]:
    """Blur, add noise, round to 8 bits."""
    blurred = cv2.GaussianBlur(picture, (0, 0), blur_px)
    noisy = blurred + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def even_background(shape: tuple[int, int] = SHAPE, back: float = BACK, noise: float = NOISE) -> Background:
    mean, sigma = np.full(shape, back, np.float32), np.full(shape, noise, np.float32)
    return Background(mean=mean, noise=sigma, full_scale=255.0)


def outline_of(frame: NDArray[np.uint8], u: float, v: float, settings: LocateSettings = SETTINGS) -> Outline | None:
    """Fit the outline near a place that is 3 px off, as blobs are."""
    difference = even_background(frame.shape).difference(frame)
    return fit_outline(difference, NOISE, Blob(u_px=u + 2.4, v_px=v - 1.8, merit=1.0), DIAMETER, settings)


def sightings(
    centre_px: torch.Tensor,
    radius_px: torch.Tensor | float = 39.0,
    rms_px: torch.Tensor | float = 0.2,
    flags: torch.Tensor | int = 0,
) -> Sightings:
    """Make sightings from (N, 2) centres; NaN centres were not found."""
    lost = torch.isnan(centre_px[:, 0])

    def column(value: torch.Tensor | float) -> torch.Tensor:
        whole = torch.as_tensor(value, dtype=torch.float64).expand(len(lost))
        return torch.where(lost, torch.nan, whole)

    return Sightings(
        centre_px=centre_px.double(),
        radius_px=column(radius_px),
        outline_rms_px=column(rms_px),
        coverage=column(0.9),
        covariance_px2=column(rms_px)[:, None, None].square() * torch.eye(3).double(),
        flags=torch.as_tensor(flags, dtype=torch.int64).expand(len(lost)).clone(),
        reason=tuple(Reason.NOT_FOUND if gone else Reason.OK for gone in lost.tolist()),
    )


def looking_along_y(**changes: object) -> PinholeCamera:
    """A camera 520 mm before the origin that looks along lab +y, lab z up; 78 px for 18 mm."""
    R_cam_lab = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    return _camera({"R_cam_lab": R_cam_lab} | changes)


def looking_down(**changes: object) -> PinholeCamera:
    """A camera 520 mm above the origin that looks along lab -z, lab x to the right."""
    R_cam_lab = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=torch.float64)
    return _camera({"R_cam_lab": R_cam_lab} | changes)


def _camera(changes: dict[str, object]) -> PinholeCamera:
    parameters: dict[str, object] = {
        "image_size": (650, 650),
        "T_cam_lab_mm": torch.tensor([0.0, 0.0, 520.0], dtype=torch.float64),
        "centre_px": torch.tensor([324.5, 324.5], dtype=torch.float64),
        "f_px": torch.tensor(78.0 * 520 / 18, dtype=torch.float64),
    }
    return PinholeCamera(**(parameters | changes))


def distance_px(outline: Outline, place: Sequence[float]) -> float:
    return float(np.hypot(outline.u_px - place[0], outline.v_px - place[1]))
