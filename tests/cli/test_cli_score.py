"""`sphereorient score`: the errors of a track, its behaviour against any reference, and refusals in one line."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import REPO
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from sphereorient.bench import score_track
from sphereorient.cli import app
from sphereorient.errors import BenchError, TrackError
from sphereorient.report.export import fictrac_table
from sphereorient.trajectory import Tracks, Trajectory
from sphereorient.trajectory.walk import FicTracAxes

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


def test_a_constant_turn_of_the_body_axes_is_named_and_taken_off(track):
    """As with a learnt map: errors of 150 degrees, explained by one rotation."""
    loaded, turn = Trajectory.load(track), Rotation.from_rotvec([2.0, 1.5, -0.8]).as_matrix()
    with h5py.File(TRUTH) as file:
        rates = {key: file[key][()] for key in ("omega_lab", "omega_body", "alpha_body") if key in file}
    rates |= {key: rates[key] @ turn for key in ("omega_body", "alpha_body")}  # components in axes that are rotated
    off = Rotation.from_rotvec([0.01, 0.0, 0.0]).as_matrix() @ loaded.orientation @ turn
    off[3] = np.nan
    cov = np.tile(np.eye(3) * 0.01**2, (40, 1, 1))
    replace(loaded, orientation=off, orientation_cov=cov, **rates).save(track)
    plain, body = (CliRunner().invoke(app, ["score", str(track), str(TRUTH), *more])
                   for more in ((), ("--align", "body")))  # fmt: skip
    assert "--align body" in plain.stderr
    assert "--align body" not in body.stderr
    found = score_track(Trajectory.load(track), TRUTH, "body")
    assert found.percentiles_deg()[3] < 1.2  # 0.01 rad in the lab; the rotation takes some of it
    assert found.over_stated()[0] < 1.2
    assert found.relative_rms["omega_body"] == pytest.approx(0.0, abs=0.03)
    assert found.relative_rms["omega_lab"] == pytest.approx(0.0, abs=1e-9)
    assert score_track(Trajectory.load(track), TRUTH).percentiles_deg()[0] > 100


def test_a_right_track_gets_no_such_hint(track):
    assert "--align" not in CliRunner().invoke(app, ["score", str(track), str(TRUTH)]).stderr


def refused(*arguments: object, error: type[Exception] = TrackError) -> str:
    run = CliRunner().invoke(app, ["score", *map(str, arguments)])
    assert isinstance(run.exception, error), (run.exception, run.output)
    assert "\n" not in str(run.exception)
    return str(run.exception)


def test_files_of_another_kind_are_refused_in_one_line(track, tmp_path):
    (tmp_path / "text.h5").write_text("no track")
    assert "text.h5" in refused(tmp_path / "text.h5", TRUTH)
    assert "text.h5" in refused(track, tmp_path / "text.h5")
    assert "none.h5" in refused(tmp_path / "none.h5", TRUTH)
    assert "none.h5" in refused(track, tmp_path / "none.h5")
    assert "truth.h5" in refused(TRUTH, track)  # swapped
    assert "expected lines of numbers between commas" in refused(track, tmp_path / "none.dat", error=BenchError)
    later = Trajectory.load(track)
    replace(later, time=later.time + 100.0).save(tmp_path / "later.h5")
    assert "later.h5: expected frames of the track, got none of them" in refused(track, tmp_path / "later.h5")
    assert "--align: expected none, body or both" in refused(track, TRUTH, "--align", "frame", error=BenchError)


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


TURN = Rotation.from_euler("xyz", [0.3, -0.5, 0.8]).as_matrix()


@pytest.fixture
def on_a_ball(tmp_path: Path) -> Trajectory:
    """The track of a fixed ball, 200 frames, whose rotations about y are too small by 3 %; its truth and FicTrac's
    table, in other axes, beside it.
    """
    rng = np.random.default_rng(4)
    turns = 0.02 * rng.normal(size=(200, 3)) + np.array([0.0, 0.06, 0.0])
    small = turns * np.array([1.0, 0.97, 1.0])
    true, ours = (
        np.stack(list(accumulate(Rotation.from_rotvec(t).as_matrix(), lambda R, T: T @ R))) for t in (turns, small)
    )
    time = np.arange(200) / 100.0
    with h5py.File(tmp_path / "truth.h5", "w") as file:
        file["time"], file["orientation"], file["position"] = time, true, np.zeros((200, 3))
    rows = np.zeros((200, 25))
    rows[:, 0], rows[:, 22] = np.arange(200), np.arange(1, 201)
    rows[:, 8:11] = Rotation.from_matrix(TURN @ true @ true[0].T @ TURN.T).as_rotvec()
    np.savetxt(tmp_path / "theirs.dat", np.delete(rows, 50, axis=0), delimiter=", ")
    empty = Trajectory.empty(time, cameras=("cam1",), frame_rate=100.0, method="precise")
    cov = np.tile(0.01**2 * np.eye(3), (200, 1, 1))
    track = replace(empty, orientation=ours, orientation_cov=cov, orientation_smooth=ours, position_cov=cov)
    track = replace(track, position=np.zeros((200, 3)), valid=np.ones(200, bool))
    track.save(tmp_path / "track.h5")
    return track


def scored(*arguments: object) -> dict[str, Any]:
    run = CliRunner().invoke(app, ["score", *map(str, arguments), "--json"])
    assert run.exit_code == 0, run.exception
    (ball,) = json.loads(run.output)["balls"]
    return dict(ball)


def test_the_gain_against_truth_another_track_and_fictracs_table_is_that_of_the_track(on_a_ball, tmp_path):
    of_truth = scored(tmp_path / "track.h5", tmp_path / "truth.h5")
    assert of_truth["exact"]
    assert of_truth["gain"]["value"][:3] == pytest.approx([1.0, 0.97, 1.0], abs=1e-6)
    assert of_truth["gain_smooth"] == of_truth["gain"]
    of_fictrac = scored(tmp_path / "track.h5", tmp_path / "theirs.dat", "--align", "both")
    assert not of_fictrac["exact"]
    assert of_fictrac["pairs"] == 197  # frame 50 is not in it
    assert of_fictrac["gain"]["value"][:3] == pytest.approx([1.0, 0.97, 1.0], abs=2e-3)
    printed = CliRunner().invoke(app, ["score", str(tmp_path / "track.h5"), str(tmp_path / "theirs.dat")]).output
    assert "--align both" in printed
    moving = replace(on_a_ball, position=np.arange(600.0).reshape(200, 3))  # by its own positions only
    moving.save(tmp_path / "moving.h5")
    assert scored(tmp_path / "moving.h5", tmp_path / "truth.h5")["length_ratio"] == pytest.approx(0.97, abs=0.02)
    assert of_fictrac["apart_deg"] == pytest.approx(np.rad2deg(Rotation.from_matrix(TURN).magnitude()), abs=0.3)
    with h5py.File(tmp_path / "truth.h5") as file:
        replace(on_a_ball, orientation=file["orientation"][()]).save(tmp_path / "other.h5")
    reversed_ = scored(tmp_path / "other.h5", tmp_path / "track.h5")
    assert reversed_["gain"]["value"][1] == pytest.approx(1 / 0.97, abs=1e-6)


def test_the_table_that_is_exported_of_a_track_is_that_track(on_a_ball, tmp_path):
    """Its counter begins at 0, as FicTrac's. Before: it began at 1, and each frame was compared with the next one."""
    table = fictrac_table(on_a_ball, FicTracAxes.of_lab(TURN))
    np.savetxt(tmp_path / "own.dat", table, delimiter=", ")
    found = scored(tmp_path / "track.h5", tmp_path / "own.dat", "--align", "both")
    assert found["error_deg"]["largest"] < 0.01
    assert found["pairs"] == 199
    assert found["end_share"] < 1e-6


def test_a_table_whose_counter_begins_anew_is_cut_there(on_a_ball, tmp_path):
    rows = np.loadtxt(tmp_path / "theirs.dat", delimiter=",")
    turned = Rotation.from_rotvec(rows[100:, 8:11]) * Rotation.from_rotvec(rows[100, 8:11]).inv()
    rows[100:, 8:11], rows[100:, 22] = turned.as_rotvec(), np.arange(1, 100)
    np.savetxt(tmp_path / "theirs.dat", rows, delimiter=", ")
    found = scored(tmp_path / "track.h5", tmp_path / "theirs.dat", "--align", "both")
    assert found["pairs"] == 196
    assert found["gain"]["value"][:3] == pytest.approx([1.0, 0.97, 1.0], abs=2e-3)


def test_errors_are_aligned_between_the_counters_beginnings(on_a_ball, tmp_path):
    """Before: one rotation for all frames, though the table's axes change there."""
    table = fictrac_table(on_a_ball, FicTracAxes.of_lab(TURN))
    turned = Rotation.from_rotvec(table[100:, 8:11]) * Rotation.from_rotvec(table[100, 8:11]).inv()
    table[100:, 8:11], table[100:, 22] = turned.as_rotvec(), np.arange(100)
    np.savetxt(tmp_path / "own.dat", table, delimiter=", ")
    found = scored(tmp_path / "track.h5", tmp_path / "own.dat", "--align", "both")
    assert (found["known"], found["pairs"]) == (200, 198)
    assert found["error_deg"]["largest"] < 0.01
    # A track without the frame where it begins anew is cut there as well.
    on_a_ball.at(np.delete(np.arange(200), 100)).save(tmp_path / "fewer.h5")
    fewer = scored(tmp_path / "fewer.h5", tmp_path / "own.dat", "--align", "both")
    assert (fewer["known"], fewer["pairs"]) == (199, 197)
    assert fewer["error_deg"]["largest"] < 0.01


def test_lengths_in_radii_have_no_error_in_mm(track):
    loaded = replace(Trajectory.load(track), length_unit="radii")
    found = score_track(loaded, TRUTH)
    assert np.isnan(found.position_mm).all()
    assert found.valid.all()
    assert "velocity" not in found.relative_rms
    assert found.relative_rms.keys() >= {"omega_lab", "alpha_body"}


def test_behaviour_is_printed_and_for_a_short_track_the_reason(on_a_ball, tmp_path):
    printed = CliRunner().invoke(app, ["score", str(tmp_path / "track.h5"), str(tmp_path / "truth.h5")]).output
    assert "0.9700" in printed
    assert all(word in printed for word in ("gain, smoothed", "drift (degrees a minute)", "ratio of path lengths"))
    printed = (
        CliRunner()
        .invoke(app, ["score", str(tmp_path / "theirs.dat"), str(tmp_path / "truth.h5"), "--align", "both"])
        .output
    )
    assert "1.0000 .. 1.0000" in printed
    on_a_ball[:40].save(tmp_path / "short.h5")
    short = scored(tmp_path / "short.h5", tmp_path / "truth.h5")
    assert short["gain"]["value"] == [None] * 4
    assert short["reason"].startswith("39 pairs")


def test_a_report_has_the_behaviour_against_its_reference(on_a_ball, tmp_path):
    track, truth, out = (tmp_path / name for name in ("track.h5", "truth.h5", "report"))
    run = CliRunner().invoke(app, ["report", str(track), "--against", str(truth), "--out", str(out)])
    assert run.exit_code == 0, run.exception
    page = (out / "index.html").read_text()
    assert "Against the reference" in page
    assert "0.9700" in page
    rows = (out / "tables" / "behaviour.csv").read_text().splitlines()
    assert rows[0].startswith("file,about,gain,gain_low,gain_high,gain_smooth")
    assert len(rows) == 5
