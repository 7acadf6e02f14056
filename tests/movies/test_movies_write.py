"""Writing: movies come back with their numbers and times, or no file is left."""

import numpy as np
import pytest
from movie_examples import FRAMES, pictures

from sphereorient.errors import MovieError, OutputError
from sphereorient.experiment.timeline import load_times
from sphereorient.files.whole_file import writing
from sphereorient.movies import open_movie, write_movie


@pytest.mark.parametrize("suffix", ["mkv", "h5", "hdf5"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_is_written_comes_back(tmp_path, suffix, dtype):
    path = tmp_path / f"movie.{suffix}"
    assert write_movie(path, iter(pictures(dtype))) == FRAMES
    with open_movie(path) as movie:
        assert movie.remarks == ()
        assert np.array_equal(movie.sample(range(FRAMES)), pictures(dtype))
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", ["mkv", "h5"])
def test_frames_that_are_none_keep_their_numbers(tmp_path, suffix):
    path = tmp_path / f"movie.{suffix}"
    given = [None if number in (0, 1, 7) else frame for number, frame in enumerate(pictures())]
    assert write_movie(path, given) == FRAMES
    for frame, expected in zip(open_movie(path).readable(), given, strict=True):
        if expected is not None:
            assert np.array_equal(frame, expected)
        else:
            assert frame is None if suffix == "h5" else not frame.any()


def test_times_go_with_the_frames(tmp_path):
    times_s = np.cumsum(np.random.default_rng(1).uniform(0.1, 0.2, FRAMES)) - 1
    write_movie(tmp_path / "movie.h5", pictures(), times_s)
    assert np.array_equal(open_movie(tmp_path / "movie.h5").times_s, times_s)
    write_movie(tmp_path / "movie.mkv", pictures(), times_s)
    assert open_movie(tmp_path / "movie.mkv").times_s is None
    assert np.array_equal(load_times(tmp_path / "movie.times.csv"), times_s)


@pytest.mark.parametrize("suffix", ["mkv", "h5"])
def test_a_refused_movie_leaves_the_old_one_in_place(tmp_path, suffix):
    path = tmp_path / f"movie.{suffix}"
    path.write_bytes(b"the old one")

    def breaks():
        yield pictures()[0]
        raise MovieError("the movie that is read is damaged")

    for frames, message in (
        (breaks(), "is damaged"),
        ([], "expected frames to write, got none"),
        ([None, None], "frames to write, got .*none"),
        ([pictures()[0], pictures()[0][:3]], "frame 1: expected"),
        ([np.zeros((3, 4))], "frame 0: expected frames"),
        ([np.zeros((4, 5), np.uint8), np.zeros((4, 6), np.uint8)], "frame 1: expected"),
    ):
        with pytest.raises(MovieError, match=message), writing(force=True):
            write_movie(path, frames)
        assert path.read_bytes() == b"the old one"
        assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OutputError, match="Not a directory"):
        write_movie(path / path.name, pictures())
    with pytest.raises(MovieError, match=r"got '\.mp4'"):
        write_movie(tmp_path / "movie.mp4", pictures())


@pytest.mark.parametrize("suffix", ["mkv", "h5"])
def test_a_full_disk_is_one_line_and_the_old_movie_stays(tmp_path, suffix):
    """A limit on the size of files stands for a disk that fills up; a process of its own has it."""
    import subprocess
    import sys

    pytest.importorskip("resource")
    path = tmp_path / f"movie.{suffix}"
    path.write_bytes(b"the old one")
    code = (
        "import resource, signal, sys, numpy as np\n"
        "from sphereorient.errors import OutputError\n"
        "from sphereorient.files.whole_file import writing\n"
        "from sphereorient.movies import write_movie\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "noise = np.random.default_rng(0).integers(0, 256, (40, 200, 200), dtype=np.uint8)\n"
        "try:\n  with writing(force=True):\n    write_movie(sys.argv[1], noise)\n"
        "except OutputError as error:\n    print('refused:', error)\n"
    )
    run = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    assert run.stdout.startswith(f"refused: {path}: expected a file that can be written")
    assert len(run.stdout.splitlines()) == 1
    assert path.read_bytes() == b"the old one"
    assert list(tmp_path.iterdir()) == [path]


def test_a_movie_of_a_fast_camera_has_its_rate(tmp_path):
    path, rate_hz = tmp_path / "movie.mkv", 2998.123457
    assert write_movie(path, pictures(), frame_rate_hz=rate_hz) == FRAMES
    with open_movie(path) as movie:
        assert np.array_equal(movie.sample(range(FRAMES)), pictures())
        assert movie.played_hz == pytest.approx(rate_hz, rel=1e-4)
