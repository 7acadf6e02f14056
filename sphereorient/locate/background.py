"""The background of a movie, and frames without information: unreadable, dark, saturated or repeated."""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import Reason
from sphereorient.experiment.recording import EVERY, CameraStream, Shown, equal, uniform, whole
from sphereorient.locate.outline import Levels, Mask

Picture = NDArray[Any]
# A pixel's noise is a quantile of its deviations over that of a unit normal. Measured mean: glitter is in more frames
# than 1 - share, the sphere in fewer. Given scene: a tenth of the frames suffices, as the sphere may stay long.
MEASURED_SHARE, MEASURED_SIGMAS = 0.8, 1.2816
GIVEN_SHARE, GIVEN_SIGMAS = 0.1, 0.1257
FREE = 4  # least frames without a sphere to measure a pixel
LOUD = 5.0  # times the typical noise: a sphere passes
CHANGING = 0.3  # share of loud pixels around one that belongs to a rotating sphere
EVEN_DIAMETERS, EVEN_DIAMETER_PX = 2.2, 12.5  # side of the square of `even_scene`; reduced diameter
FEW = 10  # frames; with fewer, all pixels get the same noise
LIT_NOISES = 10.0  # a lit background pixel is this many noise sigmas above black
LIT_SHARE = 0.1  # least share of lit pixels; in a darker scene a failed lamp is invisible
DARK_LEVEL = 0.3  # darker than this share of the background is unlit
DARK_SHARE = 0.95  # share of the lit pixels
WHITE_SHARE = 0.5  # share of all pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Background:
    """Mean picture and noise of one movie."""

    mean: Levels  # (H, W), grey levels
    noise: Levels  # (H, W), robust sigma about the mean, grey levels
    full_scale: float  # saturated grey level: 255 for 8 bit, 1023 for 10 bit
    shown: Mask | None = None  # (H, W), False where something static hides the sphere

    @cached_property
    def typical_noise(self) -> float:
        """Median noise of the pixels, grey levels."""
        return float(np.median(self.noise))

    def difference(self, frame: NDArray[np.generic]) -> Levels:
        """Return |frame - background|, (H, W) float32, grey levels; 0 where the sphere is hidden."""
        out: Levels = np.abs(frame.astype(np.float32) - self.mean)
        if self.shown is not None:
            out[~self.shown] = 0
        return out


def measure_background(pictures: NDArray[Any], empty: Levels | None = None) -> Background:
    """Return the clipped mean and noise per pixel of evenly spread frames (n, H, W), uint8 or uint16.
    Values beyond four robust sigmas are left out: the plain mean (paper, section III A) keeps 1/n of the sphere. With
    `empty` (H, W), the scene without the sphere, only the noise is measured.
    """
    full_scale = full_scale_of(pictures)
    shape = pictures.shape[1:]
    mean, noise = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for row in range(0, shape[0], 16):  # in strips: a float copy of all frames has four times their size
        these = np.s_[row : row + 16]
        given = None if empty is None else empty[these]
        mean[these], noise[these] = _statistics(pictures[:, these].astype(np.float32), given, full_scale)
    if empty is not None:
        # A low quantile of integers is often 0: the typical noise is the lower limit.
        quiet = np.abs(pictures[:, ::8, ::8].astype(np.float32) - empty[::8, ::8])
        if len(pictures) >= FEW:
            noise = np.maximum(noise, np.median(_nan_quantile(quiet, MEASURED_SHARE)) / MEASURED_SIGMAS)
        else:  # else the sphere counts as noise
            noise = np.full(shape, max(1.4826 * np.median(quiet), _rounding(full_scale)), np.float32)
    return Background(mean=mean, noise=noise, full_scale=full_scale)


def full_scale_of(pictures: NDArray[Any]) -> float:
    """Return the grey level of a saturated pixel: 10 to 14 bit cameras use the lower bits of 16."""
    if pictures.dtype.itemsize == 1:
        return 255.0
    return _next_scale(float(pictures.max(initial=0)))


def _next_scale(brightest: float) -> float:
    return float(next(2**bits - 1 for bits in (10, 12, 14, 16) if brightest < 2**bits))


def saturated(grey: NDArray[Any], background: Background) -> float:
    """Return the share of saturated grey levels; brighter ones than the full scale show that it is larger."""
    brightest = float(grey.max(initial=0))
    full_scale = background.full_scale if brightest <= background.full_scale else _next_scale(brightest)
    return float(np.mean(grey >= full_scale))


def even_scene(background: Background, diameter_px: float) -> Background:
    """Return a background without any sphere, even one that never leaves its pixels, but without detail: the median
    around each pixel, over a few diameters.
    """
    mean = background.mean
    low, high = float(mean.min()), max(float(mean.max()), float(mean.min()) + 1.0)
    shrink = max(1.0, diameter_px / EVEN_DIAMETER_PX)
    size = (max(1, round(mean.shape[1] / shrink)), max(1, round(mean.shape[0] / shrink)))
    small = cv2.resize((mean - low) * (255 / (high - low)), size, interpolation=cv2.INTER_AREA)
    side = int(EVEN_DIAMETERS * diameter_px / shrink) | 1
    wide = np.pad(np.rint(small).astype(np.uint8), side // 2, mode="symmetric")
    middle = cv2.medianBlur(wide, side)[side // 2 :, side // 2 :][: size[1], : size[0]]
    even = cv2.resize(middle.astype(np.float32), mean.shape[::-1], interpolation=cv2.INTER_LINEAR)
    noise = np.full_like(background.noise, background.typical_noise)
    return replace(background, mean=even * np.float32((high - low) / 255) + np.float32(low), noise=noise)


def filled(background: Background, even: Background, covered: Mask, diameter_px: float) -> Background:
    """Return a background with the even scene where rotating spheres cover pixels in nearly all frames (n, H, W)."""
    loud = (background.noise > LOUD * background.typical_noise).astype(np.float32)
    changes = cv2.blur(loud, (int(diameter_px / 2) | 1,) * 2) > CHANGING  # pixels without change belong to the scene
    never = (len(covered) - covered.sum(0) < FREE) & changes
    mean, noise = (
        np.where(never, getattr(even, part), getattr(background, part)).astype(np.float32) for part in ("mean", "noise")
    )
    return replace(background, mean=mean, noise=noise)


def without_ball(background: Background, pictures: NDArray[Any], covered: Mask) -> Background:
    """Measure the pixels `covered` (n, H, W) again from the other frames, if there are at least `FREE`."""
    free = len(pictures) - covered.sum(axis=0)
    again = (free < len(pictures)) & (free >= FREE)
    values = pictures[:, again].astype(np.float32)
    values[covered[:, again]] = np.nan
    mean, noise = background.mean.copy(), background.noise.copy()
    mean[again], noise[again] = _statistics(values, None, background.full_scale)
    return replace(background, mean=mean, noise=noise)


def _rounding(full_scale: float) -> float:
    return float(full_scale / 255 / 12**0.5)


def _statistics(values: Levels, given: Levels | None, full_scale: float) -> tuple[Levels, Levels]:
    """Return the clipped mean, or the given one, and the robust sigma over axis 0, ignoring NaN."""
    rounding = _rounding(full_scale)
    share, sigmas = (MEASURED_SHARE, MEASURED_SIGMAS) if given is None else (GIVEN_SHARE, GIVEN_SIGMAS)
    middle = _nan_quantile(values, 0.5) if given is None else given
    scatter = np.abs(values - middle)
    sigma = np.maximum(_nan_quantile(scatter, share) / sigmas, rounding)
    if given is not None:
        return given, sigma
    usual = scatter <= 4 * sigma
    return np.where(usual, values, 0).sum(0) / usual.sum(0), sigma


def _nan_quantile(values: Levels, share: float) -> Levels:
    """Return the quantile over axis 0 without NaN, nearest rank; np.nanquantile loops over pixels."""
    ordered = np.sort(values, axis=0)
    count = np.isfinite(values).sum(axis=0)
    rank = np.clip(np.rint(share * (count - 1)), 0, None).astype(np.int64)
    return np.asarray(np.take_along_axis(ordered, rank[None], axis=0)[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Picture of one camera at one instant."""

    shown: Shown  # (H, W); zeros if missing
    read: Reason = Reason.OK  # OK, MISSING, UNDECODABLE, or REPEATED: equal to the frame before
    background: Background | None = None  # of the empty scene, to test for dark or white; None: no test

    @cached_property
    def picture(self) -> Picture:
        """The whole picture."""
        return whole(self.shown)

    @cached_property
    def reason(self) -> Reason:
        """OK, or why it cannot be used: as `read`, or `DARK` (no light) or `SATURATED` (white)."""
        if self.background is None or self.read in (Reason.MISSING, Reason.UNDECODABLE):
            return self.read
        return dark_or_white(self.picture, self.background) or self.read

    @property
    def usable(self) -> bool:
        """Whether the picture may show the sphere."""
        return self.reason is Reason.OK

    @property
    def readable(self) -> bool:
        """Whether there is a new picture; `usable` also tests its light."""
        return self.read is Reason.OK


def dark_or_white(picture: Picture, background: Background) -> Reason | None:
    """Return `DARK` (no light) or `SATURATED` (white) for a picture (H, W) without information; else None."""
    some = picture[::EVERY, ::EVERY]
    empty = background.mean[::EVERY, ::EVERY]
    if uniform(picture):
        return Reason.SATURATED if float(some[0, 0]) > 0.5 * background.full_scale else Reason.DARK
    if saturated(some, background) > max(WHITE_SHARE, 2 * saturated(empty, background)):
        return Reason.SATURATED
    lit = empty > LIT_NOISES * background.typical_noise
    if lit.mean() > LIT_SHARE and np.mean(some[lit] < DARK_LEVEL * empty[lit]) > DARK_SHARE:
        return Reason.DARK
    return None


def screened(picture: Shown, before: Shown | None, background: Background) -> Frame:
    """Return the frame of a picture (H, W) that follows another one."""
    read = Reason.REPEATED if equal(picture, before) else Reason.OK
    return Frame(shown=picture, read=read, background=background)


def screened_frames(
    stream: CameraStream, background: Background, first: int = 0, last: int | None = None, pool: Executor | None = None
) -> Iterator[Frame]:
    """Yield frames first .. last - 1 from the first in use; reasons depend on this and the previous frame only.
    With a `pool`, movies that allow it are decoded there, in the parts that fits need.
    """
    lead = min(first, 1)
    blank = np.zeros(stream.movie.frame_shape, stream.movie.dtype)
    before: Shown | None = None
    pictures = stream.pictures(first - lead, last) if pool is None else stream.on_demand(pool, first - lead, last)
    for k, (picture, reason) in enumerate(pictures):
        if k >= lead and picture is None:
            yield Frame(shown=blank, read=reason)
        elif k >= lead and picture is not None:
            yield screened(picture, before, background)
        before = picture
