"""False claims of headers; `tests/hostile` has movies cut off or with bytes changed anywhere."""

import tracemalloc
from itertools import islice
from pathlib import Path

import h5py
import numpy as np
import pytest
from cine_writer import Cine, write_cine
from movie_examples import pictures

from sphereorient.errors import MovieError
from sphereorient.movies import open_movie

MOST_BYTES = 64 << 20


def check(path: Path) -> None:
    """Read a movie as far as possible; a refusal must be one line that names it."""
    refusal = ""
    try:
        movie = open_movie(path)
        assert 0 < len(movie) <= 5000  # the claim of a file of 12 frames
        for frame in islice(movie.readable(), 40):
            assert frame is None or (frame.shape, frame.dtype) == (movie.frame_shape, movie.dtype)
        movie.sample([len(movie) - 1, 0])
    except MovieError as error:
        refusal = str(error)
    assert not refusal or (str(path) in refusal and "\n" not in refusal)


@pytest.mark.parametrize("field", range(2, 84, 2))
def test_no_field_of_a_cine_header_makes_it_allocate(tmp_path, field):
    path = write_cine(tmp_path / "movie.cine", Cine(pictures(np.uint8, (12, 37, 51))))
    content = bytearray(path.read_bytes())
    for value in (b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff", b"\0\0\0\x40", bytes(4)):
        path.write_bytes(content[:field] + value + content[field + 4 :])
        tracemalloc.start()
        check(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < MOST_BYTES


def test_a_movie_that_claims_far_more_than_was_written_is_refused(tmp_path):
    """Before: 350 kB of HDF5 were read as a movie of 4e13 pixels, a million frames of 40 Mpx, 9 of them written."""
    shape = (640, 625)
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        data = file.create_dataset("frames", (10**8, *shape), "u1", chunks=(1, *shape), compression="gzip")
        for k in (*range(8), 10**8 - 1):
            data[k] = 0
    with pytest.raises(MovieError, match="9 of 100000000"):
        open_movie(tmp_path / "movie.h5")
    with h5py.File(tmp_path / "large.h5", "w") as file:
        file.create_dataset("frames", (2, 10_000, 7_000), "u1", chunks=(1, 10_000, 7_000), compression="gzip")[1] = 0
    with pytest.raises(MovieError, match="70 million pixels"):
        open_movie(tmp_path / "large.h5")
