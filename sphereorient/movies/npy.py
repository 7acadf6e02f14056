"""Movies in one numpy array, mapped into memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.movie import Grey, check_indices, check_range


class NpyMovie:
    """A movie in a .npy file, (N, H, W), uint8 or uint16; frames are read from the disk when asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            got = f"'{str(error).splitlines()[0]}'" if str(error) else type(error).__name__
            do = "write it again with numpy.save"
            raise MovieError(refusal(str(path), expected="a .npy array without objects", got=got, do=do)) from error
        if not isinstance(self._array, np.ndarray):  # numpy also opens archives, whatever their suffix
            self._array.close()
            do = "write one array with numpy.save"
            raise MovieError(refusal(str(path), expected="one .npy array", got="an archive of arrays", do=do))
        self._check()

    def _check(self) -> None:
        array = self._array
        if array.ndim != 3 or array.dtype.kind != "u" or array.dtype.itemsize > 2 or 0 in array.shape:
            expected, got = "an array (N, H, W) of uint8 or uint16, not empty", f"{array.shape} of {array.dtype}"
            do = "save grey frames along the first axis"
            raise MovieError(refusal(str(self.path), expected=expected, got=got, do=do))

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns (H, W)."""
        return (self._array.shape[1], self._array.shape[2])

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16, in this machine's byte order."""
        dtype: np.dtype[Any] = self._array.dtype.newbyteorder("=")
        return dtype

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._array)

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, (H, W) each."""
        last = check_range(self.path, len(self), first, last)
        return (self._array[k].astype(self.dtype) for k in range(first, last))

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return any frames in the order asked for, (n, H, W)."""
        rows = np.array(check_indices(self.path, len(self), indices), dtype=np.intp)
        pictures: Grey = self._array[rows].astype(self.dtype)
        return pictures

    def close(self) -> None:
        """Let go of the map; the movie is empty afterwards."""
        self._array = self._array[:0].copy()

    def __enter__(self) -> Self:
        """Return the movie."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the movie."""
        self.close()
