from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.cameras import Camera
from sphereorient.errors import MovieError, refusal
from sphereorient.experiment.timeline import NONE
from sphereorient.movies import Grey, Movie
from sphereorient.trajectory import Reason

EVERY = 4  # pixels: faults of whole pictures show in every fourth row and column
GLARE_SHARE = 0.5  # share of saturated pixels that excludes a picture from the background


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraStream:
    """A camera, its movie, and the picture of each frame; made by `open_recording`."""

    name: str
    camera: Camera
    movie: Movie
    rows: NDArray[np.int64]  # (N,), number in the movie, or NONE
    shown: NDArray[np.bool_] | None = None  # (H, W), False where something hides the sphere; None: nowhere

    def __len__(self) -> int:
        return len(self.rows)

    def pictures(self, first: int = 0, last: int | None = None) -> Iterator[tuple[Grey | None, Reason]]:
        """Yield the pictures of frames first .. last - 1, from the first frame in use, or None, with the reason."""
        rows = self.rows[first:last]
        for row, picture in zip(rows.tolist(), pictures_of(self.movie, rows), strict=True):
            why = Reason.MISSING if row == NONE else Reason.UNDECODABLE
            yield picture, why if picture is None else Reason.OK

    def spread(self, count: int) -> Grey:
        """Return at most `count` evenly spread readable pictures, (n, H, W); raise MovieError if there are none."""
        numbers = self.rows[self.rows != NONE].tolist()
        wanted = [numbers[k] for k in spread_frames(range(len(numbers)), count)]
        try:
            pictures = list(self.movie.sample(wanted))
        except MovieError:
            pictures = [picture for picture in _read(self.movie, wanted) if picture is not None]
        good = [picture for picture in pictures if not (uniform(picture) or _glares(picture))]
        if not good:
            got, do = "none (black, white or damaged ones)", "check the movie with `sphereorient movie`"
            raise MovieError(refusal(str(self.movie.path), expected="readable pictures", got=got, do=do))
        return np.stack(good)


def spread_frames(frames: range, count: int) -> list[int]:
    """Return at most `count` evenly spread frame numbers of a range, ends included."""
    if len(frames) <= count:
        return list(frames)
    return [frames[int(i)] for i in np.linspace(0, len(frames) - 1, count).round()]


def uniform(picture: Grey) -> bool:
    """Return whether a picture has only one grey level."""
    some = picture[::EVERY, ::EVERY]
    return bool(some.min() == some.max())


def pictures_of(movie: Movie, rows: NDArray[np.int64]) -> Iterator[Grey | None]:
    """Yield a movie's pictures by number (N,); None for NONE and undecodable pictures."""
    found = _read(movie, rows[rows != NONE].tolist())
    for row in rows.tolist():
        yield None if row == NONE else next(found)


def _read(movie: Movie, numbers: Sequence[int]) -> Iterator[Grey | None]:
    """Yield pictures by number, consecutive ones in one pass."""
    begin = 0
    for end in range(1, len(numbers) + 1):
        if end == len(numbers) or numbers[end] != numbers[end - 1] + 1:
            yield from movie.readable(numbers[begin], numbers[end - 1] + 1)
            begin = end


def _glares(picture: Grey) -> bool:
    return float(np.mean(picture[::4, ::4] == np.iinfo(picture.dtype).max)) > GLARE_SHARE
