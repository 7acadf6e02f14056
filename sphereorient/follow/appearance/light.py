"""Blur and light of the pictures: a first guess of the blur from edges, then both together, because light estimated
with a wrong blur favours that blur.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import ExperimentError, refusal
from sphereorient.follow.appearance.record import Studied, enough_of, soft
from sphereorient.locate.outline import Outline, window_about
from sphereorient.pose.camera_view import FINEST_PX, level_of, widest_px
from sphereorient.pose.fit import USUALLY_HIDDEN
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lasting import limb_wider_px
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.sphere.texture_table import TextureTable

CALM_PX = 1.0  # blur added to pictures first, against noise
AROUND = 1.2  # of the radius: the sphere and its rim
CONTRAST = (2.5, 97.5)  # percentiles between which the grey levels of paint and scene lie
STEEPEST = 99.5  # percentile of the slopes, as few pixels lie on an edge
FINER, FINEST = 1.25, 1.07  # ratio of the tried blurs, at first and when it is nearly known
WIDEST = 0.3  # of the radius: a wider blur removes all paint
BLUR_ROUNDS = 4  # most rounds of blur and light by turns
BLUR_STAYS = 0.03  # relative change of the blur at convergence
LIMB_ROUNDS, LIMB_STAYS = 4, 0.005  # the same for the limb's blur
MOST_WIDER = 1.25  # greatest ratio of the limb's blurs of two rounds, as the step is linear


def estimate_blur_px(disks: Iterable[tuple[NDArray[np.generic], Outline]]) -> float:
    """Return the standard deviation of the blur, px, from the steepest edges of disks in pictures: the median.
    A first guess, biased by noise and by paint without edges. 0 without disks.
    Source: the slope of a step of height h under a Gaussian blur sigma is at most h / (sigma sqrt(2 pi)).
    """
    found = []
    for picture, disk in disks:
        about = window_about(round(disk.u_px), round(disk.v_px), round(AROUND * disk.radius_px))
        found.append(steepest_blur_px(picture[about].astype(np.float32)))
    return float(np.median(found)) if found else 0.0


def steepest_blur_px(picture: NDArray[np.float32]) -> float:
    """Return the standard deviation of the blur, px, at the steepest edge between darkest and brightest level."""
    calm = cv2.GaussianBlur(picture, (0, 0), CALM_PX)
    slope = np.hypot(cv2.Scharr(calm, cv2.CV_32F, 1, 0), cv2.Scharr(calm, cv2.CV_32F, 0, 1)) / 32
    low, high = np.percentile(calm, CONTRAST)
    steepest = float(np.percentile(slope, STEEPEST))
    blur = float(high - low) / max(steepest * np.sqrt(2 * np.pi), 1e-9)
    return float(np.sqrt(max(blur**2 - CALM_PX**2, 0.0)))


def best_blur_px(
    fitter: Fitter, base: TextureTable, pixels: Pixels, fit: FittedPoses, use: Tensor, ratio: float
) -> float:
    """Return the blur with the least unexplained variance, interpolated between tried ones, `ratio` apart."""
    radius_px, now_px = widest_px(fitter.views) / 2, fitter.optics.blur_px
    most_px = max(WIDEST * radius_px, FINEST_PX * FINER**7)
    fewest, most = (math.log(end / now_px) / math.log(ratio) for end in (FINEST_PX, most_px))
    fewest, most = math.ceil(fewest), math.floor(most)

    @cache
    def unexplained(k: int) -> float:
        return fitter.left(pixels, fit, use, level_of(base, now_px * ratio**k, 0.0, radius_px), 2)

    # Downhill from the known blur: each table of the paint takes a tenth of a second.
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


def light_and_blur(studied: Studied, *, given: bool) -> Studied:
    """Estimate light, then blur unless it is `given`, then light again, until the blur converges.
    One round does not suffice if the first blur is far off.
    """
    studied = studied.lit()
    slow = soft(studied.fitter)  # each round changes such a blur by little
    for done in range(1 if given else BLUR_ROUNDS):
        before_px = studied.fitter.optics.blur_px
        if not given:
            fitter, fits = studied.fitter, (studied.pixels, studied.fit, studied.use)
            blur_px = best_blur_px(fitter, studied.paint, *fits, FINEST if done else FINER)
            studied = replace(studied, fitter=fitter.with_blur(studied.paint, blur_px))
        studied = studied.lit()
        if not slow and abs(studied.fitter.optics.blur_px / before_px - 1) < BLUR_STAYS:
            break
    return _limb_blurred(studied)


def _limb_blurred(studied: Studied) -> Studied:
    """Estimate the blur of the limb: too narrow a limb shifts the ball to its bright side."""
    for _ in range(LIMB_ROUNDS):
        fitter = studied.fitter
        before_px = fitter.optics.limb_blur_px
        wider_px = limb_wider_px(studied.pixels, studied.fit, studied.use, fitter.model())
        blur_px = min(max(before_px + wider_px, before_px / MOST_WIDER, FINEST_PX), before_px * MOST_WIDER)
        optics = fitter.optics.with_limb_blur(blur_px)
        studied = replace(studied, fitter=replace(fitter, optics=optics)).lit()
        if abs(blur_px / before_px - 1) < LIMB_STAYS:
            break
    return studied


def darkest_white(fitter: Fitter) -> str | None:
    """Return the camera in which white paint of the map is darkest, if it is darker than black paint."""
    contrast = fitter.light.tables.cells[:, 0].reshape(len(fitter.views), -1).mean(1)
    return fitter.views[int(contrast.argmin())].name if bool((contrast < 0).any()) else None


def check_white(fitter: Fitter) -> None:
    """Raise ExperimentError if a camera shows white paint of the map darker than black."""
    if (inverted := darkest_white(fitter)) is not None:
        got, do = f"white paint darker than black in {inverted}", "exchange black and white of the map"
        raise ExperimentError(refusal("sphere.texture", expected="a map whose white is bright", got=got, do=do))


def without_occluders(studied: Studied) -> Studied:
    """Estimate light and poses without occluders; if most of the ball is usually hidden, seek no occluders."""
    fitter, fit, use = studied.fitter, studied.fit, studied.use
    free = enough_of(fitter.unoccluded(studied.whole, fit.position_lab_mm, fit.R_lab_body))
    hidden = 1.0 - free.inside.sum(-1) / studied.pixels.inside.sum(-1).clamp_min(1)
    if float(hidden[use.flatten()].median()) > USUALLY_HIDDEN:
        return replace(studied, fitter=replace(fitter, most_hidden=0.0))
    if not bool(hidden.any()):
        return studied
    fitter = fitter.with_light_of(free, fit, use)
    return replace(studied, fitter=fitter, fit=fitter.again(free, fit, use))
