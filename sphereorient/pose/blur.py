"""How much pictures are blurred: a first guess from their edges, and the blur that explains them best."""

import math
from collections.abc import Iterable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.locate.outline import Outline
from sphereorient.pose.camera_view import FINEST_PX, level_of, widest_px
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.sphere.texture_table import TextureTable

CALM_PX = 1.0  # blur that is laid over pictures first, against noise
AROUND = 1.2  # of the radius: the sphere and its rim
CONTRAST = (2.5, 97.5)  # percentiles between which the grey levels of paint and scene lie
STEEPEST = 99.5  # percentile of the slopes: few pixels lie on an edge
FINER, FINEST = 1.25, 1.07  # ratio of the blurs that are tried, at first and once it is nearly known
WIDEST = 0.3  # of the radius: wider ones remove all paint


def estimate_blur_px(disks: Iterable[tuple[NDArray[np.generic], Outline]]) -> float:
    """Return the standard deviation of the blur, px, of the steepest edges of disks in pictures: the median.
    A first guess, biased by noise and paint without edges. 0 without disks.
    Source: a step of height h under a Gaussian blur sigma is h / (sigma sqrt(2 pi)) steep at most.
    """
    found = [steepest_blur_px(_about(*disk)) for disk in disks]
    return float(np.median(found)) if found else 0.0


def _about(picture: NDArray[np.generic], disk: Outline) -> NDArray[np.float32]:
    reach = round(AROUND * disk.radius_px)
    u, v = round(disk.u_px), round(disk.v_px)
    return picture[max(0, v - reach) : v + reach + 1, max(0, u - reach) : u + reach + 1].astype(np.float32)


def steepest_blur_px(picture: NDArray[np.float32]) -> float:
    """Return the standard deviation of the blur, px, of the steepest edge between the darkest and the brightest."""
    calm = cv2.GaussianBlur(picture, (0, 0), CALM_PX)
    slope = np.hypot(cv2.Scharr(calm, cv2.CV_32F, 1, 0), cv2.Scharr(calm, cv2.CV_32F, 0, 1)) / 32
    low, high = np.percentile(calm, CONTRAST)
    steepest = float(np.percentile(slope, STEEPEST))
    blur = float(high - low) / max(steepest * np.sqrt(2 * np.pi), 1e-9)
    return float(np.sqrt(max(blur**2 - CALM_PX**2, 0.0)))


def best_blur_px(
    fitter: Fitter, base: TextureTable, pixels: Pixels, fit: FittedPoses, use: Tensor, ratio: float
) -> float:
    """Return the blur that leaves the least variance unexplained, interpolated between tried ones, `ratio` apart."""
    radius_px, now_px = widest_px(fitter.views) / 2, fitter.optics.blur_px
    most_px = max(WIDEST * radius_px, FINEST_PX * FINER**7)
    fewest, most = (math.log(end / now_px) / math.log(ratio) for end in (FINEST_PX, most_px))
    fewest, most = math.ceil(fewest), math.floor(most)

    @cache
    def unexplained(k: int) -> float:
        return fitter.left(pixels, fit, use, level_of(base, now_px * ratio**k, 0.0, radius_px), 2)

    # Downhill from the blur that is known: each table of the paint costs a tenth of a second.
    best, k = min(max(0, fewest), most), None
    while best != k:
        k = best
        best = min((n for n in (k - 1, k, k + 1) if fewest <= n <= most), key=unexplained)
    if k in (fewest, most):
        return now_px * ratio**k
    below, here, above = (unexplained(n) for n in (k - 1, k, k + 1))
    bend = below - 2 * here + above
    shift = 0.5 * (below - above) / bend if bend > 0 else 0.0
    return float(now_px * ratio ** (k + shift))
