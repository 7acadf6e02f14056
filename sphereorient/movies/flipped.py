"""Movies of cameras that look through a mirror, or whose recorder stored the rows the other way round."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.movie import Grey, Movie
from sphereorient.movies.readable import readable

STEPS = {"none": (1, 1), "vertical": (-1, 1), "horizontal": (1, -1), "both": (-1, -1)}


def flipped_picture(picture: NDArray[Any], how: str) -> NDArray[Any]:
    """Turn a picture (..., H, W) as `flipped` turns a movie's."""
    rows, columns = STEPS[how]
    return np.ascontiguousarray(picture[..., ::rows, ::columns])


class FlippedMovie:
    """Another movie with its rows, its columns or both turned round; numbers, times and length are the other's."""

    def __init__(self, movie: Movie, how: str) -> None:
        self._movie = movie
        self._how = how

    @property
    def path(self) -> Path:
        """The file."""
        return self._movie.path

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns (H, W) of every frame."""
        return self._movie.frame_shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16."""
        return self._movie.dtype

    @property
    def format(self) -> str:
        """How the file holds the pictures, in words."""
        return self._movie.format

    @property
    def times_s(self) -> NDArray[np.float64] | None:
        """Time of each frame, (N,), s, or None: see Movie."""
        return self._movie.times_s

    @property
    def remarks(self) -> tuple[str, ...]:
        """The movie's own remarks, and that it is flipped."""
        return (*self._movie.remarks, f"flipped on reading: {self._how}")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._movie)

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, (H, W) each."""
        return map(self._turned, self._movie.frames(first, last))

    def readable(self, first: int = 0, last: int | None = None) -> Iterator[Grey | None]:
        """Yield frames first .. last - 1 in order, None for those that cannot be decoded."""
        for picture in readable(self._movie, first, last):
            yield None if picture is None else self._turned(picture)

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return any frames in the order asked for, (n, H, W)."""
        return self._turned(self._movie.sample(indices))

    def _turned(self, pictures: Grey) -> Grey:
        return flipped_picture(pictures, self._how)

    def close(self) -> None:
        """Let go of the file."""
        self._movie.close()

    def __enter__(self) -> Self:
        """Return the movie."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the movie."""
        self.close()


def flipped(movie: Movie, how: str) -> Movie:
    """Return a movie as a mirror shows it.

    Args:
        movie: any movie.
        how: none (the movie itself), vertical (rows turned round: top to bottom), horizontal (columns), both.

    Raises:
        MovieError: another word.
    """
    if how not in STEPS:
        do = "write one of these"
        raise MovieError(refusal(f"{movie.path}, flip", expected=", ".join(STEPS), got=f"'{how}'", do=do))
    return movie if how == "none" else FlippedMovie(movie, how)
