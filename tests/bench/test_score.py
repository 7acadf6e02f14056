"""The score: planted errors come back, and another program that scores tracks agrees."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import REPO, SHARED
from scipy.spatial.transform import Rotation

from sphereorient.bench import score_track
from sphereorient.errors import TrackError
from sphereorient.trajectory import Trajectory

TRUTH = REPO / "synthetic_data" / "excerpt" / "truth.h5"
RATES = ("velocity", "acceleration", "omega_lab", "omega_body", "alpha_lab", "alpha_body")


@pytest.fixture(scope="module")
def truth() -> dict[str, np.ndarray]:
    with h5py.File(TRUTH) as file:
        return {key: file[key][()] for key in ("time", "position", "orientation", *RATES)}


def perfect(truth: dict[str, np.ndarray], frames: slice = slice(None)) -> Trajectory:
    """A track with the true poses."""
    time = truth["time"][frames]
    track = Trajectory.empty(time, cameras=("cam1", "cam2"), frame_rate=600.0, method="paper", experiment="excerpt")
    known = {key: truth[key][frames] for key in ("position", "orientation", *RATES)}
    seen = {name: replace(camera, orientation=known["orientation"]) for name, camera in track.cameras.items()}
    return replace(track, **known, valid=np.ones(len(time), bool), cameras=seen)


def turned(orientation: np.ndarray, degrees: np.ndarray | float, axis: tuple[float, float, float]) -> np.ndarray:
    unit = np.array(axis) / np.linalg.norm(axis)
    angles = np.broadcast_to(np.deg2rad(degrees), len(orientation))
    return Rotation.from_rotvec(angles[:, None] * unit).as_matrix() @ orientation


def spoilt(truth: dict[str, np.ndarray]) -> Trajectory:
    """A track with every kind of error, and frames and values that are missing."""
    rng = np.random.default_rng(5)
    track = perfect(truth)
    n = len(track)
    rates = {key: getattr(track, key) * (1 + 0.1 * rng.standard_normal((n, 3))) for key in RATES}
    rates["omega_lab"][:3] = np.nan
    rates["alpha_lab"][:] = np.nan
    position = track.position + 0.1 * rng.standard_normal((n, 3))
    position[7] = np.nan
    orientation = turned(track.orientation, rng.uniform(0, 4, n), (1, -2, 0.5))
    orientation[11] = np.nan
    valid = np.ones(n, bool)
    valid[[7, 11, 20]] = False
    return replace(track, **rates, position=position, orientation=orientation, valid=valid)


def test_a_perfect_track_has_no_error(truth):
    score = score_track(perfect(truth), TRUTH)
    assert score.frames == 40
    assert score.valid.all()
    assert score.orientation_deg.max() < 1e-5
    assert score.position_mm.max() == 0
    assert set(score.relative_rms) == set(RATES)
    assert max(score.relative_rms.values()) == 0
    assert set(score.coverage.values()) == {1.0}


@pytest.mark.parametrize("degrees", [0.01, 1.0, 30.0, 179.0, 180.0])
@pytest.mark.parametrize("axis", [(1, 0, 0), (1, -2, 3)])
def test_a_planted_turn_is_the_orientation_error(truth, degrees, axis):
    track = perfect(truth)
    score = score_track(replace(track, orientation=turned(track.orientation, degrees, axis)), TRUTH)
    np.testing.assert_allclose(score.orientation_deg, degrees, rtol=1e-6)
    np.testing.assert_allclose(score.percentiles_deg(), degrees, rtol=1e-6)


def test_each_camera_is_scored_by_itself(truth):
    track = perfect(truth)
    wrong = replace(track.cameras["cam2"], orientation=turned(track.orientation, 2.5, (0, 1, 1)))
    score = score_track(replace(track, cameras=dict(track.cameras) | {"cam2": wrong}), TRUTH)
    assert score.camera_orientation_deg["cam1"].max() < 1e-5
    np.testing.assert_allclose(score.camera_orientation_deg["cam2"], 2.5, rtol=1e-6)
    assert score.orientation_deg.max() < 1e-5


@pytest.mark.parametrize("key", RATES)
def test_a_rate_that_is_too_fast_by_a_tenth_is_wrong_by_a_tenth(truth, key):
    track = perfect(truth)
    score = score_track(replace(track, **{key: 1.1 * getattr(track, key)}), TRUTH)
    assert score.relative_rms[key] == pytest.approx(0.1, rel=1e-9)
    assert sum(score.relative_rms.values()) == pytest.approx(0.1, rel=1e-9)


def test_rates_count_only_where_they_were_measured(truth):
    track = perfect(truth)
    omega = 1.2 * track.omega_lab
    omega[10:] = np.nan
    score = score_track(replace(track, omega_lab=omega), TRUTH)
    assert score.coverage["omega_lab"] == 0.25
    assert score.relative_rms["omega_lab"] == pytest.approx(0.2, rel=1e-9)


def test_frames_without_a_measurement_have_no_error(truth):
    score = score_track(Trajectory.empty(truth["time"], cameras=("cam1",), frame_rate=600.0), TRUTH)
    assert not score.valid.any()
    assert np.isnan(score.percentiles_deg()).all()
    assert np.isnan(score.percentiles_mm()).all()
    assert np.isnan(score.camera_orientation_deg["cam1"]).all()
    assert all(np.isnan(value) for value in score.relative_rms.values())
    assert set(score.coverage.values()) == {0.0}


def test_percentiles_are_over_the_valid_frames(truth):
    track = perfect(truth)
    degrees = np.where(np.arange(40) < 4, 90.0, 1.0)
    valid = np.arange(40) >= 4
    score = score_track(replace(track, orientation=turned(track.orientation, degrees, (0, 0, 1)), valid=valid), TRUTH)
    np.testing.assert_allclose(score.percentiles_deg(), 1.0, rtol=1e-6)
    assert score.orientation_deg[0] == pytest.approx(90)
    np.testing.assert_array_equal(score.valid, valid)


def test_percentiles_are_the_median_two_tails_and_the_worst(truth):
    """Errors of 0 .. 39: the q-th percentile is 39 q / 100."""
    track = perfect(truth)
    degrees, shift = np.linspace(0, 39, 40), np.linspace(0, 3.9, 40)
    position = track.position + shift[:, None] * np.array([0.6, 0.0, -0.8])
    spread = replace(track, orientation=turned(track.orientation, degrees, (1, 1, 0)), position=position)
    score = score_track(spread, TRUTH)
    np.testing.assert_allclose(score.percentiles_deg(), [19.5, 37.05, 38.61, 39.0], rtol=1e-6)
    np.testing.assert_allclose(score.percentiles_mm(), [1.95, 3.705, 3.861, 3.9], rtol=1e-6)


def test_a_frame_without_a_position_is_not_valid_whatever_the_tracks_flag(truth):
    track = perfect(truth)
    position = track.position.copy()
    position[3] = np.nan
    assert np.flatnonzero(~score_track(replace(track, position=position), TRUTH).valid).tolist() == [3]


def test_frames_are_matched_by_time(truth):
    """A part of the frames, and a clock that is off by less than half a frame."""
    part = perfect(truth, slice(12, 30))
    assert score_track(part, TRUTH).position_mm.max() == 0
    assert score_track(replace(part, time=part.time + 0.4 / 600), TRUTH).position_mm.max() == 0
    assert score_track(replace(part, time=part.time + 1 / 600), TRUTH).position_mm.min() > 0


@pytest.mark.parametrize("shift_s", [0.5, -0.5, 35 / 600])
def test_times_of_another_experiment_are_refused(truth, shift_s):
    track = perfect(truth)
    with pytest.raises(TrackError, match="times of the track") as caught:
        score_track(replace(track, time=track.time + shift_s), TRUTH)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", ["nothing", "text", "no truth"])
def test_a_file_that_is_no_truth_is_refused_in_one_line(truth, tmp_path, content):
    path = tmp_path / "truth.h5"
    if content == "text":
        path.write_text("position: 0")
    elif content == "no truth":
        with h5py.File(path, "w") as file:
            file["time"] = np.arange(40) / 600
    with pytest.raises(TrackError, match=r"truth\.h5") as caught:
        score_track(perfect(truth), path)
    assert "\n" not in str(caught.value)


def other_program(track: Path, *arguments: str) -> dict[str, float]:
    script = SHARED / "score_track.py"
    run = subprocess.run(
        [sys.executable, script, track, TRUTH, *arguments], capture_output=True, text=True, check=True, timeout=60
    )
    return json.loads(run.stdout)


@pytest.mark.shared
def test_another_program_gives_the_same_figures(truth, tmp_path):
    track = spoilt(truth)
    track.save(tmp_path / "track.h5")
    expected = other_program(tmp_path / "track.h5")
    score = score_track(track, TRUTH)
    assert score.frames == expected["frames"]
    assert score.valid.sum() == expected["frames_valid"] == 37
    for got, key in zip(score.percentiles_deg(), ("p50", "p95", "p99", "max"), strict=True):
        assert got == pytest.approx(expected[f"orientation_{key}_deg"], rel=1e-6)
    for got, key in zip(score.percentiles_mm()[[0, 1, 3]], ("p50", "p95", "max"), strict=True):
        assert got == pytest.approx(expected[f"position_{key}_mm"], rel=1e-9)
    for key in RATES:
        assert score.coverage[key] == pytest.approx(expected[f"{key}_coverage"])
        if expected[f"{key}_rel_rms"] is None:
            assert np.isnan(score.relative_rms[key])
        else:
            assert score.relative_rms[key] == pytest.approx(expected[f"{key}_rel_rms"], rel=1e-9)


@pytest.mark.shared
def test_another_program_gives_the_same_figures_for_one_camera(truth, tmp_path):
    track = perfect(truth)
    wrong = turned(track.orientation, np.linspace(0.1, 5, 40), (1, 2, 3))
    wrong[5] = np.nan
    track = replace(track, cameras={"cam1": replace(track.cameras["cam1"], orientation=wrong)})
    track.save(tmp_path / "track.h5")
    expected = other_program(tmp_path / "track.h5", "--camera", "cam1")
    alone = score_track(track, TRUTH).camera_orientation_deg["cam1"]
    got = np.percentile(alone[np.isfinite(alone)], [50, 95])
    assert expected["frames_valid"] == 39
    np.testing.assert_allclose(got, [expected["orientation_p50_deg"], expected["orientation_p95_deg"]], rtol=1e-6)
