"""Time of each frame, and the picture of each movie that shows it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from experiment_examples import BOTH, FULL, SHORT, make_folder, written
from hypothesis import given, settings
from hypothesis import strategies as st

from sphereorient.errors import ExperimentError, MovieError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.experiment.timeline import NONE, Timeline, paired_times, timeline

TABLE = BOTH.replace("frame_rate: 30", "times: times.csv") + "frames: [0, 12]\n"
STAMPED = BOTH.replace("frame_rate: 30", "times: movies").replace(".npy", ".h5")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_folder(tmp_path)


def line(folder: Path, text: str) -> Timeline:
    experiment = load_experiment(written(folder, text))
    return timeline(experiment, open_movies(experiment))


def save_stamped(path: Path, time_s: list[float]) -> None:
    """A movie whose frames hold their own number, with stamps."""
    with h5py.File(path, "w") as file:
        file["frames"] = np.arange(len(time_s), dtype=np.uint8)[:, None, None] * np.ones((1, 6, 8), np.uint8)
        file["time"] = np.asarray(time_s)


def test_the_experiments_frame_0_is_frame_start_of_each_movie(folder):
    experiment = load_experiment(written(folder, FULL))
    movies = open_movies(experiment)
    frames = timeline(experiment, movies)
    assert frames.number.tolist() == list(range(2, 10))
    read = {name: movie.sample(frames.rows[name])[:, 0, 0].tolist() for name, movie in movies.items()}
    assert read == {"cam1": list(range(2, 10)), "cam2": list(range(5, 13))}
    assert not frames.remarks


def test_time_is_frame_number_over_frame_rate_and_does_not_restart_with_frames(folder):
    time_s = line(folder, FULL).time_s
    assert time_s.dtype == np.float64
    assert time_s.tolist() == [k / 600.0 for k in range(2, 10)]
    assert time_s[0] != 0  # not counted from the first frame that is used
    assert time_s[0] != 5 / 600.0  # nor by the second movie's own frames


def test_a_movie_that_ends_early_has_no_pictures_of_the_last_frames_and_a_remark(folder):
    frames = line(folder, BOTH)
    assert frames.rows["cam1"].tolist() == [*range(12), NONE, NONE, NONE]
    assert frames.rows["cam2"].tolist() == list(range(15))
    assert len(frames.remarks) == 1
    assert "cam1.npy: no pictures of frames 12 to 14" in frames.remarks[0]
    assert not line(folder, BOTH + "frames: [0, 12]\n").remarks  # all requested frames exist


def test_frames_beyond_all_movies_are_refused(folder):
    with pytest.raises(MovieError, match="expected 16 frames"):
        line(folder, BOTH + "frames: [0, 16]\n")


def test_a_start_beyond_the_movie_is_refused(folder):
    with pytest.raises(MovieError, match="frames after start"):
        line(folder, SHORT + "start: {cam1: 12}\n")


def test_a_table_of_times_is_taken_as_it_is(folder):
    times = np.cumsum([0.1, *np.linspace(0.01, 0.03, 14)])
    (folder / "times.csv").write_text("time (s)\n# uneven\n" + "\n".join(f"{t!r}," for t in times.tolist()))
    frames = line(folder, TABLE)
    assert frames.time_s.tolist() == times[:12].tolist()
    assert not frames.even


BAD_TABLES = {
    "nan": ("0\n0.1\nnan\n", "expected finite times, got nan"),
    "infinite": ("0\n0.1\ninf\n", "expected finite times, got inf"),
    "standing": ("0\n0.1\n0.1\n", "expected times that increase, got 0.1 after 0.1"),
    "back": ("0\n0.1\n0.05\n", "got 0.05 after 0.1"),
    "words": ("0\n0.1\nzwei\n", "line 3: expected a number, got 'zwei'"),
    "two columns": ("0 1\n0.1 2\n", "expected"),
    "short": ("0\n0.1\n0.2\n", "expected 15 times, got 3"),
    "empty": ("", "expected finite times, got none"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_a_table_that_is_none_is_refused(folder, name):
    text, message = BAD_TABLES[name]
    (folder / "times.csv").write_text(text)
    with pytest.raises(ExperimentError, match=message) as refused:
        line(folder, TABLE)
    assert "times.csv" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_stamps_pair_the_cameras_whichever_pictures_either_lost(folder):
    """cam1 lost picture 3, cam2 lost pictures 1 and 5, and is 0.2 ms late: stamps show it, counting would not."""
    grid = np.arange(8) * 0.01
    save_stamped(folder / "cam1.h5", np.delete(grid, 3).tolist())
    save_stamped(folder / "films" / "cam2.h5", (np.delete(grid, [1, 5]) + 0.0002).tolist())
    frames = line(folder, STAMPED)
    assert frames.rows["cam1"].tolist() == [0, 1, 2, NONE, 3, 4, 5, 6]
    assert frames.rows["cam2"].tolist() == [0, NONE, 1, 2, 3, NONE, 4, 5]
    np.testing.assert_allclose(frames.time_s[0], 0.0001)
    np.testing.assert_allclose(frames.time_s[3], 0.0302)  # of the camera that has it
    assert [remark.split(": ")[1] for remark in frames.remarks] == [
        "1 of 8 instants have no picture",
        "2 of 8 instants have no picture",
    ]


def test_with_start_each_cameras_clock_begins_at_that_picture(folder):
    grid = np.arange(8) * 0.01
    save_stamped(folder / "cam1.h5", (grid + 5.0).tolist())
    save_stamped(folder / "films" / "cam2.h5", (grid - 3.0).tolist())
    frames = line(folder, STAMPED + "start: {cam1: 2, cam2: 1}\n")
    assert frames.rows["cam1"].tolist() == [2, 3, 4, 5, 6, 7, NONE]
    assert frames.rows["cam2"].tolist() == [1, 2, 3, 4, 5, 6, 7]
    np.testing.assert_allclose(frames.time_s, 0.01 * np.arange(7), atol=1e-12)


def test_cameras_that_are_late_on_each_other_are_reported(folder):
    grid = np.arange(8) * 0.01
    save_stamped(folder / "cam1.h5", grid.tolist())
    save_stamped(folder / "films" / "cam2.h5", (grid + 0.002).tolist())
    assert "differ by 0.002 s" in line(folder, STAMPED).remarks[0]


def test_a_movie_without_stamps_is_refused_where_the_experiment_uses_them(folder):
    with pytest.raises(MovieError, match="time stamps, got none"):
        line(folder, BOTH.replace("frame_rate: 30", "times: movies"))


@settings(deadline=None)
@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=20, unique=True),
    st.lists(st.integers(0, 60), min_size=1, max_size=20, unique=True),
)
def test_pairs_are_those_that_counting_on_a_grid_gives(one, other):
    one, other = sorted(one), sorted(other)
    pairs = paired_times(np.array(one) + 0.2, np.array(other, float), 0.5)
    instants = sorted({*one, *other})
    expected = [[one.index(k) if k in one else NONE, other.index(k) if k in other else NONE] for k in instants]
    assert pairs.tolist() == expected


@settings(deadline=None)
@given(st.lists(st.integers(1, 3), min_size=1, max_size=30), st.integers(1, 3))
def test_dropped_frames_are_put_into_the_grid_and_found_again(steps, usual):
    place = np.concatenate([[0], np.cumsum([usual] * (len(steps) + 1) + [usual * step for step in steps])])
    frames = Timeline(number=np.arange(len(place)), time_s=0.3 + 0.01 * place, rows={"cam1": 7 + np.arange(len(place))})
    grid, at = frames.gridded()
    assert at.tolist() == (place / usual).tolist()
    assert grid.even
    np.testing.assert_allclose(grid.time_s[at], frames.time_s)
    assert grid.rows["cam1"][at].tolist() == frames.rows["cam1"].tolist()
    assert (np.delete(grid.rows["cam1"], at) == NONE).all()


def test_times_off_any_grid_are_refused_for_methods_that_need_one():
    time_s = np.array([0.0, 0.01, 0.024, 0.03, 0.04])
    with pytest.raises(ExperimentError, match="even grid"):
        Timeline(number=np.arange(5), time_s=time_s, rows={}).gridded()


def test_stamps_of_three_cameras_make_one_frame_whichever_pictures_each_lost(folder):
    grid = np.arange(6) * 0.01
    save_stamped(folder / "cam1.h5", np.delete(grid, 1).tolist())
    save_stamped(folder / "films" / "cam2.h5", (np.delete(grid, [1, 3]) + 0.0002).tolist())
    save_stamped(folder / "cam3.h5", (np.delete(grid, 4) + 0.0004).tolist())
    cameras = (folder / "cameras.yaml").read_text()
    own = cameras.split("cam2:")[1].split("\n\n")[0]
    (folder / "cameras.yaml").write_text(cameras + f"  cam3:{own}")
    frames = line(folder, STAMPED.replace("cam2:", "cam3: cam3.h5, cam2:"))
    assert frames.rows["cam1"].tolist() == [0, NONE, 1, 2, 3, 4]
    assert frames.rows["cam2"].tolist() == [0, NONE, 1, NONE, 2, 3]
    assert frames.rows["cam3"].tolist() == [0, 1, 2, 3, NONE, 4]
    np.testing.assert_allclose(frames.time_s, grid + np.array([2, 4, 2, 2, 1, 2]) * 1e-4, atol=1e-9)


def test_an_exposure_longer_than_a_frame_is_refused_with_times_too(folder):
    """Before: by a frame rate only; 0.4 s for 0.4 ms moved the poses of the track by half of it."""
    (folder / "times.csv").write_text("\n".join(f"{k / 600!r}" for k in range(15)))
    with pytest.raises(ExperimentError, match=r"exposure: expected at most .*0\.001667 s, got 0\.4") as refused:
        line(folder, TABLE + "exposure: 0.4\n")
    assert "\n" not in str(refused.value)
    assert len(line(folder, TABLE + "exposure: 0.0004\n")) == 12
    # A camera of half the rate may expose for two frames of the other one.
    save_stamped(folder / "cam1.h5", [0.02 * k for k in range(10)])
    save_stamped(folder / "films" / "cam2.h5", [0.04 * k for k in range(5)])
    assert len(line(folder, STAMPED + "exposure: 0.03\n")) == 10
    with pytest.raises(ExperimentError, match=r"0\.04 s, got 0\.05"):
        line(folder, STAMPED + "exposure: 0.05\n")
