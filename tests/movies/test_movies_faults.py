"""Every bad input is one MovieError of one line that names the file."""

from pathlib import Path

import av
import numpy as np
import pytest
from movie_examples import FRAMES, encode, pictures, smooth

from sphereorient.errors import MovieError
from sphereorient.movies import open_movie


def refused(path: Path, message: str) -> None:
    with pytest.raises(MovieError, match=message) as error:
        open_movie(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_folder_without_pictures_are_refused(tmp_path):
    refused(tmp_path / "none.mkv", "no such file")
    refused(tmp_path, "expected pictures .*, got none")


def test_an_unknown_suffix_is_refused_with_the_known_ones(tmp_path):
    (tmp_path / "movie.wmv").write_bytes(b"")
    refused(tmp_path / "movie.wmv", r"\.mkv \.avi \.mp4 .* a folder of pictures, got '.wmv'")


@pytest.mark.parametrize("suffix", [".mkv", ".avi", ".mp4", ".mov", ".npy", ".cine", ".tif", ".h5"])
@pytest.mark.parametrize("content", [b"", b"no movie at all" * 100], ids=["empty", "text"])
def test_files_that_are_no_movies_are_refused(tmp_path, suffix, content):
    path = tmp_path / f"movie{suffix}"
    path.write_bytes(content)
    refused(path, "expected a")


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((4, 5, 6)),
        np.zeros((4, 5, 6), np.int16),
        np.zeros((4, 5, 6), np.uint32),
        np.zeros((5, 6), np.uint8),
        np.zeros((4, 5, 6, 3), np.uint8),
        np.zeros((0, 5, 6), np.uint8),
        np.array([{"an": "object"}]),
    ],
    ids=str,
)
def test_arrays_that_are_no_movies_are_refused(tmp_path, array):
    np.save(tmp_path / "movie.npy", array)
    refused(tmp_path / "movie.npy", "expected (an|a .npy) array")


def test_an_archive_of_arrays_is_refused(tmp_path):
    np.savez(tmp_path / "movie.npz", np.zeros((4, 5, 6), np.uint8))
    (tmp_path / "movie.npz").rename(tmp_path / "movie.npy")
    refused(tmp_path / "movie.npy", "got an archive")


def test_sound_without_pictures_is_refused(tmp_path):
    path = tmp_path / "movie.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    refused(path, "no video stream")


@pytest.mark.parametrize("kind", ["mkv", "npy"])
def test_frames_that_the_movie_does_not_have_are_refused(tmp_path, kind):
    path = tmp_path / f"movie.{kind}"
    if kind == "npy":
        np.save(path, pictures())
    else:
        encode(path, pictures(), "ffv1", "gray")
    movie = open_movie(path)
    for ask in (
        lambda: movie.sample([0, FRAMES]),
        lambda: movie.sample([-1]),
        lambda: movie.frames(0, FRAMES + 1),
        lambda: movie.frames(-1),
        lambda: movie.frames(5, 4),
        lambda: movie.readable(0, FRAMES + 1),
    ):
        with pytest.raises(MovieError, match=f"expected frames within 0 .. {FRAMES}|within 0 .. {FRAMES - 1}"):
            ask()


def test_a_damaged_frame_is_named(tmp_path):
    # A raw frame of too few bytes at the end: what is left when the recording was cut off.
    path = encode(tmp_path / "movie.avi", pictures(), "rawvideo", "gray")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    movie = open_movie(path)
    last = len(movie) - 1
    assert 10 < last < FRAMES - 1
    with pytest.raises(MovieError, match=f"movie.avi, frame {last}: expected a decodable picture"):
        list(movie.frames())
    assert np.array_equal(np.stack(list(movie.frames(0, last))), pictures()[:last])
    with pytest.raises(MovieError, match=f"frame {last}"):
        movie.sample([2, last])


def test_a_movie_cut_off_in_matroska_gives_the_frames_that_are_left(tmp_path):
    path = encode(tmp_path / "movie.mkv", pictures(), "ffv1", "gray")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    movie = open_movie(path)
    assert 5 < len(movie) < FRAMES
    assert np.array_equal(np.stack(list(movie.frames())), pictures()[: len(movie)])


def test_a_stream_that_no_longer_decodes_is_a_movie_error(tmp_path):
    if "libx264" not in av.codecs_available:
        pytest.skip("this FFmpeg has no libx264")
    path = encode(tmp_path / "movie.mp4", smooth(), "libx264", "yuv420p", {"g": "5", "qp": "1"})
    content = bytearray(path.read_bytes())
    content[len(content) // 3 : len(content) // 3 + 2000] = bytes(2000)
    path.write_bytes(content)
    with pytest.raises(MovieError, match=r"movie.mp4, frame \d+"):
        list(open_movie(path).frames())
