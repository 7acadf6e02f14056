"""How well the pictures are exposed: grey levels on the ball, noise, sharpness of its limb, blur by its motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.locate.outline import Outline
from sphereorient.preflight.finding import Finding, Severity
from sphereorient.preflight.look import Look

INSIDE = 0.9  # of the radius: the disk whose grey levels count
SATURATED, MUCH_SATURATED = 0.03, 0.2  # share of the ball's pixels; reflections are 1 % in a good movie
BLACK = 0.2  # share of the ball's pixels at level 0
RANGE = 0.12  # of full scale: black to white paint of less wastes the camera's levels
SIGNAL = 10.0  # white less black paint, in standard deviations of the noise
SOFT_PX, SOFT_SHARE = 1.3, 0.035  # standard deviation of the limb's blur: px, and as share of the radius
SMEAR_PX = 2.0  # that the ball moves during an exposure
INTERPOLATION_PX2 = 1 / 6  # variance that linear interpolation adds: that of a triangle two pixels wide
AROUND, REACH, FINE = 90, 7.0, 0.25  # directions, px to both sides, and px between samples of the limb's profile


@dataclass(frozen=True, kw_only=True)
class Levels:
    """Grey levels of the ball in one camera; made by `levels_of`."""

    black: float  # 5th percentile
    white: float  # 95th
    full_scale: float
    saturated_share: float
    black_share: float  # at level 0
    noise: float  # standard deviation of a pixel of the background


def levels_of(look: Look) -> Levels | None:
    """Measure the grey levels on the ball; None where no ball was found."""
    values = [_disk(picture, outline) for picture, outline in look.balls]
    if not values:
        return None
    grey = np.concatenate(values)
    black, white = np.percentile(grey, [5, 95])
    return Levels(
        black=float(black),
        white=float(white),
        full_scale=look.background.full_scale,
        saturated_share=float(np.mean(grey >= look.background.full_scale)),
        black_share=float(np.mean(grey == 0)),
        noise=look.background.typical_noise,
    )


def _disk(picture: NDArray[np.generic], outline: Outline) -> NDArray[np.generic]:
    row, column = np.ogrid[: picture.shape[0], : picture.shape[1]]
    square = (row - outline.v_px) ** 2 + (column - outline.u_px) ** 2
    return np.asarray(picture[square < (INSIDE * outline.radius_px) ** 2])


def exposure(name: str, levels: Levels | None) -> Finding:
    """Judge the grey levels of the ball in one camera."""
    title = f"exposure {name}"
    if levels is None:
        measured, advice = "cannot tell: no ball was found", "see what is said of the ball"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    signal = (levels.white - levels.black) / max(levels.noise, 1e-9)
    measured = (
        f"paint from {levels.black:.0f} to {levels.white:.0f} of {levels.full_scale:.0f}; "
        f"{100 * levels.saturated_share:.1f} % of the ball saturated, {100 * levels.black_share:.1f} % at 0; "
        f"noise {levels.noise:.1f}, signal {signal:.0f} times that"
    )
    if levels.saturated_share > SATURATED:
        severity = Severity.FAULT if levels.saturated_share > MUCH_SATURATED else Severity.WARNING
        advice = "close the lens or expose shorter: white paint must stay below the brightest level"
    elif levels.white - levels.black < RANGE * levels.full_scale or signal < SIGNAL:
        severity = Severity.WARNING
        advice = "light the ball more, or paint it with more contrast: little is left between black and white"
    elif levels.black_share > BLACK:
        severity, advice = Severity.WARNING, "raise the camera's black level: dark paint is cut off at 0"
    else:
        severity, advice = Severity.OK, ""
    return Finding(title=title, severity=severity, measured=measured, advice=advice)


def limb_blur_px(look: Look) -> float:
    """Return the blur of the ball's limb, a Gaussian's standard deviation, px; NaN where it cannot be seen.

    The mean of the limb's profiles, each moved to where it falls to half: half the distance between 84 and 16 %.
    Optics, pixel and motion together; the profiles' own interpolation is taken off.
    """
    offset = np.arange(-REACH, REACH + FINE / 2, FINE)
    profiles = [_profiles(look, picture, outline, offset) for picture, outline in look.balls]
    moved = np.concatenate([np.zeros((0, len(offset))), *profiles])
    if len(moved) < AROUND // 4:
        return math.nan
    mean = np.minimum.accumulate(np.median(moved, axis=0))
    x84, x16 = (float(np.interp(-level, -mean, offset)) for level in (0.8413, 0.1587))
    return math.sqrt(max(0.0, ((x16 - x84) / 2) ** 2 - INTERPOLATION_PX2))


def _profiles(
    look: Look, picture: NDArray[np.generic], outline: Outline, offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Profiles across the limb, 1 inside and 0 outside, of directions with even paint behind the limb."""
    angle = np.arange(AROUND) * (2 * np.pi / AROUND)
    reach = outline.radius_px + offset
    u = (outline.u_px + np.cos(angle)[:, None] * reach).astype(np.float32)
    v = (outline.v_px + np.sin(angle)[:, None] * reach).astype(np.float32)
    difference = look.background.difference(picture)
    profile = cv2.remap(difference, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    within, beyond = profile[:, offset < -3.0], profile[:, offset > 3.0]
    inside, outside = within.mean(1), beyond.mean(1)
    step = inside - outside
    noise = look.background.typical_noise
    height, width = picture.shape
    whole = (u[:, -1] >= 0) & (u[:, -1] <= width - 1) & (v[:, -1] >= 0) & (v[:, -1] <= height - 1)
    even = (within.std(1) < 0.12 * step) & (beyond.std(1) < 0.12 * step) & (step > 12 * noise) & whole
    share = (profile[even] - outside[even, None]) / step[even, None]
    # Each fit: where the profile last stands above a half.
    last = share.shape[1] - 1 - (share[:, ::-1] > 0.5).argmax(1)
    moved = []
    for one, k in zip(share, last, strict=True):
        if not 0 < k < len(offset) - 1:
            continue
        crossing = offset[k] + FINE * (one[k] - 0.5) / max(one[k] - one[k + 1], 1e-9)
        if abs(crossing) < 2.5:
            moved.append(np.interp(offset + crossing, offset, one))
    return np.asarray(moved).reshape(-1, len(offset))


def sharpness(look: Look, blur_px: float) -> Finding:
    """Judge the blur of the ball's limb."""
    title = f"sharpness {look.name}"
    if math.isnan(blur_px):
        return Finding(title=title, severity=Severity.OK, measured="cannot tell: too little of the limb stands out")
    radius_px = float(np.median([outline.radius_px for _, outline in look.balls]))
    measured = f"the limb is blurred by {blur_px:.2f} px (standard deviation), on a ball of {2 * radius_px:.0f} px"
    if blur_px <= max(SOFT_PX, SOFT_SHARE * radius_px):
        return Finding(title=title, severity=Severity.OK, measured=measured)
    advice = "focus on the ball, close the lens for more depth, or expose shorter"
    return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)


def smear(look: Look, exposure_s: float | None, frame_s: float) -> Finding:
    """Judge how far the ball moves during an exposure, from consecutive frames."""
    title = f"motion blur {look.name}"
    centre = look.sightings.centre_px
    neighbours = np.flatnonzero(np.diff(look.frame) == 1)
    moved = (centre[neighbours + 1] - centre[neighbours]).norm(dim=-1).numpy()
    moved = moved[np.isfinite(moved)]
    if not len(moved):
        measured = "cannot tell: the ball is not seen in two frames in a row"
        return Finding(title=title, severity=Severity.OK, measured=measured)
    usual, fast = np.percentile(moved, [50, 95])
    measured = f"the ball moves {usual:.2f} px a frame, {fast:.2f} at its fastest"
    if exposure_s is None:
        return Finding(title=title, severity=Severity.OK, measured=measured + "; exposure: is not given")
    share = exposure_s / frame_s
    measured += f"; {share * usual:.2f} and {share * fast:.2f} px while it is exposed"
    if share * fast <= SMEAR_PX:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    advice = "expose shorter, with more light"
    return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
