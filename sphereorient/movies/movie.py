import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.files.picture import OnDemand
from sphereorient.movies.stamps import Stamps, other_units, rate_of

Grey = NDArray[Any]  # (H, W) or (n, H, W), uint8 or uint16, row 0 on top
FRAMES_A_MAP = 64  # after which a file is mapped anew, as read pages count as memory
OTHERS = "use frame numbers of the movie"
MOST_PIXELS = 1 << 26  # more than any movie camera has
MOST_MISSING = 100  # times the existing pictures: with more gaps the numbers are not frame numbers
GAMMA_CODED = "usually gamma-coded: response: srgb"
COLOUR_REMARK = f"colour, made grey (0.299 R + 0.587 G + 0.114 B); {GAMMA_CODED}"
FLIPS = {"none": (1, 1), "vertical": (-1, 1), "horizontal": (1, -1), "both": (-1, -1), "transpose": (1, 1)}  # steps


class Movie:
    """A sequence of grey pictures; a format implements `_read`. No file stays open between calls."""

    path: Path
    format: str  # kind of file, codec, bits, in words
    frame_shape: tuple[int, int]  # (H, W)
    dtype: np.dtype[Any]  # uint8, or uint16 for files with more than 8 bits; values are not rescaled
    times_s: Stamps | None = None  # (N,), s, time stamps of the recording; None: none, or of a player
    times_unit: str = "s"  # of these stamps in the file; empty: not stated, s is assumed
    full_scale: float | None = None  # grey level of white in more than 8 bits, where the file says it
    played_hz: float | None = None  # rate of players; the recording's rate only for ordinary cameras
    photographs: bool = False  # whether these are 8-bit picture files of an ordinary camera
    remarks: tuple[str, ...] = ()  # warnings for the user: truncated, colour converted to grey, lossy codec

    def __init__(self, path: Path, form: str, count: int, frame_shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        if math.prod(frame_shape) > MOST_PIXELS:
            expected, got = (f"{pixels / 1e6:.3g} million pixels" for pixels in (MOST_PIXELS, math.prod(frame_shape)))
            raise movie_error(path, f"at most {expected} a frame", got, "cut out the part where the ball is")
        self.path, self.format, self._count = path, form, count
        self.frame_shape, self.dtype = frame_shape, dtype

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        """Yield the frames of these increasing numbers; raise MovieError at a damaged one."""
        raise NotImplementedError

    def _read_on(self, numbers: Sequence[int]) -> Iterator[Grey | None]:
        """Yield these frames, None for damaged ones; restart after each, for independent frames."""
        while numbers:
            try:
                for picture in self._read(numbers):
                    yield picture
                    numbers = numbers[1:]
            except MovieError:
                yield None
                numbers = numbers[1:]

    def __len__(self) -> int:
        return self._count

    @property
    def likely_units(self) -> str:
        """Possible units of time stamps without a stated unit and with a doubtful rate in s, as text; empty: s."""
        return "" if self.times_s is None or self.times_unit else other_units(rate_of(self.times_s))

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, as copies (H, W); MovieError outside the movie or at damage."""
        return self._read(self._range(first, last))

    def readable(self, first: int = 0, last: int | None = None) -> Iterator[Grey | None]:
        """Yield frames first .. last - 1, None for damaged ones and those predicted from them (MovieError outside)."""
        return self._read_on(self._range(first, last))

    def on_demand(self, pool: Executor, first: int = 0, last: int | None = None) -> Iterator[Grey | OnDemand | None]:
        """Yield frames as `readable`; for movies that allow it, pictures decoded in `pool` part by part."""
        return self.readable(first, last)

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return frames in the given order, (n, H, W); MovieError outside the movie or at damage."""
        asked = [int(index) for index in indices]
        outside = [index for index in asked if not 0 <= index < len(self)]
        if outside:
            raise movie_error(self.path, f"frames within 0 .. {len(self) - 1}", str(outside[0]), OTHERS)
        order = sorted(set(asked))
        pictures = np.empty((len(order), *self.frame_shape), self.dtype)
        for place, picture in enumerate(self._read(order)):
            pictures[place] = picture
        return pictures if order == asked else pictures[np.searchsorted(order, asked)]

    def _range(self, first: int, last: int | None) -> range:
        last = len(self) if last is None else last
        if not 0 <= first <= last <= len(self):
            raise movie_error(self.path, f"frames within 0 .. {len(self)}", f"{first} .. {last}", OTHERS)
        return range(first, last)

    def _damage(self, number: int, got: str) -> MovieError:
        do = "export the movie again, or leave the frame out with frames: in the experiment"
        return movie_error(f"{self.path}, frame {number}", "a decodable picture", got, do)

    def _truncated(self, stated: int) -> tuple[str, ...]:
        """Return the remark on a movie whose header states more frames than the file holds."""
        there = len(self)
        return (f"truncated: its header states {stated} frames, the file holds {there}",) if there < stated else ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Do nothing: no file is open."""


class FlippedMovie(Movie):
    """Another movie with its rows, its columns or both reversed, or with rows as columns."""

    def __init__(self, movie: Movie, how: str) -> None:
        super().__init__(movie.path, movie.format, len(movie), flipped_shape(movie.frame_shape, how), movie.dtype)
        self.times_s, self.times_unit, self.played_hz = movie.times_s, movie.times_unit, movie.played_hz
        others = (remark for remark in movie.remarks if f"flip: {how}" not in remark)  # without the advice to flip
        self.remarks = (*others, f"flipped on reading: {how}")
        self.photographs, self.full_scale = movie.photographs, movie.full_scale
        self._movie, self._how = movie, how

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        return (flipped_picture(picture, self._how) for picture in self._movie._read(numbers))

    def _read_on(self, numbers: Sequence[int]) -> Iterator[Grey | None]:
        pictures = self._movie._read_on(numbers)
        return (None if picture is None else flipped_picture(picture, self._how) for picture in pictures)


def flipped(movie: Movie, how: str) -> Movie:
    """Return a movie flipped by `how`: none, vertical (rows reversed), horizontal (columns), both, or transpose (rows
    become columns, as in files written by MATLAB).
    """
    if how not in FLIPS:
        raise movie_error(f"{movie.path}, flip", ", ".join(FLIPS), f"'{how}'", "write one of these")
    return movie if how == "none" else FlippedMovie(movie, how)


def flipped_picture(picture: NDArray[Any], how: str) -> NDArray[Any]:
    """Flip a picture (..., H, W) as `flipped` flips a movie."""
    rows, columns = FLIPS[how]
    turned = picture.swapaxes(-1, -2) if how == "transpose" else picture
    return np.ascontiguousarray(turned[..., ::rows, ::columns])


def flipped_shape(frame_shape: tuple[int, int], how: str) -> tuple[int, int]:
    """Return the shape (H, W) of pictures flipped by `flipped_picture`."""
    return (frame_shape[1], frame_shape[0]) if how == "transpose" else frame_shape


def grey_shape(shape: Sequence[int]) -> tuple[int, int, int] | None:
    """Return (N, H, W) of an array of grey pictures, or of one with a further axis of 1; None for other arrays."""
    sizes = [int(size) for size in shape]
    if len(sizes) == 4 and sizes[1:].count(1) == 1:
        del sizes[sizes.index(1, 1)]
    return (sizes[0], sizes[1], sizes[2]) if len(sizes) == 3 and 0 not in sizes else None


def mapped(
    path: Path, numbers: Sequence[int], dtype: np.dtype[Any], offset: int, shape: tuple[int, ...]
) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield frame numbers with the array of a file mapped into memory; a new map every 64 frames bounds the memory."""
    for place, number in enumerate(numbers):
        if place % FRAMES_A_MAP == 0:
            values = np.memmap(path, dtype, "r", offset, shape)
        yield number, values


def movie_error(name: object, expected: str, got: str, do: str) -> MovieError:
    """Return the MovieError about a movie file, or a part of it."""
    return MovieError(refusal(str(name), expected=expected, got=got, do=do))
