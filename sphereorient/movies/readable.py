"""Reading on after frames that cannot be decoded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from sphereorient.errors import MovieError
from sphereorient.movies.movie import Grey, Movie, check_range


@runtime_checkable
class Recovering(Protocol):
    """A movie that knows itself where decoding can go on after a damaged frame."""

    def readable(self, first: int = 0, last: int | None = None) -> Iterator[Grey | None]:
        """Yield frames first .. last - 1, None for those that cannot be decoded."""


def readable(movie: Movie, first: int = 0, last: int | None = None) -> Iterator[Grey | None]:
    """Yield frames first .. last - 1 in order like `movie.frames`, but None for those that cannot be decoded.

    Frames that are predicted from a damaged one are None as well, up to the next key frame. The cost is that of one
    reading, however many frames are damaged.

    Args:
        movie: any movie.
        first: number of the first frame.
        last: number of the last frame + 1; all if None.

    Raises:
        MovieError: the range lies outside the movie.
    """
    last = check_range(movie.path, len(movie), first, last)
    return movie.readable(first, last) if isinstance(movie, Recovering) else _one_by_one(movie, first, last)


def _one_by_one(movie: Movie, first: int, last: int) -> Iterator[Grey | None]:
    """Begin anew after each damaged frame, which is cheap where every frame can be read alone."""
    number = first
    while number < last:
        try:
            for picture in movie.frames(number, last):
                yield picture
                number += 1
        except MovieError:
            yield None
            number += 1
