"""What the movie shows without the sphere: the mean of evenly spread frames, and its noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A pixel's scatter is read off at this share of its frames, and divided by what that is for Gaussian noise in standard
# deviations. About a background taken from the movie: things that turn and glitter move a pixel in more frames than
# that, the passing ball in fewer. About a picture of the scene without the ball: also where the ball stays for most
# of the movie, a tenth of the frames shows the scene.
MEASURED_SHARE, MEASURED_SIGMAS = 0.8, 1.2816
GIVEN_SHARE, GIVEN_SIGMAS = 0.1, 0.1257
FEW = 10  # frames; the share above means nothing in fewer, and all pixels are taken to be alike


@dataclass(frozen=True, kw_only=True, eq=False)
class Background:
    """Mean picture and noise of one movie; made by `learn_background`, read by blob and outline."""

    mean: NDArray[np.float32]  # (H, W), grey levels
    noise: NDArray[np.float32]  # (H, W), robust standard deviation of each pixel about the mean, grey levels
    full_scale: float  # grey level of a saturated pixel, 255 for 8 bit, 1023 for 10
    shown: NDArray[np.bool_] | None = None  # (H, W), False where something that does not move hides the ball

    @cached_property
    def typical_noise(self) -> float:
        """Median of the pixels' noise, grey levels."""
        return float(np.median(self.noise))

    def difference(self, frame: NDArray[np.generic]) -> NDArray[np.float32]:
        """Return |frame - background|, (H, W) float32, grey levels.

        White paint is brighter and black paint often darker than what lies behind: both count as ball. Where the ball
        is hidden nothing differs.
        """
        out: NDArray[np.float32] = np.abs(frame.astype(np.float32) - self.mean)
        if self.shown is not None:
            out[~self.shown] = 0
        return out


def measure_background(pictures: NDArray[Any], empty: NDArray[np.float32] | None = None) -> Background:
    """Average frames of a movie and measure how much each pixel scatters without the ball.

    Turning, glittering things scatter in every frame and the passing ball only in some: a quantile tells them apart.

    Args:
        pictures: (n, H, W), evenly spread frames, uint8 or uint16.
        empty: (H, W), the scene without the ball, where there is such a picture: for short movies, or a ball that
            hardly moves; only the noise is then measured.

    Returns:
        The background. The paper's plain mean keeps 1/n of the ball's brightness wherever it passed, as much as black
        paint differs from a dark wall; the mean here leaves out the frames in which a pixel was covered (more than
        four robust sigmas from its median), and so sees the rim where the plain mean is blind (paper section III A).
    """
    full_scale = _full_scale(pictures)
    shape = pictures.shape[1:]
    mean, noise = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for row in range(0, shape[0], 16):  # by strips: a float copy of all frames would be four times the frames
        these = np.s_[row : row + 16]
        given = None if empty is None else empty[these]
        mean[these], noise[these] = _statistics(pictures[:, these].astype(np.float32), given, full_scale)
    if empty is not None:
        # A low quantile of whole grey levels is often 0: no pixel is quieter than most of them are in most frames.
        quiet = np.abs(pictures[:, ::8, ::8].astype(np.float32) - empty[::8, ::8])
        if len(pictures) >= FEW:
            noise = np.maximum(noise, np.median(_nan_quantile(quiet, MEASURED_SHARE)) / MEASURED_SIGMAS)
        else:  # the ball itself would pass for a glittering thing wherever it is
            noise = np.full(shape, max(1.4826 * np.median(quiet), _rounding(full_scale)), np.float32)
    return Background(mean=mean, noise=noise, full_scale=full_scale)


def _full_scale(pictures: NDArray[Any]) -> float:
    """Grey level of a saturated pixel. Cameras of 10 to 14 bits fill 16-bit numbers from below, and no file says so."""
    if pictures.dtype.itemsize == 1:
        return 255.0
    brightest = int(pictures.max(initial=0))
    return float(next(2**bits - 1 for bits in (10, 12, 14, 16) if brightest < 2**bits))


def without_ball(background: Background, pictures: NDArray[Any], covered: NDArray[np.bool_]) -> Background:
    """Measure a background again where the ball was found, from the frames in which it was elsewhere.

    Args:
        background: as measured from all frames.
        pictures: (n, H, W), the same frames.
        covered: (n, H, W) bool, the pixels of the ball and its rim in each frame.

    Returns:
        The background; a pixel that is free in fewer than four frames keeps its values.
    """
    free = len(pictures) - covered.sum(axis=0)
    again = (free < len(pictures)) & (free >= 4)
    values = pictures[:, again].astype(np.float32)
    values[covered[:, again]] = np.nan
    mean, noise = background.mean.copy(), background.noise.copy()
    mean[again], noise[again] = _statistics(values, None, background.full_scale)
    return replace(background, mean=mean, noise=noise)


def _rounding(full_scale: float) -> float:
    """Scatter of a pixel, grey levels, where all frames are equal."""
    return float(full_scale / 255 / 12**0.5)


def _statistics(
    values: NDArray[np.float32], given: NDArray[np.float32] | None, full_scale: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Clipped mean, or the given one, and robust sigma over the first axis; NaN does not count."""
    rounding = _rounding(full_scale)
    share, sigmas = (MEASURED_SHARE, MEASURED_SIGMAS) if given is None else (GIVEN_SHARE, GIVEN_SIGMAS)
    middle = _nan_quantile(values, 0.5) if given is None else given
    scatter = np.abs(values - middle)
    sigma = np.maximum(_nan_quantile(scatter, share) / sigmas, rounding)
    if given is not None:
        return given, sigma
    usual = scatter <= 4 * sigma
    return np.where(usual, values, 0).sum(0) / usual.sum(0), sigma


def _nan_quantile(values: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    """Quantile over the first axis without NaN, nearest rank; numpy's own is a Python loop over the pixels."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    rank = np.clip(np.rint(share * (count - 1)), 0, None).astype(np.int64)
    return np.asarray(np.take_along_axis(ordered, rank[None], axis=0)[0])
