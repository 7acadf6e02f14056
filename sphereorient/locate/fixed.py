"""A ball that turns in its place: what changes from frame to frame is the ball, what does not is the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import ExperimentError, refusal
from sphereorient.locate.background import Background
from sphereorient.locate.blob import Blob
from sphereorient.locate.outline import Outline, fit_outline
from sphereorient.locate.settings import LocateSettings

CHANGES = 2.5  # times the usual scatter of a pixel: there the paint passes
RIM = 1.06  # of the radius: blur and halo of the rim
RING = 1.5  # of the radius: scene about the ball, of whose typical grey the place behind it is taken to be
WINDOW = 5  # px of the median that takes single pixels off


@dataclass(frozen=True, kw_only=True, eq=False)
class FixedBall:
    """Where the ball is in all frames, and the scene, a guess behind it; made by `fixed_ball`."""

    outline: Outline
    scene: Background


def fixed_ball(
    pictures: NDArray[Any],
    locating: LocateSettings,
    empty: NDArray[np.float32] | None = None,
    shown: NDArray[np.bool_] | None = None,
) -> FixedBall:
    """Find a ball that turns in its place.

    Args:
        pictures: (n, H, W), evenly spread frames of one movie.
        locating: how outlines are found; `diameter_px` where it is known.
        empty: (H, W), the scene without the ball, where there is such a picture.
        shown: (H, W), False where something hides the ball; None: nowhere.

    Raises:
        ExperimentError: nothing round changes.
    """
    grey = pictures.astype(np.float32)
    middle = np.median(grey, axis=0)
    scatter = np.asarray(grey.std(axis=0), np.float32)
    if shown is not None:
        scatter = np.where(shown, scatter, np.float32(0))
    usual = float(np.median(scatter)) + 0.3 * float(np.iinfo(pictures.dtype).max) / 255
    moved = (cv2.medianBlur(scatter, WINDOW) > CHANGES * usual).astype(np.uint8)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(moved, connectivity=8)
    if count < 2:
        raise _nothing("nothing that changes")
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    inside = (labels == largest).astype(np.uint8)
    guess = locating.diameter_px or _diameter(inside, shown is not None)
    change = np.minimum(scatter, np.percentile(scatter[inside > 0], 30))  # the rim's fall, not the paint's wealth
    blob = Blob(u_px=float(centres[largest][0]), v_px=float(centres[largest][1]), merit=1.0)
    outline = fit_outline(change, 0.2 * usual, blob, guess, locating, shown)
    if outline is None or outline.coverage < locating.coverage_min:
        raise _nothing("no circle about what changes")
    scene = replace(_scene(middle, scatter, outline, pictures.dtype, empty), shown=shown)
    return FixedBall(outline=outline, scene=scene)


def _diameter(inside: NDArray[np.uint8], hidden: bool) -> float:
    """Return about how wide a region is: by its area, or, where a part may be hidden, by the circle about it."""
    if hidden:
        return 2 * float(cv2.minEnclosingCircle(np.asarray(cv2.findNonZero(inside)))[1])
    return 2 * float(np.sqrt(inside.sum() / np.pi))


def _scene(
    middle: NDArray[np.float32],
    scatter: NDArray[np.float32],
    outline: Outline,
    dtype: np.dtype[Any],
    empty: NDArray[np.float32] | None,
) -> Background:
    row, column = np.ogrid[: middle.shape[0], : middle.shape[1]]
    away = np.hypot(row - outline.v_px, column - outline.u_px) / outline.radius_px
    ball, ring = away < RIM, (away >= RIM) & (away < RING)
    around = ring if ring.any() else ~ball
    mean, noise = middle.astype(np.float32), np.maximum(scatter, 0.3).astype(np.float32)
    mean[ball], noise[ball] = np.median(middle[around]), np.median(noise[around])
    full = float(np.iinfo(dtype).max)
    return Background(mean=mean if empty is None else empty, noise=noise, full_scale=full)


def _nothing(got: str) -> ExperimentError:
    do = "check sphere.fixed: is the ball in one place, and does it turn? Or set locate.diameter_px"
    return ExperimentError(refusal("movies", expected="a ball that turns in its place", got=got, do=do))
