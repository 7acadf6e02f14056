"""Movies in one numpy array, mapped into memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.movie import Grey, check_indices, check_range

# Frames read through one map of the file. Pages that were read stay in the process while it holds the map, and would
# add up to the whole movie: a new map for every few frames keeps memory flat.
FRAMES_A_MAP = 64


class NpyMovie:
    """A movie in a .npy file, (N, H, W), uint8 or uint16; frames are read from the disk when asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        array = self._map()
        if array.ndim != 3 or array.dtype.kind != "u" or array.dtype.itemsize > 2 or 0 in array.shape:
            expected, got = "an array (N, H, W) of uint8 or uint16, not empty", f"{array.shape} of {array.dtype}"
            do = "save grey frames along the first axis"
            raise MovieError(refusal(str(path), expected=expected, got=got, do=do))
        self._count = int(array.shape[0])
        self.frame_shape: tuple[int, int] = (int(array.shape[1]), int(array.shape[2]))
        self.dtype: np.dtype[Any] = array.dtype.newbyteorder("=")

    def _map(self) -> Grey:
        """Map the file into memory."""
        try:
            array = np.load(self.path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            got = f"'{str(error).splitlines()[0]}'" if str(error) else type(error).__name__
            do = "write it again with numpy.save"
            raise MovieError(
                refusal(str(self.path), expected="a .npy array without objects", got=got, do=do)
            ) from error
        if not isinstance(array, np.ndarray):  # numpy also opens archives, whatever their suffix
            array.close()
            do = "write one array with numpy.save"
            raise MovieError(refusal(str(self.path), expected="one .npy array", got="an archive of arrays", do=do))
        return array

    def __len__(self) -> int:
        """Return the number of frames."""
        return self._count

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, (H, W) each."""
        return self._read(range(first, check_range(self.path, len(self), first, last)))

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return any frames in the order asked for, (n, H, W)."""
        rows = check_indices(self.path, len(self), indices)
        pictures = np.empty((len(rows), *self.frame_shape), self.dtype)
        for place, picture in enumerate(self._read(rows)):
            pictures[place] = picture
        return pictures

    def _read(self, rows: Sequence[int]) -> Iterator[Grey]:
        for start in range(0, len(rows), FRAMES_A_MAP):
            array = self._map()
            for row in rows[start : start + FRAMES_A_MAP]:
                yield array[row].astype(self.dtype)

    def close(self) -> None:
        """Do nothing: no file is held open between reads."""

    def __enter__(self) -> Self:
        """Return the movie."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the movie."""
        self.close()
