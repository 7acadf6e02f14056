"""Files from public questions: containers and units (../shared/cases, each with its README)."""

import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED

from sphereorient.cli import main
from sphereorient.errors import MovieError
from sphereorient.experiment.timeline import load_times
from sphereorient.movies import flipped, open_movie, write_movie
from sphereorient.trajectory import Trajectory

CASES = SHARED / "cases"
pytestmark = pytest.mark.shared


def run(monkeypatch, capsys, *arguments: str) -> tuple[object, str, str]:
    monkeypatch.setattr("sys.argv", ["sphereorient", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code, *capsys.readouterr()


def remarks(movie, word: str) -> list[str]:
    return [remark for remark in movie.remarks if word in remark]


def middle(movie, level: int = 60) -> tuple[float, float]:
    """The middle (u, v), px, of the pixels that differ from the border: the ball's."""
    picture = movie.sample([0])[0].astype(float)
    v, u = np.nonzero(abs(picture - np.median(picture[:3])) > level)
    return (u.min() + u.max()) / 2, (v.min() + v.max()) / 2


def test_a_movie_that_was_cut_without_encoding_is_whole():
    movie = open_movie(CASES / "edit_list" / "cut.mp4")
    assert len(movie) == len(list(movie.frames())) == 7
    assert not remarks(movie, "truncated")


def test_an_interlaced_movie_gets_a_remark_with_advice():
    assert remarks(open_movie(CASES / "interlaced" / "interlaced.mp4"), "interlaced")


@pytest.mark.parametrize(("name", "tick_s"), [("vfr.mkv", 1e-3), ("vfr.mp4", 1 / 90_000)])
def test_a_phones_time_stamps_are_its_times(name, tick_s):
    movie = open_movie(CASES / "variable_rate" / name)
    stamps_ms = [float(word) for word in (CASES / "variable_rate" / "stamps.txt").read_text().split()]
    assert movie.times_s == pytest.approx(np.array(stamps_ms) / 1e3, abs=tick_s)
    assert remarks(movie, "not even")
    assert not remarks(movie, "truncated")


@pytest.mark.parametrize("name", ["matlab73.h5", "matlab73.mat", "h5create.h5"])
def test_matlabs_pictures_are_upright(name):
    movie = open_movie(CASES / "matlab_hdf5" / name)
    if name == "h5create.h5":  # without a mark: remarked
        assert remarks(movie, "flip: transpose")
        movie = flipped(movie, "transpose")
    assert movie.frame_shape == (160, 200)
    assert middle(movie) == pytest.approx((120, 70), abs=1.5)


@pytest.mark.parametrize("name", ["nhwc.h5", "nhwc.npy", "nchw.h5"])
def test_a_fourth_axis_of_one_channel_is_read(name):
    movie = open_movie(CASES / "hdf5_four_axes" / name)
    movie = flipped(movie, "transpose") if name == "nchw.h5" else movie  # (N, 1, W, H), as marked
    assert (len(movie), movie.frame_shape) == (24, (160, 200))
    assert middle(movie) == pytest.approx((120, 70), abs=1.5)


def test_a_file_of_labels_is_refused_with_a_hint_to_the_movie():
    with pytest.raises(MovieError, match="labelled"):
        open_movie(CASES / "hdf5_four_axes" / "pkg.slp")


def test_the_rotation_tag_is_remarked_upon():
    for name, turn in (("rot180.mp4", 180), ("rot90.mp4", 270)):
        assert remarks(open_movie(CASES / "rotation_tag" / name), f"{turn} degrees clockwise")


@pytest.mark.slow  # tests/experiment/test_time_units.py shows the units
@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_units_that_no_file_states_are_refused(tmp_path, monkeypatch, capsys, unit):
    for name in (f"{unit}.h5", "texture.png"):
        (tmp_path / name).symlink_to(CASES / "time_units" / name)
    monkeypatch.chdir(tmp_path)
    known = ["--vfov", "30", "--set", "sphere.diameter=null"]
    assert run(monkeypatch, capsys, "init", f"{unit}.h5", *known)[0] == 0
    text = Path("experiment.yaml").read_text()
    assert f"{unit} (30" in text
    code, _, err = run(monkeypatch, capsys, "track", "experiment.yaml", "--out", "track.h5", "--quiet")
    assert code == 2
    assert "time_unit" in err
    Path("experiment.yaml").unlink()
    assert run(monkeypatch, capsys, "init", f"{unit}.h5", *known, "--set", f"time_unit={unit}")[0] == 0
    _, out, _ = run(monkeypatch, capsys, "check", "experiment.yaml")
    assert re.search(r"s, 30(\.000\d*)? Hz", " ".join(out.split()))


def test_a_table_in_ns_is_in_ns():
    assert np.diff(load_times(CASES / "time_units" / "times_ns.csv", "ns")) == pytest.approx(1 / 30, rel=1e-6)


def test_convert_keeps_a_phones_time_stamps_beside_the_movie(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(monkeypatch, capsys, "convert", str(CASES / "variable_rate" / "vfr.mp4"), "out.mkv")
    assert code == 0
    assert "out.times.csv" in out
    times_s = open_movie(CASES / "variable_rate" / "vfr.mp4").times_s
    assert load_times(tmp_path / "out.times.csv") == pytest.approx(times_s, abs=1e-12)


def test_convert_leaves_out_times_of_unknown_unit(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(monkeypatch, capsys, "convert", str(CASES / "time_units" / "ms.h5"), "out.h5")
    assert code == 0
    assert "times are left out" in out
    assert open_movie("out.h5").times_s is None


@pytest.mark.slow
def test_a_ball_that_turns_evenly_does_so_across_a_phones_pause(tmp_path, monkeypatch, capsys):
    shutil.copy(CASES / "variable_rate" / "vfr.mp4", tmp_path / "m.mp4")
    shutil.copy(CASES / "time_units" / "texture.png", tmp_path)
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(monkeypatch, capsys, "init", "m.mp4", "--vfov", "30", "--set", "sphere.diameter=null")
    assert code == 0
    assert "not even" in out
    assert run(monkeypatch, capsys, "track", "experiment.yaml", "--out", "track.h5", "--quiet")[0] == 0
    track = Trajectory.load("track.h5")
    speed = np.linalg.norm(track.omega_lab, axis=1)
    assert np.nanmedian(speed) == pytest.approx(math.pi, rel=0.25)
    assert np.nanmax(speed) < 2 * math.pi  # 13 times as fast across the pause at a constant rate


@pytest.mark.slow
def test_a_transposed_movie_is_followed_live_and_recorded_as_it_is_filmed(tmp_path, monkeypatch, capsys):
    shutil.copy(CASES / "matlab_hdf5" / "h5create.h5", tmp_path / "m.h5")
    shutil.copy(CASES / "time_units" / "texture.png", tmp_path)
    monkeypatch.chdir(tmp_path)
    write_movie("upright.h5", flipped(open_movie("m.h5"), "transpose").frames())
    keys = ["--vfov", "30", "--set", "sphere.diameter=null", "--set", "frame_rate=30"]
    assert run(monkeypatch, capsys, "init", "upright.h5", *keys)[0] == 0
    text = Path("experiment.yaml").read_text()
    Path("experiment.yaml").write_text(text.replace("{cam1: upright.h5}", "{cam1: m.h5}\nflip: {cam1: transpose}"))
    live = ["--source", "movie-fast", "--to", "poses.jsonl", "--record", "record.h5"]
    code, out, err = run(monkeypatch, capsys, "live", "experiment.yaml", *live)
    assert code == 0
    assert "0 without a pose" in out + err
    assert np.array_equal(open_movie("record.h5").sample(range(24)), open_movie("m.h5").sample(range(24)))
