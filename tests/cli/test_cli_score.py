"""`sphereorient score`: the errors of a track, and refusals in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import REPO
from typer.testing import CliRunner

from sphereorient.bench import score_track
from sphereorient.cli import app
from sphereorient.errors import TrackError
from sphereorient.trajectory import Tracks, Trajectory

TRUTH = REPO / "synthetic_data" / "excerpt" / "truth.h5"


@pytest.fixture
def track(tmp_path: Path) -> Path:
    """A track with a position error of 0.3 mm and a velocity that is 10 % too large."""
    with h5py.File(TRUTH) as file:
        truth = {key: file[key][()] for key in ("time", "position", "orientation", "velocity")}
    track = Trajectory.empty(truth["time"], cameras=("cam1", "cam2"), frame_rate=600.0, method="paper")
    shifted = truth["position"] + np.array([0.3, 0.0, 0.0])
    track = replace(track, orientation=truth["orientation"], position=shifted, velocity=1.1 * truth["velocity"])
    replace(track, valid=np.ones(len(track), bool)).save(tmp_path / "track.h5")
    return tmp_path / "track.h5"


def test_errors_over_stated_sigmas_are_printed_and_frames_without_them_left_out(track):
    loaded = Trajectory.load(track)
    place = np.tile(np.eye(3) * 0.1**2, (40, 1, 1))  # 0.3 mm along one of three axes
    place[5] = np.nan
    turn = np.tile(np.eye(3) * 0.01**2, (40, 1, 1))
    turn[7] = np.nan
    about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    orientation = loaded.orientation.copy()
    orientation[9] = about_z @ orientation[9]  # a quarter turn, out of its region
    replace(loaded, position_cov=place, orientation_cov=turn, orientation=orientation).save(track)
    found = score_track(Trajectory.load(track), TRUTH)
    of_turn, of_place = found.over_stated()
    assert of_place == pytest.approx(3 / np.sqrt(3))
    assert of_turn == pytest.approx(np.pi / 2 / 0.01 / np.sqrt(39 * 3), rel=1e-6)
    assert found.inside() == (38, 39)
    words = CliRunner().invoke(app, ["score", str(track), str(TRUTH)]).output.split()
    assert "1.73" in words
    assert "14.52" in words


def test_the_errors_of_a_track_are_printed(track):
    run = CliRunner().invoke(app, ["score", str(track), str(TRUTH)])
    assert run.exit_code == 0, run.exception
    words = run.output.split()
    assert "40 of 40" in run.output
    assert "0.3000" in words
    assert "10.00" in words
    assert all(name in words for name in ("acceleration", "omega_body", "alpha_lab", "alpha_body"))


def refused(*arguments: object) -> str:
    run = CliRunner().invoke(app, ["score", *map(str, arguments)])
    assert isinstance(run.exception, TrackError), (run.exception, run.output)
    assert "\n" not in str(run.exception)
    return str(run.exception)


def test_files_of_another_kind_are_refused_in_one_line(track, tmp_path):
    (tmp_path / "text.h5").write_text("no track")
    assert "text.h5" in refused(tmp_path / "text.h5", TRUTH)
    assert "text.h5" in refused(track, tmp_path / "text.h5")
    assert "none.h5" in refused(tmp_path / "none.h5", TRUTH)
    assert "none.h5" in refused(track, tmp_path / "none.h5")
    assert "truth.h5" in refused(TRUTH, track)  # swapped
    assert "got a track" in refused(track, track)


def swarm(folder: Path) -> tuple[Path, Path]:
    """Two balls that look alike, and tracks that have exchanged names, but not in frame 30; a truth without rates."""
    with h5py.File(TRUTH) as file, h5py.File(folder / "truth.h5", "w") as out:
        true = {key: file[key][()] for key in ("time", "position", "orientation")}
        for name, shift in (("a", 0.0), ("b", 40.0)):
            group = out.create_group(f"spheres/{name}")
            for key, values in true.items():
                group[key] = values + shift * (key == "position")
    empty = Trajectory.empty(true["time"], cameras=("cam1",), frame_rate=600.0, method="precise")
    track = replace(empty, orientation=true["orientation"], valid=np.ones(len(empty), bool))
    shifted = true["position"] + 40.0
    shifted[30] -= 40.0
    there = {"a": replace(track, position=shifted), "b": replace(track, position=true["position"])}
    Tracks(there).save(folder / "tracks.h5")
    return folder / "tracks.h5", folder / "truth.h5"


def test_several_balls_are_scored_by_name_and_alike_ones_may_be_exchanged(tmp_path):
    tracks, truth = swarm(tmp_path)
    run = CliRunner().invoke(app, ["score", str(tracks), str(truth)])
    assert "ball a: 39 frames given to another ball, 2 exchanges" in run.output
    run = CliRunner().invoke(app, ["score", str(tracks), str(truth), "--alike", "a,b"])
    assert run.exit_code == 0, run.exception
    assert "Errors of ball a against the exact truth, 40 of 40" in run.output
    assert "ball a: 0 frames given to another ball, 0 exchanges" in run.output
    assert "ball b: 1 frames given to another ball, 2 exchanges" in run.output
    alone = CliRunner().invoke(app, ["score", str(tracks), str(truth), "--alike", "a,b", "--sphere", "b"])
    assert "ball a" not in alone.output
    assert "expected a, b, got 'c'" in refused(tracks, truth, "--alike", "a,c")
    assert "expected the truth of one ball, got that of a, b" in refused_of_one(tmp_path, truth)


def refused_of_one(folder: Path, truth: Path) -> str:
    replace(Tracks.load(folder / "tracks.h5")["a"], sphere="").save(folder / "one.h5")
    return refused(folder / "one.h5", truth)
