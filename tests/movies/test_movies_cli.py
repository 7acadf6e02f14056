import cv2
import numpy as np
import pytest
from cine_writer import Cine, write_cine
from movie_examples import FRAMES, pictures
from movie_formats import LOSSLESS
from overlay_examples import command as run

from sphereorient.movies import open_movie
from sphereorient.movies.survey import survey


def faulty(tmp_path):
    """A movie of 30 frames whose stamps jump, with a black, a white and a repeated frame, cut off after 28."""
    frames = pictures(np.uint16) >> 4
    frames[4], frames[9], frames[20] = 0, 4095, frames[19]
    times_s = np.arange(FRAMES) / 600
    times_s[12:] += 0.1
    path = write_cine(tmp_path / "faulty.cine", Cine(frames, real_bits=12, stamps_s=times_s))
    path.write_bytes(path.read_bytes()[: -3000 - 37 * 51 * 2])
    return path, frames, times_s


def test_the_faults_of_frames_are_found(tmp_path):
    path, _, _ = faulty(tmp_path)
    seen = survey(open_movie(path), every=True)
    assert seen.faults == {"undecodable": (), "black": (4,), "saturated": (9,), "repeated": (20,)}
    assert (seen.looked, seen.lowest, seen.highest) == (28, 0, 4095)
    folder = LOSSLESS["png"](tmp_path, pictures())
    (folder / "cam1_10.png").unlink()
    assert survey(open_movie(folder), every=True).faults["undecodable"] == (3,)


def test_a_spread_of_frames_covers_first_and_last_and_finds_repeats(tmp_path):
    frames = np.repeat(pictures()[:15], 2, axis=0)  # each frame twice
    np.save(tmp_path / "movie.npy", frames)
    seen = survey(open_movie(tmp_path / "movie.npy"), count=4)
    numbers = [frame.number for frame in seen.frames]
    assert (numbers[0], numbers[-1], len(numbers)) == (0, 29, 4)
    assert seen.faults["repeated"] == tuple(number for number in numbers if number % 2)


def test_movie_prints_what_is_in_a_file_and_draws_it(tmp_path, monkeypatch, capsys):
    path, _, _ = faulty(tmp_path)
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(monkeypatch, capsys, "movie", path, "--all", "--quiet")
    assert code == 0
    for words in (
        ".cine, 16 bit (12 of them used)",
        "51 x 37 px, 16 bit",
        "truncated: its header states 30 frames, the file holds 28",
        "not even: usually 600 Hz, 1 of 27 steps differ",
        "after frame 11",
        "black         1 frame: 4",
        "saturated     1 frame: 9",
        "repeated      1 frame: 20",
        "undecodable   none",
    ):
        assert words in " ".join(out.split(" ")).replace("\n" + " " * 14, " "), words
    assert cv2.imread(str(tmp_path / "faulty.cine.contact.png")).std() > 10


@pytest.mark.parametrize("suffix", ["mkv", "h5"])
def test_convert_keeps_grey_values_and_times(tmp_path, monkeypatch, capsys, suffix):
    path, frames, times_s = faulty(tmp_path)
    target = tmp_path / f"out.{suffix}"
    code, out, err = run(monkeypatch, capsys, "convert", path, target, "--frames", "3:20", "--flip", "vertical")
    assert code == 0
    assert "convert: 1 of 17" in err  # progress
    assert "truncated" in out
    movie = open_movie(target)
    assert np.array_equal(movie.sample(range(len(movie))), frames[3:20, ::-1])
    if suffix == "h5":
        assert np.abs(movie.times_s - times_s[3:20]).max() < 1e-8
    else:
        table = np.loadtxt(tmp_path / "out.times.csv", skiprows=1)
        assert np.abs(table - times_s[3:20]).max() < 1e-8


@pytest.mark.parametrize("suffix", ["mkv", "h5"])
def test_convert_goes_on_after_frames_that_cannot_be_decoded(tmp_path, monkeypatch, capsys, suffix):
    folder = LOSSLESS["png"](tmp_path, pictures())
    (folder / "cam1_10.png").unlink()
    target = tmp_path / f"out.{suffix}"
    code, out, _ = run(monkeypatch, capsys, "convert", folder, target)
    assert code == 0
    assert "Not decodable" in out
    assert "1 frame, 3" in out
    read = list(open_movie(target).readable())
    assert len(read) == FRAMES
    assert all(np.array_equal(read[number], pictures()[number]) for number in range(FRAMES) if number != 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["movie.npy", "out.mp4"], r"expected .mkv .h5 .hdf5, got '.mp4'"),
        (["movie.npy", "movie.npy"], "got an input of the same command"),
        (["movie.npy", "movie.npy/out.mkv"], "expected a folder to write in"),
        (["movie.npy", "out.mkv", "--frames", "5:5"], "expected A:B within 0:30"),
        (["movie.npy", "out.mkv", "--frames", "5:99"], "expected A:B within 0:30"),
        (["movie.npy", "out.mkv", "--frames", "some"], "expected A:B within 0:30"),
        (["movie.npy", "out.mkv", "--flip", "up"], "expected none, vertical, horizontal, both, transpose, got 'up'"),
        (["none.npy", "out.mkv"], "got no such file"),
    ],
)
def test_convert_refuses_in_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    np.save(tmp_path / "movie.npy", pictures())
    monkeypatch.chdir(tmp_path)
    code, _, err = run(monkeypatch, capsys, "convert", *arguments, "--quiet")
    assert code == 2
    assert message in err
    assert len(err.strip().splitlines()) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["movie.npy"]
