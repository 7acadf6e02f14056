"""Units of times, and rates that no camera has."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from sphereorient.errors import ExperimentError, MovieError
from sphereorient.experiment.experiment import load_experiment, open_movies
from sphereorient.experiment.recording import given_mask, given_scene
from sphereorient.experiment.timeline import Timeline, load_times, timeline
from sphereorient.files.picture import write_picture
from sphereorient.movies import open_movie, write_movie

CAMERAS = """schema: sphereorient-cameras/1
cameras:
  cam1: {model: pinhole, image_size: [48, 32], f_px: 60.0, centre: [23.5, 15.5], R: [[1, 0, 0], [0, 1, 0],
    [0, 0, 1]], T: [0, 0, 100]}
"""
FRAMES = 6
GREY = np.random.default_rng(3).integers(0, 255, (FRAMES, 32, 48), np.uint8)


def experiment(folder: Path, rest: str, movie: str = "m.h5") -> Path:
    (folder / "cameras.yaml").write_text(CAMERAS)
    path = folder / "experiment.yaml"
    path.write_text(
        f"schema: sphereorient-experiment/1\nsphere: {{diameter: null}}\ncameras: cameras.yaml\n"
        f"movies: {{cam1: {movie}}}\n{rest}\n"
    )
    return path


def line(folder: Path, rest: str, movie: str = "m.h5") -> Timeline:
    loaded = load_experiment(experiment(folder, rest, movie))
    return timeline(loaded, open_movies(loaded))


def stamped(folder: Path, stamps: np.ndarray, unit: object = None) -> None:
    with h5py.File(folder / "m.h5", "w") as file:
        file["frames"], file["timestamps"] = GREY, stamps
        if unit is not None:
            file["timestamps"].attrs["units"] = unit


UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


@pytest.mark.parametrize(
    ("words", "unit"),
    [
        ("s", "s"),
        ("Seconds", "s"),
        ("ms", "ms"),
        ("milliseconds", "ms"),
        ("msec", "ms"),
        ("us", "us"),
        ("\u00b5s", "us"),
        ("microsec", "us"),
        (np.bytes_(b"nanoseconds"), "ns"),
        ("ns since 1970", "ns"),
    ],
)
def test_the_unit_that_a_file_states_is_honoured(tmp_path, words, unit):
    stamped(tmp_path, np.arange(FRAMES) * UNITS[unit] / 50, words)
    frames = line(tmp_path, "times: movies\ntime_unit: s")  # of times whose file states none
    assert frames.time_s == pytest.approx(np.arange(FRAMES) / 50)
    assert frames.remarks == ()


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_stamps_that_are_hardly_in_s_are_refused_until_their_unit_is_written(tmp_path, unit):
    stamps = np.arange(FRAMES) * UNITS[unit] / 50
    stamped(tmp_path, stamps)
    with pytest.raises(ExperimentError, match=rf"{unit} \(50 Hz\).*time_unit"):
        line(tmp_path, "times: movies")
    frames = line(tmp_path, f"times: movies\ntime_unit: {unit}")
    assert frames.time_s == pytest.approx(np.arange(FRAMES) / 50)
    assert frames.remarks == ()
    np.savetxt(tmp_path / "times.csv", stamps)
    with pytest.raises(ExperimentError, match=rf"{unit} \(50 Hz\).*time_unit"):
        line(tmp_path, "times: times.csv")
    assert line(tmp_path, f"times: times.csv\ntime_unit: {unit}").time_s == pytest.approx(np.arange(FRAMES) / 50)


@pytest.mark.parametrize(
    ("heading", "unit"),
    [("time_ms", "ms"), ("t (\u00b5s)", "us"), ("frame times [ns]", "ns"), ("time_s", "s"), ("# ms", "ms")],
)
def test_a_heading_may_name_the_unit_of_a_table(tmp_path, heading, unit):
    rows = "".join(f"{time!r}\n" for time in (np.arange(FRAMES) * UNITS[unit] / 50).tolist())
    (tmp_path / "times.csv").write_text(f"{heading}\n{rows}", encoding="utf-8")
    assert load_times(tmp_path / "times.csv") == pytest.approx(np.arange(FRAMES) / 50)


def test_slow_and_fast_rates_are_questioned_and_used_where_they_are_written(tmp_path):
    stamped(tmp_path, np.arange(FRAMES) * 33.0)
    for keys in ("times: movies\ntime_unit: s", "frame_rate: 0.0303", "frame_rate: 200000"):
        frames = line(tmp_path, keys)
        assert any("outside 1 to 100,000 Hz" in remark for remark in frames.remarks)
    for keys in ("frame_rate: 1", "frame_rate: 100000"):
        assert line(tmp_path, keys).remarks == ()


def test_one_picture_has_no_rate_to_question(tmp_path):
    write_movie(tmp_path / "m.h5", GREY[:1])
    assert line(tmp_path, "frame_rate: 0.01").remarks == ()


def test_a_frame_rate_that_contradicts_the_movies_stamps_is_questioned(tmp_path):
    stamped(tmp_path, np.arange(FRAMES) / 600, "s")
    (remark,) = line(tmp_path, "frame_rate: 30").remarks
    assert "600 Hz" in remark
    assert line(tmp_path, "frame_rate: 600").remarks == ()


def test_a_table_of_another_length_than_the_movie_is_refused(tmp_path):
    stamped(tmp_path, np.arange(FRAMES) / 600, "s")
    np.savetxt(tmp_path / "times.csv", np.arange(FRAMES + 1) / 600)
    with pytest.raises(ExperimentError, match="6 times, got 7"):
        line(tmp_path, "times: times.csv")
    stamped(tmp_path, np.arange(FRAMES + 1) / 600, "s")
    assert any("for 6 frames" in remark for remark in open_movie(tmp_path / "m.h5").remarks)


def test_stamps_of_players_are_no_times_and_the_refusal_names_the_key(tmp_path):
    write_movie(tmp_path / "m.mkv", GREY, frame_rate_hz=40)
    with pytest.raises(MovieError, match="frame_rate: 40"):
        line(tmp_path, "times: movies", "m.mkv")
    write_movie(tmp_path / "m.mkv", GREY, np.arange(FRAMES) / 600, frame_rate_hz=40)
    with pytest.raises(MovieError, match=r"times: m\.times\.csv"):
        line(tmp_path, "times: movies", "m.mkv")


def test_a_transposed_movie_has_its_mask_and_background_transposed_too(tmp_path):
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file["frames"] = GREY.swapaxes(1, 2)
    scene, mask = GREY[0], np.where(GREY[1] > 99, 255, 0).astype(np.uint8)
    write_picture(tmp_path / "scene.png", scene.T)
    write_picture(tmp_path / "mask.png", mask.T)
    rest = "frame_rate: 30\nmasks: {cam1: mask.png}\nbackgrounds: {cam1: scene.png}"
    with pytest.raises(MovieError, match=r"flip: \{cam1: transpose\}"):
        line(tmp_path, rest)
    loaded = load_experiment(experiment(tmp_path, f"{rest}\nflip: {{cam1: transpose}}"))
    (movie,) = open_movies(loaded).values()
    assert np.array_equal(np.stack(list(movie.frames())), GREY)
    assert np.array_equal(given_scene(loaded, "cam1", movie.frame_shape), scene)
    assert np.array_equal(given_mask(loaded, "cam1", movie.frame_shape), mask > 127)
