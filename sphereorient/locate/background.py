"""What the movie shows without the sphere: the mean of evenly spread frames, and its noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.cameras.whole_file import read_whole
from sphereorient.errors import ExperimentError, refusal
from sphereorient.sphere.picture_claim import claimed_pixels, decoded_grey

# A pixel's scatter is read off at this share of its frames, and divided by what that is for Gaussian noise in standard
# deviations. About a background taken from the movie: things that turn and glitter move a pixel in more frames than
# that, the passing ball in fewer. About a picture of the scene without the ball: also where the ball stays for most
# of the movie, a tenth of the frames shows the scene.
MEASURED_SHARE, MEASURED_SIGMAS = 0.8, 1.2816
GIVEN_SHARE, GIVEN_SIGMAS = 0.1, 0.1257
BYTES_A_PIXEL, HEADER_BYTES = 8, 1_000_000  # of a picture without any compression, and what may stand before it
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
    do = "save a frame without the ball as PNG, in the movie's own grey levels"
    return np.asarray(_picture(path, f"background {path}", frame_shape, do), np.float32)


def load_mask(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Read where the ball can be seen, (H, W): black in the picture is what hides it, white all else.

    Raises:
        ExperimentError: the file is missing, no picture, of another size than the movie's frames, or all black.
    """
    name, do = f"mask {path}", "paint what hides the ball black, all else white, on a frame of the movie"
    picture = _picture(path, name, frame_shape, do)
    shown = np.asarray(picture > np.iinfo(picture.dtype).max // 2)
    if not shown.any():
        raise ExperimentError(refusal(name, expected="white where the ball is seen", got="black only", do=do))
    return shown


def _picture(path: Path, name: str, frame_shape: tuple[int, int], do: str) -> NDArray[Any]:
    """Read a grey picture of the size of a movie's frames, (H, W), in its own depth."""
    height, width = frame_shape
    content = read_whole(path, BYTES_A_PIXEL * height * width + HEADER_BYTES, "a picture", ExperimentError, do)
    claimed = claimed_pixels(content)
    if claimed is not None and claimed > height * width:  # told before room is made for it
        expected, got = f"{width} x {height} px as the movie", f"{claimed} px"
        raise ExperimentError(refusal(name, expected=expected, got=got, do=do))
    picture = None if claimed is None else decoded_grey(content)
    if picture is None:
        raise ExperimentError(refusal(name, expected="a picture", got="a file that is none", do=do))
    if picture.shape != frame_shape:
        expected, got = (f"{shape[1]} x {shape[0]} px as the movie" for shape in (frame_shape, picture.shape))
        raise ExperimentError(refusal(name, expected=expected, got=got.removesuffix(" as the movie"), do=do))
    return picture


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
