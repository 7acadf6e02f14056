"""The sampled frames of the check, and the ball in them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, holds_disk
from sphereorient.errors import MovieError, Reason, refusal
from sphereorient.experiment.recording import CameraStream, pictures_of, spread_frames, uniform
from sphereorient.experiment.timeline import NONE
from sphereorient.follow.initialise import FAINT
from sphereorient.locate import (
    Background,
    Found,
    LocateSettings,
    Sightings,
    ball_at,
    learn_background,
    screened,
    sightings_of,
)
from sphereorient.locate.background import measure_background
from sphereorient.locate.outline import Outline, find_blobs
from sphereorient.locate.scene import SMALLEST_PX, CameraScene, measured_size_px

SPREAD = 25  # frames spread over the movie, enough for a background
EVERY = 3  # each third of these is read with the next frame, for motion and repeated frames
MORE = (4, 16)  # times as many are read if none shows the ball
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
    in_place: Outline | None = None  # of a fixed ball
    screen: tuple[Reason, ...] = ()  # n, whether the whole picture is usable
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
        """Frames that show the whole disk of the ball, (n,) bool."""
        return holds_disk(self.camera, self.sightings.centre_px, self.sightings.radius_px)

    @property
    def balls(self) -> list[tuple[Grey, Outline]]:
        """Picture and outline of the frames with a ball."""
        pairs = zip(self.picture, self.found, strict=True)
        return [(picture, outline) for picture, (outline, _) in pairs if picture is not None and outline is not None]


def pair_starts(count: int, spread: int = SPREAD) -> list[int]:
    """Return the frames of `frames_to_sample` that are read with the next frame."""
    return [k for k in spread_frames(range(count), spread)[::EVERY] if k + 1 < count]


def frames_to_sample(count: int, spread: int = SPREAD) -> list[int]:
    """Return the frames to read first: evenly spread, some with the next frame."""
    return sorted({*spread_frames(range(count), spread), *(k + 1 for k in pair_starts(count, spread))})


def sample_movie(
    stream: CameraStream,
    diameter_px: float | None,
    settings: LocateSettings,
    empty: Grey | None = None,
    scene: CameraScene | None = None,
    stays: bool = False,
) -> MovieSample:
    """Sample one camera's frames, background and ball; measure the diameter if None. `empty`: a picture without the
    ball; `scene`: background and size by the tracker; `stays`: the ball is fixed. Raises MovieError: no frame can be
    decoded.
    """
    read = _read(stream, frames_to_sample(len(stream)))
    known = [one for one in read["picture"] if one is not None]
    shown = [one for one in known if not uniform(one)] or known
    if not shown:
        do = "check that it plays; export it again if not"
        raise MovieError(refusal(str(stream.movie.path), expected="pictures", got="none that can be decoded", do=do))
    some = np.stack([shown[k] for k in spread_frames(range(len(shown)), SPREAD)])

    def at_size(size_px: float) -> MovieSample:
        around = (stream.photograph or stays) and empty is None
        guess = replace(_surroundings(some), shown=stream.shown) if around else None
        background = guess or learn_background(some, size_px, settings, empty, stream.shown)
        look = MovieSample(**read, stream=stream, background=background, diameter_px=size_px, expected_px=diameter_px)
        return _searched(look, settings)

    if scene is None:
        largest_px = LARGEST * min(stream.movie.frame_shape)
        first = at_size(diameter_px if diameter_px is not None and diameter_px >= SMALLEST_PX else largest_px / 4)
    else:
        look: dict[str, Any] = {
            "background": scene.background,
            "diameter_px": scene.diameter_px,
            "in_place": scene.outline,
        }
        first = _searched(MovieSample(**read, **look, stream=stream, expected_px=diameter_px), settings)
        for times in MORE:  # the ball may pass in a few frames
            if first.balls or len(first.frame) >= len(stream):
                break
            first = sample_more(first, frames_to_sample(len(stream), times * SPREAD), settings)
    if (scene is not None or diameter_px is not None) and len(first.balls) > FEW * len(shown):
        return first
    # The size is unknown or wrong: take any round region.
    chosen = [shown[k] for k in spread_frames(range(len(shown)), BALLS)]
    size_px = measured_size_px(chosen, first.background, settings, LARGEST)
    other = first if size_px is None else at_size(size_px)
    return other if len(other.balls) > len(first.balls) else first


def _read(stream: CameraStream, frames: Sequence[int]) -> dict[str, Any]:
    frame = np.asarray(frames, np.int64)
    return {"frame": frame, "picture": tuple(pictures_of(stream.movie, stream.rows[frame]))}


def sample_more(sample: MovieSample, frames: Sequence[int], settings: LocateSettings) -> MovieSample:
    """Read other frames of the same camera, with the same background and size of the ball."""
    return _searched(replace(sample, **_read(sample.stream, frames)), settings)


def _searched(sample: MovieSample, settings: LocateSettings) -> MovieSample:
    screen: list[Reason] = []
    found: list[Found] = []
    merits = np.zeros(len(sample.row))  # of the best blobs
    rows, scene, size = sample.row, sample.background, sample.diameter_px
    for k, (row, picture) in enumerate(zip(rows, sample.picture, strict=True)):
        reason = Reason.MISSING if row == NONE else Reason.UNDECODABLE
        ball: Found | None = None
        if picture is not None:  # a repeated picture is known only if its neighbour was read
            neighbour = sample.picture[k - 1] if k > 0 and row == rows[k - 1] + 1 else None
            reason = screened(picture, neighbour, scene).reason
            if reason in (Reason.OK, Reason.REPEATED) and sample.in_place is not None:
                ball = sample.in_place, Reason.OK
            elif reason in (Reason.OK, Reason.REPEATED):
                difference = scene.difference(picture)
                blobs = find_blobs(difference, scene.noise, size, settings)
                merits[k] = max((blob.merit for blob in blobs), default=0.0)
                ball = ball_at(blobs, difference, picture, scene, size, settings)
        screen.append(reason)
        found.append(ball or (None, reason))
    seen = np.array([outline is not None for outline, _ in found])
    if seen.any():  # fainter blobs are not the ball
        least = FAINT * float(np.median(merits[seen]))
        faint = (merits < least) & ~seen & np.isin(screen, (Reason.OK, Reason.REPEATED))
        found = [(None, Reason.NOT_FOUND) if none else one for none, one in zip(faint, found, strict=True)]
    return replace(sample, screen=tuple(screen), found=tuple(found))


def _surroundings(pictures: Grey) -> Background:
    """Return the median grey level of the pictures, as background of a ball that never moves."""
    measured = measure_background(pictures)
    middle = np.full(measured.mean.shape, np.median(measured.mean), np.float32)
    noise = np.full(middle.shape, measured.typical_noise, np.float32)
    return Background(mean=middle, noise=noise, full_scale=measured.full_scale)
