from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from sphereorient.calibration.ellipse import Dots, fit_ellipses, half_box
from sphereorient.calibration.targets import Floats
from sphereorient.cameras.checks import camera_error

_Chain = list[tuple[Floats, Floats, float]]  # centre, shape and area of a blob, one for each grey level


class DotSettings(BaseModel):
    """Settings of the dot detection."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    levels: int = Field(
        32, ge=8, le=255, description="thresholds at which blobs are searched; a dot must be seen at three or more"
    )
    smooth_px: float = Field(0.8, ge=0, description="sigma, px, of the smoothing before the search (noise)")
    smallest_area_px: float = Field(8.0, gt=0, description="px^2; below it a dot has too few pixels for its ellipse")
    largest_part: float = Field(
        0.2, gt=0, le=1, description="longest side of a dot, as part of the picture's shorter side"
    )
    faintest: float = Field(
        0.4, ge=0, lt=1, description="least contrast of a dot, as part of that of the strongest ones in the picture"
    )
    worst_misfit: float = Field(
        0.12, gt=0, description="rms of the picture around the fitted dot, noise included, as part of its contrast"
    )


def find_dots(picture: NDArray[np.generic], *, dark: bool = True, settings: DotSettings | None = None) -> Dots:
    """Find dots wholly inside a grey picture (H, W) of any number type and measure their centres, from top to bottom.
    `dark` dots lie on a bright background; uneven light needs no setting. CameraError for other pictures or NaN.
    """
    settings = settings or DotSettings()
    grey = as_grey(picture)
    centre, shape = _blobs(grey if dark else -grey, settings)
    fit = fit_ellipses(grey, centre, shape, dark=dark)
    height, width = grey.shape
    moved = np.einsum("na,nab,nb->n", fit.uv_px - centre, shape, fit.uv_px - centre)
    reach = half_box(fit.shape)
    with np.errstate(invalid="ignore"):
        inside = ((fit.uv_px - reach >= -0.5) & (fit.uv_px + reach <= [width - 0.5, height - 0.5])).all(axis=1)
        good = inside & (fit.misfit < settings.worst_misfit) & (fit.contrast > 0.1) & (moved < 0.5)
        good &= np.isfinite(fit.sigma_px) & (fit.area_px >= settings.smallest_area_px)
    if good.any():
        # Noise can look like faint dots; dots of one plate have the same contrast in any light.
        good &= fit.contrast > settings.faintest * np.percentile(fit.contrast[good], 95)
    good &= _first_of_equals(fit.uv_px, fit.shape, good)
    kept = np.flatnonzero(good)
    return fit[kept[np.lexsort((fit.uv_px[kept, 0], fit.uv_px[kept, 1]))]]


def as_grey(picture: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return a grey picture (H, W), 16 x 16 px or more, as float32; CameraError for anything else or NaN."""
    if picture.ndim != 2 or min(picture.shape) < 16:
        do = "convert it to one grey picture"
        raise camera_error("plate picture", "(H, W) of 16 px or more", f"{picture.shape}", do)
    grey = picture.astype(np.float32)
    if not np.isfinite(grey).all():
        raise camera_error("plate picture", "grey values", "NaN", "export it again")
    return grey


def _first_of_equals(uv_px: Floats, shape: Floats, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    # Two blobs can converge to the same dot; candidates are sorted by confidence.
    kept = np.zeros_like(good)
    for k in np.flatnonzero(good):
        away = uv_px[kept] - uv_px[k]
        kept[k] = not (np.einsum("na,nab,nb->n", away, shape[kept], away) < 1).any()
    return kept


def _blobs(grey: NDArray[np.float32], settings: DotSettings) -> tuple[Floats, Floats]:
    """Return centres (n, 2), px, and shapes (n, 2, 2) of dark blobs that are ellipses at three grey levels or more."""
    smooth = cv2.GaussianBlur(grey, (0, 0), settings.smooth_px) if settings.smooth_px > 0 else grey
    low, high = np.percentile(smooth, [0.1, 99.9])
    done: list[_Chain] = []
    going: list[_Chain] = []
    for level in np.linspace(low, high, settings.levels + 2)[1:-1]:
        labels, number, area, centre, shape = _ellipses_at(smooth < level, settings)
        followed: dict[int, _Chain] = {}
        for chain in sorted(going, key=len, reverse=True):  # a blob continues the longest chain that leads to it
            u, v = np.rint(chain[-1][0]).astype(int)
            k = number.get(int(labels[v, u]), -1)
            if k < 0 or k in followed or area[k] > 1.6 * chain[-1][2] + 4:
                done.append(chain)
            else:
                followed[k] = chain
        going = [[*followed.get(k, []), (centre[k], shape[k], float(area[k]))] for k in range(len(area))]
    chains = sorted((chain for chain in done + going if len(chain) >= 3), key=len, reverse=True)
    centres = np.array([chain[len(chain) // 2][0] for chain in chains]).reshape(-1, 2)
    shapes = np.array([chain[len(chain) // 2][1] for chain in chains]).reshape(-1, 2, 2)
    kept = _first_of_equals(centres, shapes, np.ones(len(chains), dtype=bool))
    return centres[kept], shapes[kept]


def _ellipses_at(
    mask: NDArray[np.bool_], settings: DotSettings
) -> tuple[NDArray[np.int32], dict[int, int], Floats, Floats, Floats]:
    """Return labels of the mask's components; number, area, centre and shape of the ellipses among them."""
    height, width = mask.shape
    pieces: Any = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    labels, stats = pieces[1], pieces[2]
    longest = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    wanted = (longest <= settings.largest_part * min(height, width)) & (stats[:, cv2.CC_STAT_AREA] >= 4)
    wanted[0] = False
    place = np.cumsum(wanted) - 1
    n = int(wanted.sum())
    v, u = np.nonzero(wanted[labels])
    of = place[labels[v, u]]
    area = np.bincount(of, minlength=n).astype(np.float64)
    centre = np.stack([np.bincount(of, w, minlength=n) for w in (u, v)], axis=1) / area[:, None]
    x, y = u - centre[of, 0], v - centre[of, 1]
    xx, xy, yy = (np.bincount(of, w, minlength=n) / area for w in (x * x, x * y, y * y))
    xx, yy = xx + 1 / 12, yy + 1 / 12  # a pixel has a width
    det = xx * yy - xy * xy
    full = area / (4 * np.pi * np.sqrt(det))  # 1 for an ellipse, 0.955 for a rectangle
    good = np.flatnonzero((full > 0.88) & (area >= 0.5 * settings.smallest_area_px))
    inverse = np.stack([np.stack([yy, -xy], -1), np.stack([-xy, xx], -1)], -2) / (4 * det)[:, None, None]
    number = {int(label): k for k, label in enumerate(np.flatnonzero(wanted)[good])}
    return labels, number, area[good], centre[good], inverse[good]
