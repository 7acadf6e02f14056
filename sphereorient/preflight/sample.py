"""The sampled frames of the check, and the ball in them."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, holds_disk
from sphereorient.errors import ExperimentError, MovieError, Reason, refusal
from sphereorient.experiment import Sphere
from sphereorient.experiment.recording import CameraStream, pictures_of, spread_frames, uniform
from sphereorient.experiment.timeline import NONE
from sphereorient.locate import (
    Background,
    Found,
    LocateSettings,
    Sightings,
    find_ball,
    learn_background,
    screened,
    sightings_of,
)
from sphereorient.locate.background import measure_background
from sphereorient.locate.outline import Outline
from sphereorient.locate.scene import SMALLEST_PX, measured_size_px, still_ball, swaying_ball

SPREAD = 25  # frames all over the movie: enough for a background
EVERY = 3  # of these, each third one is read with the next frame, for motion and repeated frames
FEW = 0.2  # share of the frames; if the ball is found in fewer, other sizes are tried
LARGEST = 0.9  # of the picture's shorter side: the first diameter tried
BALLS = 12  # frames in which a ball of unknown size is searched

Grey = NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class MovieSample:
    """n frames of one camera and the ball in them; made by `sample_movie`, read by the checks."""

    stream: CameraStream
    frame: NDArray[np.int64]  # (n,), index in the timeline, increasing
    picture: tuple[Grey | None, ...]  # n; None where missing or undecodable
    background: Background
    diameter_px: float  # searched
    expected_px: float | None  # by cameras and diameter; None: unknown
    screen: tuple[Reason, ...] = ()  # n, whether the picture as a whole can show a ball
    found: tuple[Found, ...] = ()  # n

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.stream.name

    @property
    def camera(self) -> Camera:
        """Camera of the sample."""
        return self.stream.camera

    @property
    def row(self) -> NDArray[np.int64]:
        """Index in the movie, (n,); NONE without a picture."""
        return self.stream.rows[self.frame]

    @cached_property
    def sightings(self) -> Sightings:
        """The outlines as arrays."""
        return sightings_of(self.found)

    @cached_property
    def whole(self) -> Tensor:
        """Frames whose picture holds the whole disk of the ball, (n,) bool."""
        return holds_disk(self.camera, self.sightings.centre_px, self.sightings.radius_px)

    @property
    def balls(self) -> list[tuple[Grey, Outline]]:
        """Picture and outline of the frames with a ball."""
        pairs = zip(self.picture, self.found, strict=True)
        return [(picture, outline) for picture, (outline, _) in pairs if picture is not None and outline is not None]


def pair_starts(count: int) -> list[int]:
    """Return the frames of `frames_to_sample` that are read with the next frame."""
    return [k for k in spread_frames(range(count), SPREAD)[::EVERY] if k + 1 < count]


def frames_to_sample(count: int) -> list[int]:
    """Return the frames of a timeline to read first: evenly spread ones, some with their next frame."""
    return sorted({*spread_frames(range(count), SPREAD), *(k + 1 for k in pair_starts(count))})


def sample_movie(
    stream: CameraStream,
    diameter_px: float | None,
    settings: LocateSettings,
    empty: Grey | None = None,
    sphere: Sphere | None = None,
) -> MovieSample:
    """Sample one camera's frames, background and ball; measure its diameter if None; `empty`: a picture without it.
    Raises MovieError: no sampled frame can be decoded.
    """
    frame = np.asarray(frames_to_sample(len(stream)), np.int64)
    picture = tuple(pictures_of(stream.movie, stream.rows[frame]))
    known = [one for one in picture if one is not None]
    shown = [one for one in known if not uniform(one)] or known
    if not shown:
        do = "check that it plays; export it again if not"
        raise MovieError(refusal(str(stream.movie.path), expected="pictures", got="none that can be decoded", do=do))
    some = np.stack([shown[k] for k in spread_frames(range(len(shown)), SPREAD)])

    in_place = stream.photograph or (sphere is not None and sphere.in_place)
    guessed = None if empty is not None or not in_place else replace(_surroundings(some), shown=stream.shown)
    if guessed is not None and not (sphere is not None and sphere.fixed and not stream.photograph):
        find = still_ball if stream.photograph else swaying_ball
        with suppress(ExperimentError):  # no ball is reported by the checks
            guessed = find(some, settings, shown=stream.shown)[1]

    def at_size(size_px: float) -> MovieSample:
        background = guessed or learn_background(some, size_px, settings, empty, stream.shown)
        look: dict[str, Any] = {"stream": stream, "frame": frame, "picture": picture, "background": background}
        return _searched(MovieSample(**look, diameter_px=size_px, expected_px=diameter_px), settings)

    largest_px = LARGEST * min(stream.movie.frame_shape)
    first = at_size(diameter_px if diameter_px is not None and diameter_px >= SMALLEST_PX else largest_px / 4)
    if diameter_px is not None and len(first.balls) > FEW * len(shown):
        return first
    # The size is unknown or wrong: take whatever is as round as a ball.
    chosen = [shown[k] for k in spread_frames(range(len(shown)), BALLS)]
    size_px = measured_size_px(chosen, first.background, settings, LARGEST)
    return first if size_px is None else at_size(size_px)


def sample_more(sample: MovieSample, frames: Sequence[int], settings: LocateSettings) -> MovieSample:
    """Read other frames of the same camera, with the same background and size of the ball."""
    frame = np.asarray(frames, np.int64)
    picture = tuple(pictures_of(sample.stream.movie, sample.stream.rows[frame]))
    return _searched(replace(sample, frame=frame, picture=picture), settings)


def _searched(sample: MovieSample, settings: LocateSettings) -> MovieSample:
    screen: list[Reason] = []
    found: list[Found] = []
    rows = sample.row
    for k, (row, picture) in enumerate(zip(rows, sample.picture, strict=True)):
        reason = Reason.MISSING if row == NONE else Reason.UNDECODABLE
        ball: Found | None = None
        if picture is not None:  # a repeated picture is known only if its neighbour was read
            neighbour = sample.picture[k - 1] if k > 0 and row == rows[k - 1] + 1 else None
            reason = screened(picture, neighbour, sample.background).reason
            if reason in (Reason.OK, Reason.REPEATED):
                ball = find_ball(picture, sample.background, sample.diameter_px, settings)
        screen.append(reason)
        found.append(ball or (None, reason))
    return replace(sample, screen=tuple(screen), found=tuple(found))


def _surroundings(pictures: Grey) -> Background:
    """Return the median grey level of the pictures, as background of a ball that never moves."""
    measured = measure_background(pictures)
    middle = np.full(measured.mean.shape, np.median(measured.mean), np.float32)
    noise = np.full(middle.shape, measured.typical_noise, np.float32)
    return Background(mean=middle, noise=noise, full_scale=measured.full_scale)
