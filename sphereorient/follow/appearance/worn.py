"""Worn paint: found if both halves of the movie show it, and not used."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.follow.appearance.light import light_and_blur
from sphereorient.follow.appearance.record import Studied
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lights.kinds import some_of
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.pose.worn import CHANGED, without, worn_cells, worn_share

FEWEST_VIEWS = 8  # rows of poses needed to find worn paint
# Least difference of worn paint, by round: with wrong poses, the borders of right paint differ too.
WORN_ROUNDS = (0.5, 0.5, 0.35, 0.35, 0.25, 0.25, 0.2, 0.2, CHANGED, CHANGED)
FITS = 3.0  # excess of a fit without worn paint: 1.1 to 2.7 with a right map; 4.2 with a warped one
# Least fall of the log of the unexplained variance without worn paint: 1.3 to 2.8 for balls that have lost 2 to 45 %
# of their paint; up to 1.1 with a warped map, highlights or a rod.
WORN_GAIN = 1.2
FIRST_ROUNDS, FIRST_GAIN = 5, 0.15  # after these rounds: 0.5 to 2.2 for worn balls, below 0.05 for others
WORN_SEEN = 0.005  # least share of the ball that differs at first; below it there is no search
WORN_LEAST = 0.01  # share of the ball; less worn paint changes poses by less than their noise


def without_worn(studied: Studied, *, given: bool) -> tuple[Studied, Tensor | None]:
    """Do not use paint that differs from the map; return also where that is, None: nowhere.
    Worn paint found in one half of the movie must reduce the residuals of the other half: it rotates with the ball.
    `given`: as in `light_and_blur`.
    """
    fitter, pixels, fit, use = studied.fitter, studied.pixels, studied.fit, studied.use
    if len(use) < FEWEST_VIEWS:  # of each patch, to distinguish paint from light
        return studied, None
    # If the ball rotates little, glints absorb worn paint.
    bare = fitter.with_light_of(pixels, fit, use, glints=False)
    if worn_share(worn_cells(pixels, fit, use, bare.model())) < WORN_SEEN:
        return studied, None

    def found(
        now: Fitter, rounds: Sequence[float], pixels: Pixels, fit: FittedPoses, use: Tensor
    ) -> tuple[Fitter, FittedPoses, Tensor | None]:
        worn = None
        for changed in rounds:  # worn paint biases the light and poses used to find it
            worn = worn_cells(pixels, fit, use, now.model(), changed)
            paint = without(fitter.optics.fine.paint, worn)  # blurred already
            now = now.with_blur(paint, fitter.optics.blur_px, fitter.optics.limb_blur_px)
            now = now.with_light_of(pixels, fit, use, glints=False)
            fit = now.again(pixels, fit, use)
        return now, fit, worn

    every, middle = torch.arange(len(use)), len(use) // 2
    one, other = (some_of(rows, pixels, fit, use) for rows in (every[:middle], every[middle:]))
    before = bare.with_light_of(*one, glints=False).left(*other)
    begun, begun_fit, _ = found(bare, WORN_ROUNDS[:FIRST_ROUNDS], *one)
    if before - begun.left(*other) < FIRST_GAIN:
        return studied, None
    of_one, *_ = found(begun, WORN_ROUNDS[FIRST_ROUNDS:], one[0], begun_fit, one[2])
    of_other, *_ = found(bare, WORN_ROUNDS, *other)
    gain = before - of_one.left(*other) + bare.with_light_of(*other, glints=False).left(*one) - of_other.left(*one)
    if gain / 2 < WORN_GAIN:
        return studied, None
    lit, fitted, worn = found(bare, WORN_ROUNDS, pixels, fit, use)
    wrong = float(fitted.excess[use].median()) > FITS  # the rest of the paint differs from the map too
    if wrong or worn is None or worn_share(worn) < WORN_LEAST:
        return studied, None
    studied = replace(studied, fitter=lit, fit=fitted, paint=without(studied.paint, worn))
    return light_and_blur(studied, given=given), worn  # the blur was estimated with worn paint
