"""The one interface to movies, whatever the format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal

Grey = NDArray[Any]  # (H, W) or (n, H, W), uint8 or uint16, row 0 on top


class Movie(Protocol):
    """A sequence of grey pictures, with the times of the frames where the file holds exact ones."""

    @property
    def path(self) -> Path:
        """The file."""

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns (H, W) of every frame."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8, or uint16 where the file holds more than 8 bits; values are those of the file, not rescaled."""

    @property
    def format(self) -> str:
        """How the file holds the pictures, in words: container or kind of file, codec, bits."""

    @property
    def times_s(self) -> NDArray[np.float64] | None:
        """Time of each frame by the file's own stamps, (N,), s; None where it has none or rounds them (MKV, AVI)."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a user should know: that the file is cut off, that colour was made grey, that its codec loses."""

    def __len__(self) -> int:
        """Return the number of frames."""

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, (H, W) each, the caller's own.

        Raises:
            MovieError: the range lies outside the movie, or a frame cannot be decoded.
        """

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return any frames in the order asked for, (n, H, W).

        Raises:
            MovieError: an index lies outside the movie, or a frame cannot be decoded.
        """

    def close(self) -> None:
        """Let go of the file."""

    def __enter__(self) -> Self:
        """Return the movie."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the movie."""


class HoldsNothing:
    """What movies share that hold no file open between reads."""

    def close(self) -> None:
        """Do nothing: no file is held open."""

    def __enter__(self) -> Self:
        """Return the movie."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the movie."""
        self.close()


def check_range(path: Path, length: int, first: int, last: int | None) -> int:
    """Return the end of a range of frames, refusing one that leaves the movie.

    Raises:
        MovieError: not 0 <= first <= last <= length.
    """
    last = length if last is None else last
    if not 0 <= first <= last <= length:
        expected, got = f"frames within 0 .. {length}", f"{first} .. {last}"
        raise MovieError(refusal(str(path), expected=expected, got=got, do="ask for frames that the movie has"))
    return last


def check_indices(path: Path, length: int, indices: Sequence[int]) -> list[int]:
    """Return indices as plain whole numbers, refusing those that the movie does not have.

    Raises:
        MovieError: an index is negative or not below the length.
    """
    plain = [int(index) for index in indices]
    outside = [index for index in plain if not 0 <= index < length]
    if outside:
        expected, do = f"frames within 0 .. {length - 1}", "ask for frames that the movie has"
        raise MovieError(refusal(str(path), expected=expected, got=str(outside[0]), do=do))
    return plain
