"""What the movie shows without the sphere: the mean of evenly spread frames, and its noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies import Movie

# A pixel's scatter is read off at this share of its frames: things that turn and glitter move it in more of them, the
# passing ball in fewer. For Gaussian noise that is so many standard deviations.
QUIET = 0.8
QUIET_SIGMAS = 1.2816


@dataclass(frozen=True, kw_only=True, eq=False)
class Background:
    """Mean picture and noise of one movie; made by `measure_background`, read by blob and outline."""

    mean: NDArray[np.float32]  # (H, W), grey levels
    noise: NDArray[np.float32]  # (H, W), robust standard deviation of each pixel about the mean, grey levels
    full_scale: float  # grey level of a saturated pixel, 255 for 8 bit

    @cached_property
    def typical_noise(self) -> float:
        """Median of the pixels' noise, grey levels."""
        return float(np.median(self.noise))

    def difference(self, frame: NDArray[np.generic]) -> NDArray[np.float32]:
        """Return |frame - background|, (H, W) float32, grey levels.

        White paint is brighter and black paint often darker than what lies behind: both count as ball.
        """
        out: NDArray[np.float32] = np.abs(frame.astype(np.float32) - self.mean)
        return out


def spread_frames(frames: range, count: int) -> list[int]:
    """Return at most `count` frame numbers, evenly spread over a range, ends included."""
    if len(frames) <= count:
        return list(frames)
    return [frames[int(i)] for i in np.linspace(0, len(frames) - 1, count).round()]


def measure_background(movie: Movie, frames: Sequence[int]) -> Background:
    """Average frames of a movie and measure how much each pixel scatters without the ball.

    Turning, glittering things scatter in every frame and the passing ball only in some: a median tells them apart.

    Args:
        movie: the movie.
        frames: numbers of the frames, in the movie's own counting; all are held in memory at once.

    Returns:
        The background. The paper's plain mean keeps 1/n of the ball's brightness wherever it passed, as much as black
        paint differs from a dark wall; the mean here leaves out the frames in which a pixel was covered (more than
        four robust sigmas from its median), and so sees the rim where the plain mean is blind (paper section III A).
    """
    pictures = movie.sample(frames)
    full_scale = float(np.iinfo(movie.dtype).max)
    rounding = full_scale / 255 / 12**0.5  # scatters by this much also where all frames are equal
    mean = np.empty(movie.frame_shape, np.float32)
    noise = np.empty_like(mean)
    for row in range(0, len(mean), 16):  # by strips: a float copy of all frames would be four times the frames
        strip = pictures[:, row : row + 16].astype(np.float32)
        middle = np.median(strip, axis=0)
        scatter = np.abs(strip - middle)
        sigma = np.maximum(np.quantile(scatter, QUIET, axis=0) / QUIET_SIGMAS, rounding)
        usual = scatter <= 4 * sigma
        mean[row : row + 16] = np.where(usual, strip, 0).sum(0) / usual.sum(0)
        noise[row : row + 16] = sigma
    return Background(mean=mean, noise=noise, full_scale=full_scale)
