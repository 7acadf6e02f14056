"""Background and ball depend on each other: a few rounds settle both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.locate.background import Background, measure_background, without_ball
from sphereorient.locate.find import find_ball
from sphereorient.locate.settings import LocateSettings

ROUNDS = 4  # at most; each finds the ball in more frames, most movies need two
RIM = 1.15  # of the radius: the ball's halo and shadow belong to it
LOUD, LOUD_SHARE = 5.0, 0.1  # times the usual noise, and such pixels as a share of the disk, that ask for a second look
CHANGE_SIGMAS = 0.6745 * 2**0.5  # median of the difference of two normal numbers, in their standard deviation


def learn_background(
    pictures: NDArray[Any],
    diameter_px: float,
    settings: LocateSettings,
    empty: NDArray[np.float32] | None = None,
    shown: NDArray[np.bool_] | None = None,
) -> Background:
    """Learn what a movie shows without the ball.

    The mean of evenly spread frames first; then the ball is looked for in them, and the pixels that it covers are
    measured again from the frames in which it is elsewhere. A ball that stays long in one region would otherwise
    become part of the background there.

    Args:
        pictures: (n, H, W), evenly spread frames of one movie.
        diameter_px: expected diameter of the ball.
        settings: of the room.
        empty: (H, W), the scene without the ball, where there is such a picture; nothing then is left to learn.
        shown: (H, W), False where something that does not move hides the ball; None: nowhere.
    """
    background = replace(measure_background(pictures, empty), shown=shown)
    if empty is not None:
        return _quieter(background, pictures, diameter_px, settings)
    first, before = background, 0
    for _ in range(ROUNDS):
        covered = _covered(pictures, background, diameter_px, settings)
        background = without_ball(first, pictures, covered)
        found = int(covered.any(axis=(1, 2)).sum())
        if found <= before or found == len(pictures):  # nothing new to learn
            break
        before = found
    return background


def _quieter(
    background: Background, pictures: NDArray[Any], diameter_px: float, settings: LocateSettings
) -> Background:
    """Take pixels to be no noisier than they change from frame to frame, where the ball is not found otherwise.

    About a given scene a pixel that the ball never leaves scatters by all that the ball differs: nothing sticks out of
    such noise, least a ball that is blurred. What glitters changes from frame to frame and stays hidden.
    """
    loud = background.noise > LOUD * background.typical_noise
    if loud.sum() < LOUD_SHARE * np.pi / 4 * diameter_px**2:
        return background
    found = [find_ball(picture, background, diameter_px, settings)[0] is not None for picture in pictures]
    if 2 * sum(found) >= len(pictures):
        return background
    values = pictures[:, loud].astype(np.float32)
    changed = np.median(np.abs(np.diff(values, axis=0)), axis=0) / CHANGE_SIGMAS
    noise = background.noise.copy()
    noise[loud] = np.clip(changed, background.typical_noise, noise[loud])
    return replace(background, noise=noise)


def _covered(
    pictures: NDArray[Any], background: Background, diameter_px: float, settings: LocateSettings
) -> NDArray[np.bool_]:
    """Pixels of the ball in each of (n, H, W) frames; none where it was not found."""
    covered = np.zeros(pictures.shape, bool)
    for picture, mask in zip(pictures, covered, strict=True):
        outline, _ = find_ball(picture, background, diameter_px, settings)
        if outline is None:
            continue
        reach = RIM * outline.radius_px + 1
        left, top = max(0, int(outline.u_px - reach)), max(0, int(outline.v_px - reach))
        window = mask[top : int(outline.v_px + reach) + 2, left : int(outline.u_px + reach) + 2]
        row, column = np.ogrid[: window.shape[0], : window.shape[1]]
        window[...] = (row + top - outline.v_px) ** 2 + (column + left - outline.u_px) ** 2 <= reach**2
    return covered
