"""What the movie shows without the sphere: the mean of evenly spread frames, and its noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import ExperimentError, refusal
from sphereorient.movies import Movie

# A pixel's scatter is read off at this share of its frames, and divided by what that is for Gaussian noise in standard
# deviations. About a background taken from the movie: things that turn and glitter move a pixel in more frames than
# that, the passing ball in fewer. About a picture of the scene without the ball: also where the ball stays for most
# of the movie, a tenth of the frames shows the scene.
MEASURED_SHARE, MEASURED_SIGMAS = 0.8, 1.2816
GIVEN_SHARE, GIVEN_SIGMAS = 0.1, 0.1257


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


def load_background(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Read a picture of the scene without the ball, (H, W), grey levels.

    Raises:
        ExperimentError: the file is missing, no picture, or of another size than the movie's frames.
    """
    name, do = f"background {path}", "save a frame without the ball as PNG, in the movie's own grey levels"
    picture = None
    if path.is_file():
        data = np.fromfile(path, dtype=np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) if data.size else None
    if picture is None:
        got = "a file that is none" if path.exists() else "no such file"
        raise ExperimentError(refusal(name, expected="a picture", got=got, do=do))
    if picture.shape != frame_shape:
        expected, got = (f"{shape[1]} x {shape[0]} px as the movie" for shape in (frame_shape, picture.shape))
        raise ExperimentError(refusal(name, expected=expected, got=got.removesuffix(" as the movie"), do=do))
    return np.asarray(picture, np.float32)


def measure_background(
    movie: Movie, frames: Sequence[int], empty: NDArray[np.float32] | None = None
) -> Background:
    """Average frames of a movie and measure how much each pixel scatters without the ball.

    Turning, glittering things scatter in every frame and the passing ball only in some: a quantile tells them apart.

    Args:
        movie: the movie.
        frames: numbers of the frames, in the movie's own counting; all are held in memory at once.
        empty: (H, W), the scene without the ball, where there is such a picture: for short movies, or a ball that
            hardly moves; only the noise is then measured.

    Returns:
        The background. The paper's plain mean keeps 1/n of the ball's brightness wherever it passed, as much as black
        paint differs from a dark wall; the mean here leaves out the frames in which a pixel was covered (more than
        four robust sigmas from its median), and so sees the rim where the plain mean is blind (paper section III A).
    """
    pictures = movie.sample(frames)
    full_scale = float(np.iinfo(movie.dtype).max)
    rounding = full_scale / 255 / 12**0.5  # scatters by this much also where all frames are equal
    share, sigmas = (MEASURED_SHARE, MEASURED_SIGMAS) if empty is None else (GIVEN_SHARE, GIVEN_SIGMAS)
    mean = np.empty(movie.frame_shape, np.float32)
    noise = np.empty_like(mean)
    for row in range(0, len(mean), 16):  # by strips: a float copy of all frames would be four times the frames
        these = np.s_[row : row + 16]
        strip = pictures[:, these].astype(np.float32)
        middle = np.median(strip, axis=0) if empty is None else empty[these]
        scatter = np.abs(strip - middle)
        sigma = np.maximum(np.quantile(scatter, share, axis=0) / sigmas, rounding)
        usual = scatter <= 4 * sigma
        mean[these] = middle if empty is not None else np.where(usual, strip, 0).sum(0) / usual.sum(0)
        noise[these] = sigma
    return Background(mean=mean, noise=noise, full_scale=full_scale)
