"""Movies in HDF5: one data set (N, H, W), and its times beside it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.indexed import IndexedMovie, missing_remark
from sphereorient.movies.movie import Grey

SEPARATOR = "::"  # between the file and the data set in it
TIMES = ("time", "times", "timestamps")
MAX_OBJECTS = 10_000  # looked through for the one data set
BLOCK_BYTES = 64 << 20  # read at once, of a data set whose chunks hold many frames
LARGEST_RATIO = 1200  # by which a picture of one grey value shrinks at most
# What h5py raises on damaged files, whatever the place where HDF5 notices.
DAMAGE = (OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError, AttributeError)


class Hdf5Movie(IndexedMovie):
    """A data set (N, H, W) of uint8 or uint16; frames of which nothing was ever written are unreadable."""

    def __init__(self, path: Path) -> None:
        self._file, name = split_path(path)
        with _opened(self._file) as file:
            try:
                data = _data_set(path, file, name)
                self._name = data.name
                shape = tuple(int(size) for size in data.shape)
                self._block, self._written = _storage(path, data, shape)
                count = max(self._written, default=-1) + 1 if self._written is not None else shape[0]
                times_s = _times(data, count, shape[0])
            except DAMAGE as error:
                raise _refuse(path, "an HDF5 file that is whole", words(error), "copy or record it again") from error
        if count < 1:
            raise _refuse(path, "at least one frame", "none", "record it again")
        dtype = data_type.newbyteorder("=")
        super().__init__(path, count, shape[1:], dtype, times_s, missing_remark(shape[0], count))
