"""Movies each of whose frames can be read alone: what all such formats share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.movie import Grey, HoldsNothing, check_indices, check_range


class IndexedMovie(HoldsNothing, ABC):
    """A movie whose reader says how frames of given numbers are read, one by one; no file stays open between calls."""

    def __init__(
        self,
        path: Path,
        form: str,
        count: int,
        frame_shape: tuple[int, int],
        dtype: np.dtype[Any],
        times_s: NDArray[np.float64] | None = None,
        remarks: Sequence[str] = (),
    ) -> None:
        self.path = path
        self.format = form
        self.frame_shape = frame_shape
        self.dtype = dtype
        self.times_s = times_s
        self.remarks = tuple(remarks)
        self._count = count

    @abstractmethod
    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        """Yield the frames of these numbers in the order asked for, raising MovieError at one that is damaged."""

    def __len__(self) -> int:
        """Return the number of frames."""
        return self._count

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, (H, W) each."""
        return self._read(range(first, check_range(self.path, len(self), first, last)))

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return any frames in the order asked for, (n, H, W)."""
        numbers = check_indices(self.path, len(self), indices)
        pictures = np.empty((len(numbers), *self.frame_shape), self.dtype)
        for place, picture in enumerate(self._read(numbers)):
            pictures[place] = picture
        return pictures

    def _damage(self, number: int, got: str) -> MovieError:
        """Word the refusal of a frame that cannot be read."""
        do = "export the movie again, or leave the frame out with frames: in the experiment"
        return MovieError(refusal(f"{self.path}, frame {number}", expected="a readable picture", got=got, do=do))


def missing_remark(told: int, there: int) -> tuple[str, ...]:
    """Return the remark about a movie that is cut off, or none.

    Args:
        told: frames that its header tells of.
        there: frames that are whole in the file.
    """
    if there >= told:
        return ()
    return (f"truncated: its header tells of {told} frames, {there} are there",)
