"""Files cut off or with bytes changed anywhere: frames, None or one MovieError, whatever the format."""

from __future__ import annotations

import tracemalloc
from itertools import islice
from pathlib import Path

import h5py
import numpy as np
import pytest
from cine_writer import Cine, write_cine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from movie_examples import pictures, smooth
from movie_formats import LOSSLESS, LOSSY, cine, video

from sphereorient.errors import MovieError
from sphereorient.movies import open_movie

SHAPE = (12, 37, 51)
PREDICTED = {"g": "5", "bf": "2", "qp": "2", "b_strategy": "0"}
FORMATS = {
    **{name: LOSSLESS[name] for name in ("cine", "cine, annotations", "cine, colour", "npy", "ffv1 mkv", "ffv1 avi")},
    **{name: LOSSLESS[name] for name in ("tiff", "tiff, zlib", "tiff, lzw", "tiff, imagej", "tiff, one page")},
    **{name: LOSSLESS[name] for name in ("hdf5", "hdf5, chunks", "hdf5, chunks of many", "png", "pgm", "tif pictures")},
    "cine, stamps": cine(stamps_s=np.arange(SHAPE[0]) / 600),
    "jpg": LOSSY["jpg"],
    "mp4": video("movie.mp4", "libx264", "yuv420p", **PREDICTED),
    "h264 avi": video("movie.avi", "libx264", "yuv420p", **PREDICTED),
    "mpeg4 avi": video("movie.avi", "mpeg4", "yuv420p"),
}
MOST_FRAMES = 5000  # a file of 12 frames may claim what it likes
MOST_BYTES = 64 << 20


class Victim:
    """A movie, and the file of it that is changed; not shown with its bytes where a test fails."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = sorted(path.iterdir())[3] if path.is_dir() else path
        self.content = self.file.read_bytes()


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, Victim]:
    known = {}
    for name, write in FORMATS.items():
        folder = tmp_path_factory.mktemp("hostile")
        coded = name in ("mp4", "h264 avi", "mpeg4 avi")
        path = write(folder, smooth((12, 38, 52)) if coded else pictures(np.uint8, SHAPE))
        known[name] = Victim(path)
    return known


def read(path: Path) -> None:
    """Read a movie as far as it goes."""
    with open_movie(path) as movie:
        count = len(movie)
        assert 0 < count <= MOST_FRAMES
        for frame in islice(movie.readable(), 40):
            assert frame is None or (frame.shape, frame.dtype) == (movie.frame_shape, movie.dtype)
        assert all(isinstance(remark, str) and "\n" not in remark for remark in movie.remarks)
        assert movie.times_s is None or (len(movie.times_s) == count and np.isfinite(movie.times_s).all())
        movie.sample([count - 1, 0])


def check(path: Path) -> None:
    """Read a movie; nothing but one line that names it may come instead."""
    refusal = None
    try:
        read(path)
    except MovieError as error:
        refusal = str(error)
    assert refusal is None or (str(path) in refusal and "\n" not in refusal)


# Headers lie at the beginning and at the end: half of the changes go there.
places = st.one_of(st.floats(0, 1), st.floats(0, 0.05), st.floats(0.95, 1))
bytes_changed = st.lists(st.tuples(places, st.integers(0, 255)), max_size=8)


def attack(written, name: str, cut: float, changed: list[tuple[float, int]]) -> None:
    victim = written[name]
    hostile = bytearray(victim.content[: round(cut * len(victim.content))])
    for place, value in changed:
        if hostile:
            hostile[int(place * (len(hostile) - 1))] = value
    victim.file.write_bytes(hostile)
    try:
        check(victim.path)
    finally:
        victim.file.write_bytes(victim.content)


def attacked(count: int):
    slow = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    return settings(max_examples=count, deadline=None, derandomize=True, database=None, suppress_health_check=slow)


cuts = st.one_of(st.just(1.0), st.floats(0, 1), st.floats(0.9, 1))


@pytest.mark.parametrize("name", FORMATS)
@attacked(15)
@given(cut=cuts, changed=bytes_changed)
def test_malformed_movies_are_answered(written, name, cut, changed):
    attack(written, name, cut, changed)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
@attacked(250)
@given(cut=cuts, changed=bytes_changed)
def test_thousands_of_malformed_movies_are_answered(written, name, cut, changed):
    attack(written, name, cut, changed)


@pytest.mark.parametrize("name", FORMATS)
def test_movies_cut_off_anywhere_are_answered(written, name):
    for part in np.linspace(0, 1, 25):
        attack(written, name, float(part), [])


@pytest.mark.parametrize("field", range(2, 84, 2))
def test_no_field_of_a_cine_header_makes_it_allocate(tmp_path, field):
    path = write_cine(tmp_path / "movie.cine", Cine(pictures(np.uint8, SHAPE)))
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
    with pytest.raises(MovieError, match="expected frames, got 9 among 100000000 that were never written"):
        open_movie(tmp_path / "movie.h5")
    with h5py.File(tmp_path / "large.h5", "w") as file:
        file.create_dataset("frames", (2, 10_000, 7_000), "u1", chunks=(1, 10_000, 7_000), compression="gzip")[1] = 0
    with pytest.raises(MovieError, match=r"expected at most 67\.1 million pixels a frame, got 70 million pixels"):
        open_movie(tmp_path / "large.h5")
