import tracemalloc
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from movie_examples import FRAMES, pictures
from movie_formats import sequence

from sphereorient.errors import MovieError
from sphereorient.movies import open_movie


def refused(path: Path, message: str) -> None:
    with pytest.raises(MovieError, match=message) as error:
        open_movie(path)
    assert "\n" not in str(error.value)


def test_pictures_are_in_natural_order_and_a_missing_number_is_an_unreadable_frame(tmp_path):
    folder = sequence("png")(tmp_path, pictures())  # cam1_7 .. cam1_36
    for number in (9, 10, 20):
        (folder / f"cam1_{number}.png").unlink()
    movie = open_movie(folder)
    assert movie.remarks == ("3 pictures are missing: 9 .. 10, 20",)
    read = list(movie.readable())
    assert [number for number, frame in enumerate(read) if frame is None] == [2, 3, 13]
    assert all(frame is None or np.array_equal(frame, pictures()[number]) for number, frame in enumerate(read))
    with pytest.raises(MovieError, match="frame 13: "):
        movie.sample([13])


def test_pictures_numbered_in_steps_are_consecutive_frames(tmp_path):
    for number, frame in enumerate(pictures()[:5]):
        cv2.imwrite(str(tmp_path / f"t{100 * number:04d}ms.png"), frame)
    movie = open_movie(tmp_path)
    assert movie.remarks == ("numbered in steps of 100: taken as consecutive frames",)
    assert np.array_equal(movie.sample(range(5)), pictures()[:5])


def test_a_broken_picture_is_one_unreadable_frame(tmp_path):
    folder = sequence("png")(tmp_path, pictures())
    (folder / "cam1_7.png").write_bytes(b"")
    (folder / "cam1_8.png").write_bytes(b"no picture")
    cv2.imwrite(str(folder / "cam1_9.png"), np.zeros((4, 5), np.uint8))
    whole = (folder / "cam1_11.png").read_bytes()
    (folder / "cam1_11.png").write_bytes(whole[:40])
    movie = open_movie(folder)
    assert [number for number, frame in enumerate(movie.readable()) if frame is None] == [0, 1, 2, 4]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a_1.png", "b_1.png"], "a_1.png beside b_1.png"),
        (["run1_1.png", "run1_2.png", "run2_1.png"], "names alike but for one number"),
        (["1.png", "01.png"], "one picture of each number|names alike but for one number"),
        (["1.png", "2.tif"], "names alike but for a number"),
        (["1.png", "2.png", "900000000.png"], "pictures numbered by frame"),
        ([], "expected pictures .*, got none"),
    ],
)
def test_pictures_that_cannot_be_one_movie_are_refused(tmp_path, names, message):
    for name in names:
        cv2.imwrite(str(tmp_path / name), pictures()[0])
    refused(tmp_path, message)


def test_an_empty_pattern_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a_1.png"), pictures()[0])
    refused(tmp_path / "b_*.png", "expected pictures")
    refused(tmp_path / "none" / "b_*.png", "no such folder")


def test_other_files_beside_the_pictures_do_not_matter(tmp_path):
    folder = sequence("tif")(tmp_path, pictures())
    (folder / "notes.txt").write_text("light was low")
    (folder / ".cam1_3.tif").write_bytes(b"")
    assert len(open_movie(folder)) == FRAMES


@pytest.mark.parametrize(
    ("header", "suffix"),
    [
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\1\0\0\0\1\0\0\x10\0\0\0\0", "png"),
        (b"P5\n60000 60000\n255\nabc", "pgm"),
        (b"BM" + bytes(12) + b"\x28\0\0\0\0\0\1\0\0\0\1\0\1\0\x08\0" + bytes(24), "bmp"),
        (b"\xff\xd8\xff\xc0\0\x0b\x08\xff\xff\xff\xff\1\1\x11\0", "jpg"),
    ],
    ids=["png", "pgm", "bmp", "jpg"],
)
def test_a_picture_that_claims_to_be_huge_is_refused_by_its_header(tmp_path, header, suffix):
    (tmp_path / f"1.{suffix}").write_bytes(header)
    refused(tmp_path, "none that can be decoded")


def test_a_tiff_of_several_axes_or_other_numbers_is_refused(tmp_path):
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, np.zeros((3, 2, 20, 30), np.uint8), imagej=True)
    refused(path, "pictures along one axis, time")
    for dtype in (np.float32, np.int16, np.uint32):
        tifffile.imwrite(path, np.zeros((3, 20, 30), dtype), photometric="minisblack")
        refused(path, "grey or RGB pages of 8 or 16 bit")
    tifffile.imwrite(path, np.zeros((20, 30), np.uint8), extratags=[(274, 3, 1, 6, True)])
    refused(path, "not rotated by 90 degrees")


def test_a_page_of_another_size_is_one_unreadable_frame(tmp_path):
    with tifffile.TiffWriter(tmp_path / "movie.tif") as file:
        for number, frame in enumerate(pictures()[:6]):
            file.write(frame[: 20 if number == 3 else None], metadata=None)
    movie = open_movie(tmp_path / "movie.tif")
    assert [frame is None for frame in movie.readable()] == [False] * 3 + [True] + [False] * 2


@pytest.mark.parametrize("imagej", [True, False])
def test_a_cut_off_stack_gives_its_whole_frames(tmp_path, imagej):
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, pictures(), imagej=imagej)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    movie = open_movie(path)
    assert 10 < len(movie) < FRAMES
    assert movie.remarks == (f"truncated: its header states 30 frames, the file holds {len(movie)}",)
    assert np.array_equal(movie.sample(range(len(movie))), pictures()[: len(movie)])


@pytest.mark.parametrize("spare", [0, 1, 1886])
def test_a_cut_off_numpy_file_gives_its_whole_frames(tmp_path, spare):
    np.save(tmp_path / "movie.npy", pictures())
    content = (tmp_path / "movie.npy").read_bytes()
    (tmp_path / "movie.npy").write_bytes(content[: 128 + 12 * 37 * 51 + spare])
    movie = open_movie(tmp_path / "movie.npy")
    assert movie.remarks == ("truncated: its header states 30 frames, the file holds 12",)
    assert np.array_equal(np.stack(list(movie.frames())), pictures()[:12])


@pytest.mark.parametrize("name", ["time", "times", "timestamps"])
def test_times_beside_the_data_set_are_the_movies(tmp_path, name):
    times_s = np.cumsum(np.random.default_rng(2).uniform(0.001, 0.003, FRAMES))
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        file["run/movie"], file[f"run/{name}"] = pictures(), times_s
    movie = open_movie(tmp_path / "movie.h5")
    assert np.array_equal(movie.times_s, times_s)
    assert movie.remarks == ()


@pytest.mark.parametrize(
    ("times", "unit", "word"),
    [
        (np.arange(FRAMES - 1.0), None, "one number a frame"),
        (np.zeros(FRAMES), None, "increase"),
        (np.full(FRAMES, np.nan), None, "increase"),
        (np.arange(float(FRAMES)), "min", "in min"),
    ],
    ids=["length", "stand still", "nan", "unit"],
)
def test_times_that_are_none_are_reported_and_not_used(tmp_path, times, unit, word):
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        file["movie"], file["time"] = pictures(), times
        if unit:
            file["time"].attrs["units"] = unit
    movie = open_movie(tmp_path / "movie.h5")
    assert movie.times_s is None
    assert word in movie.remarks[0]


def test_hdf5_with_several_movies_is_refused_without_a_name(tmp_path):
    path = tmp_path / "movie.h5"
    with h5py.File(path, "w") as file:
        file["a/x"], file["b/x"], file["c"] = pictures(), pictures(), np.zeros(3)
    refused(path, "got a/x, b/x")
    refused(tmp_path / "movie.h5::a/y", "name one of: a/x, b/x")
    refused(tmp_path / "movie.h5::c", r"got \(3,\) of float64")
    refused(tmp_path / "movie.h5::a", "got a group")


def test_nothing_outside_the_hdf5_file_is_read(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["movie"] = pictures()
    (tmp_path / "raw.bin").write_bytes(pictures().tobytes())
    path = tmp_path / "movie.h5"
    with h5py.File(path, "w") as file:
        file["link"] = h5py.ExternalLink("other.h5", "/movie")
        file["soft"] = h5py.SoftLink("/link")
        file.create_dataset(
            "raw", (FRAMES, 37, 51), np.uint8, external=[(str(tmp_path / "raw.bin"), 0, h5py.h5f.UNLIMITED)]
        )
        layout = h5py.VirtualLayout((FRAMES, 37, 51), np.uint8)
        layout[:] = h5py.VirtualSource("other.h5", "movie", (FRAMES, 37, 51))
        file.create_virtual_dataset("virtual", layout)
    for name in ("link", "soft"):
        refused(tmp_path / f"movie.h5::{name}", f"a link, '{name}'")
    for name in ("raw", "virtual"):
        refused(tmp_path / f"movie.h5::{name}", "one that lies in other files")


@pytest.mark.parametrize("chunks", [None, (1, 20, 30)])
def test_a_claim_of_a_billion_frames_allocates_nothing(tmp_path, chunks):
    path = tmp_path / "movie.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("movie", (10**9, 20, 30), np.uint8, chunks=chunks)
        if chunks:
            file["movie"][2] = 7
    tracemalloc.start()
    if chunks is None:
        refused(path, "1000000000 of which none was written")
    else:
        movie = open_movie(path)
        assert "states 1000000000 frames, the file holds 3" in movie.remarks[0]
        assert [frame is None for frame in movie.readable()] == [True, True, False]
    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()
