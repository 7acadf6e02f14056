"""Light and blur of a movie's pictures, learnt in turns from fitted poses."""

from __future__ import annotations

import math
from dataclasses import replace

from torch import Tensor

from sphereorient.pose.defocus import defocus_radii
from sphereorient.pose.fit import FittedPoses
from sphereorient.pose.fitter import FINEST_PX, Fitter, Optics, level_of, widest_px
from sphereorient.pose.pixels import Pixels
from sphereorient.sphere.texture_table import TextureTable

FINER = 1.25  # ratio of the blurs that are tried, from FINEST_PX on
WIDEST = 0.3  # of the radius: wider ones leave nothing of a paint that a ball can carry
LIGHT_ROUNDS, SOFT_ROUNDS = 2, 4
LEAST_LEFT = 1e-6  # of a picture's variance; rounding leaves more


def learn_light_and_blur(
    fitter: Fitter, base: TextureTable, pixels: Pixels, fit: FittedPoses, use: Tensor, *, given: bool
) -> tuple[Fitter, FittedPoses]:
    """Learn light, then blur, then light again.

    Light that was learnt with a wrong blur speaks for that blur: of soft pictures they take turns, some times.

    Args:
        fitter: with the blur that is begun with.
        base: finest table of the paint.
        pixels: of B * C disks.
        fit: of them.
        use: (B, C) bool, disks to learn from.
        given: whether the blur is known.

    Returns:
        The fitter that knows both, and its fit.
    """
    diameter_px = widest_px(fitter.views)
    fitter, fit = _with_light(fitter, pixels, fit, use, LIGHT_ROUNDS)
    soft = not given and defocus_radii(fitter.optics.blur_px, diameter_px) > 0
    for _ in range(SOFT_ROUNDS if soft else 1):
        if not given:
            blur_px = best_blur_px(fitter, base, pixels, fit, use)
            fitter = replace(fitter, optics=Optics(base, blur_px, diameter_px))
        fitter, fit = _with_light(fitter, pixels, fit, use, LIGHT_ROUNDS)
    return fitter, fit


def _with_light(
    fitter: Fitter, pixels: Pixels, fit: FittedPoses, use: Tensor, rounds: int
) -> tuple[Fitter, FittedPoses]:
    """Learn the light and fit again, some times."""
    for _ in range(rounds):
        fitter = fitter.with_light_of(pixels, fit, use)
        fit = fitter.fit(pixels, fit.position_lab_mm, fit.R_lab_body, use, fitter.optics.fine, 3)
    return fitter, fit


def best_blur_px(fitter: Fitter, base: TextureTable, pixels: Pixels, fit: FittedPoses, use: Tensor) -> float:
    """Return the blur that leaves the least of the pictures unexplained, between the tried ones by a parabola."""
    radius_px = widest_px(fitter.views) / 2
    left: dict[int, float] = {}
    blurs = _blurs_tried(radius_px)

    def unexplained(k: int) -> float:
        if k not in left:
            level = level_of(base, blurs[k], 0.0, radius_px)
            tried = fitter.fit(pixels, fit.position_lab_mm, fit.R_lab_body, use, level, 2)
            # Of all pictures together: their curves differ in height by much and in shape by little.
            left[k] = float((1.0 - tried.score)[use].clamp_min(LEAST_LEFT).log().mean())
        return left[k]

    # Downhill from the first guess: each table of the paint costs a tenth of a second.
    k = min(range(len(blurs)), key=lambda k: abs(blurs[k] - fitter.optics.blur_px))
    while True:
        near = [n for n in (k - 1, k, k + 1) if 0 <= n < len(blurs)]
        best = min(near, key=unexplained)
        if best == k:
            break
        k = best
    if k in (0, len(blurs) - 1):
        return blurs[k]
    bend = left[k - 1] - 2 * left[k] + left[k + 1]
    shift = 0.5 * (left[k - 1] - left[k + 1]) / bend if bend > 0 else 0.0
    return float(blurs[k] * FINER**shift)


def _blurs_tried(radius_px: float) -> tuple[float, ...]:
    """Return the blurs, px, among which that of pictures of a disk is looked for."""
    steps = math.log(max(WIDEST * radius_px / FINEST_PX, FINER**7)) / math.log(FINER)
    return tuple(FINEST_PX * FINER**k for k in range(math.ceil(steps) + 1))
