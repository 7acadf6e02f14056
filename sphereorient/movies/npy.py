"""Movies in one numpy array, mapped into memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.indexed import IndexedMovie, missing_remark
from sphereorient.movies.movie import Grey

# Frames read through one map of the file. Pages that were read stay in the process while it holds the map, and would
# add up to the whole movie: a new map for every few frames keeps memory flat.
FRAMES_A_MAP = 64
# What numpy raises on a header that is none: it reads it as a literal of Python, and old ones as its tokens.
DAMAGE = (OSError, ValueError, EOFError, TypeError, LookupError, SyntaxError, TokenError, RecursionError, MemoryError)
ZIP = b"PK"  # numpy's archives of several arrays, whatever their suffix


class NpyMovie(IndexedMovie):
    """A movie in a .npy file, (N, H, W), uint8 or uint16; frames are read from the disk when asked for."""

    def __init__(self, path: Path) -> None:
        shape, self._stored, self._offset = _header(path)
        if len(shape) != 3 or self._stored.kind != "u" or self._stored.itemsize > 2 or 0 in shape:
            expected, got = "an array (N, H, W) of uint8 or uint16, not empty", f"{shape} of {self._stored}"
            do = "save grey frames along the first axis"
            raise MovieError(refusal(str(path), expected=expected, got=got, do=do))
        frame_bytes = math.prod(shape[1:]) * self._stored.itemsize
        count = min(shape[0], (path.stat().st_size - self._offset) // frame_bytes)
        if count < 1:
            do = "write it again with numpy.save"
            raise MovieError(refusal(str(path), expected="at least one whole frame", got="a cut off file", do=do))
        super().__init__(
            path,
            "numpy array",
            count,
            (shape[1], shape[2]),
            self._stored.newbyteorder("="),
            remarks=missing_remark(shape[0], count),
        )

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        for start in range(0, len(numbers), FRAMES_A_MAP):
            frames: Grey = np.memmap(self.path, self._stored, "r", self._offset, (self._count, *self.frame_shape))
            for number in numbers[start : start + FRAMES_A_MAP]:
                yield np.array(frames[number], self.dtype)


def _header(path: Path) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """Return shape and type of the array, and where its values begin, without touching these."""
    do = "write it again with numpy.save"
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran_order, dtype = reader(file)
        except DAMAGE as error:
            file.seek(0)
            archive = file.read(2) == ZIP
            text = f"'{str(error)[:200].splitlines()[0]}'" if str(error) else type(error).__name__
            got = "an archive of arrays" if archive else text
            expected = "one .npy array" if archive else "a .npy array without objects"
            raise MovieError(refusal(str(path), expected=expected, got=got, do=do)) from error
        if fortran_order and len(shape) > 1:
            do = "save numpy.ascontiguousarray of it"
            raise MovieError(refusal(str(path), expected="an array (N, H, W), in rows", got="columns first", do=do))
        return tuple(int(size) for size in shape), dtype, file.tell()  # a header may say True
