"""Paint that differs from the map: found where the pictures say so in both halves of the movie, and not used."""

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

FEWEST_VIEWS = 8  # rows of poses in which worn paint is looked for
# By how much paint differs that is not used, round by round: while poses are wrong, so do the borders of right paint.
WORN_ROUNDS = (0.5, 0.5, 0.35, 0.35, 0.25, 0.25, 0.2, 0.2, CHANGED, CHANGED)
FITS = 3.0  # excess of a fit whose map is right once worn paint is not used: 1.1 to 2.7; of a warped map 4.2
# By which the logarithm of the variance left must fall where worn paint is not used: 1.3 to 2.8 in balls that have lost
# 2 to 45 % of their paint, up to 1.1 where the map is warped, and with highlights or a rod.
WORN_GAIN = 1.2
FIRST_ROUNDS, FIRST_GAIN = 5, 0.15  # after these rounds it is 0.5 to 2.2 in worn balls, below 0.05 in others
WORN_SEEN = 0.005  # share of the ball that differs at first sight, below which it is not looked for
WORN_LEAST = 0.01  # share of the ball; less paint than this moves no pose by as much as its noise


def without_worn(studied: Studied, *, given: bool) -> tuple[Studied, Tensor | None]:
    """Do not use paint that differs from the map; return also where that is, None: nowhere.
    Found in one half of the movie, it must leave less in the other half: what differs there, too, turns with the ball.
    `given`: as in `light_and_blur`.
    """
    fitter, pixels, fit, use = studied.fitter, studied.pixels, studied.fit, studied.use
    if len(use) < FEWEST_VIEWS:  # of each patch, to tell paint from light
        return studied, None
    # Of a ball that turns little glints take the place of worn paint.
    bare = fitter.with_light_of(pixels, fit, use, glints=False)
    if worn_share(worn_cells(pixels, fit, use, bare.model())) < WORN_SEEN:
        return studied, None

    def found(
        now: Fitter, rounds: Sequence[float], pixels: Pixels, fit: FittedPoses, use: Tensor
    ) -> tuple[Fitter, FittedPoses, Tensor | None]:
        worn = None
        for changed in rounds:  # worn paint bends the light and the poses that it is found with
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
    wrong = float(fitted.excess[use].median()) > FITS  # the paint that is left is not the map's either
    if wrong or worn is None or worn_share(worn) < WORN_LEAST:
        return studied, None
    studied = replace(studied, fitter=lit, fit=fitted, paint=without(studied.paint, worn))
    return light_and_blur(studied, given=given), worn  # the blur, too, was found with worn paint
