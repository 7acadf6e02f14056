"""Files that people asked about in public: containers and units (../shared/cases, each with its README)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED

from sphereorient.cli import main
from sphereorient.errors import MovieError
from sphereorient.experiment.timeline import load_times
from sphereorient.movies import flipped, open_movie

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
    """The middle (u, v) of what differs from the border, px: the ball's."""
    picture = movie.sample([0])[0].astype(float)
    v, u = np.nonzero(abs(picture - np.median(picture[:3])) > level)
    return (u.min() + u.max()) / 2, (v.min() + v.max()) / 2


def test_a_movie_that_was_cut_without_encoding_is_whole():
    movie = open_movie(CASES / "edit_list" / "cut.mp4")
    assert len(movie) == len(list(movie.frames())) == 7
    assert not remarks(movie, "truncated")


def test_an_interlaced_movie_says_what_to_do():
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
    if name == "h5create.h5":  # nothing marks it: it says so
        assert remarks(movie, "flip: transpose")
        movie = flipped(movie, "transpose")
    assert movie.frame_shape == (160, 200)
    assert middle(movie) == pytest.approx((120, 70), abs=1.5)


@pytest.mark.parametrize("name", ["nhwc.h5", "nhwc.npy", "nchw.h5"])
def test_a_fourth_axis_of_one_channel_is_read(name):
    movie = open_movie(CASES / "hdf5_four_axes" / name)
    movie = flipped(movie, "transpose") if name == "nchw.h5" else movie  # (N, 1, W, H), which it says
    assert (len(movie), movie.frame_shape) == (24, (160, 200))
    assert middle(movie) == pytest.approx((120, 70), abs=1.5)


def test_a_file_of_labels_asks_for_the_movie():
    with pytest.raises(MovieError, match="labelled"):
        open_movie(CASES / "hdf5_four_axes" / "pkg.slp")


def test_the_rotation_tag_is_said():
    for name, turn in (("rot180.mp4", 180), ("rot90.mp4", 270)):
        assert remarks(open_movie(CASES / "rotation_tag" / name), f"{turn} degrees clockwise")


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_units_that_no_file_states_are_asked_for(tmp_path, monkeypatch, capsys, unit):
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
