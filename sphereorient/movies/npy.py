import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from sphereorient.errors import error_words
from sphereorient.movies.movie import Grey, Movie, grey_shape, mapped, movie_error

# numpy parses a header as a Python literal, an old one as its tokens.
DAMAGE = (OSError, ValueError, EOFError, TypeError, LookupError, SyntaxError, TokenError, RecursionError, MemoryError)
ZIP = b"PK"  # numpy's archives of several arrays, whatever their suffix
SAVE_AGAIN = "write it again with numpy.save"


class NpyMovie(Movie):
    """A .npy file, (N, H, W), uint8 or uint16, without a fourth axis of one channel."""

    def __init__(self, path: Path) -> None:
        shape, self._stored, self._offset = _header(path)
        sizes = grey_shape(shape)
        if sizes is None or self._stored.kind != "u" or self._stored.itemsize > 2:
            expected, got = "an array (N, H, W) of uint8 or uint16, not empty", f"{shape} of {self._stored}"
            raise movie_error(path, expected, got, "save grey frames along the first axis, one channel")
        frame_bytes = math.prod(sizes[1:]) * self._stored.itemsize
        count = min(sizes[0], (path.stat().st_size - self._offset) // frame_bytes)
        if count < 1:
            raise movie_error(path, "at least one whole frame", "a cut off file", SAVE_AGAIN)
        super().__init__(path, "numpy array", count, sizes[1:], self._stored.newbyteorder("="))
        self.remarks = self._truncated(sizes[0])

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        shape = (len(self), *self.frame_shape)
        for number, frames in mapped(self.path, numbers, self._stored, self._offset, shape):
            yield np.array(frames[number], self.dtype)


def _header(path: Path) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran_order, dtype = reader(file)
        except DAMAGE as error:
            file.seek(0)
            if file.read(2) == ZIP:
                raise movie_error(path, "one .npy array", "an archive of arrays", SAVE_AGAIN) from error
            raise movie_error(path, "a .npy array without objects", error_words(error), SAVE_AGAIN) from error
        if fortran_order and len(shape) > 1:
            raise movie_error(path, "an array (N, H, W), in rows", "columns first", "save np.ascontiguousarray of it")
        return tuple(int(size) for size in shape), dtype, file.tell()  # a header may say True
