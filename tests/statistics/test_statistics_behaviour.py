"""Gain, drift and walk against a reference: planted ones come back, within their errors."""

from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from sphereorient import so3
from sphereorient.bench.ball import walked
from sphereorient.errors import ShapeError
from sphereorient.motion import MeasuredPoses, SmoothSettings, smooth_motion
from sphereorient.statistics.behaviour import Behaviour, Reference, behaviour_of
from sphereorient.synth.motion import random_motion
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.walk import walk_of

RATE = 30.0  # Hz
BODY = Rotation.from_euler("xyz", [1.0, 0.4, -0.7]).as_matrix()
LAB = Rotation.from_euler("xyz", [0.5, -1.0, 0.3]).as_matrix()


def turned(turns: np.ndarray) -> np.ndarray:
    """Orientations (N, 3, 3) after rotations (N, 3), lab."""
    return np.stack(list(accumulate(Rotation.from_rotvec(turns).as_matrix(), lambda R, T: T @ R)))


def turns_of(frames: int, seed: int = 0) -> np.ndarray:
    """Rotations of a ball on which an animal walks ahead and turns, correlated over 15 frames."""
    noise = np.random.default_rng(seed).normal(size=(frames + 100, 3))
    slow = lfilter([np.sqrt(1 - 0.935**2)], [1, -0.935], noise, axis=0)[100:]
    return 0.04 * slow + np.array([0.0, 0.05, 0.0])


def track_of(R: np.ndarray, **parts: Any) -> Trajectory:
    """The track of a ball in its place."""
    frames = len(R)
    empty = Trajectory.empty(np.arange(frames) / RATE, frame_rate=RATE)
    still = {"position": np.zeros((frames, 3)), "position_cov": np.tile(np.eye(3), (frames, 1, 1))}
    return replace(empty, orientation=R, valid=np.ones(frames, bool), **still, **parts)


def compared(R: np.ndarray, R_true: np.ndarray, align: bool = False, **parts: Any) -> Behaviour:
    return behaviour_of(track_of(R), Reference(R_lab_body=R_true, **parts), align)


def errors(frames: int, rng: np.random.Generator, correlation: float, sigma: float) -> np.ndarray:
    noise = rng.normal(size=(frames + 500, 3))
    return sigma * lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], noise, axis=0)[500:]


def moved(vectors: np.ndarray, R: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors).as_matrix() @ R


def test_a_planted_gain_about_one_axis_comes_back_and_that_of_reversed_roles_is_its_inverse():
    turns = turns_of(600)
    small, true = turned(turns * [1.0, 1.0, 0.97]), turned(turns)
    found = compared(small, true)
    np.testing.assert_allclose(found.gain.value[:3], [1.0, 1.0, 0.97], atol=1e-9)
    square = (turns[1:] ** 2).sum(0)
    assert found.gain.value[3] == pytest.approx((square * [1.0, 1.0, 0.97]).sum() / square.sum())
    np.testing.assert_allclose(compared(true, small).gain.value[:3], [1.0, 1.0, 1 / 0.97], atol=1e-9)
    assert (found.frames, found.pairs, found.reason) == (600, 599, "")


def test_a_good_track_has_gain_1_and_no_drift():
    true = turned(turns_of(3000))
    found = compared(moved(errors(3000, np.random.default_rng(1), 0.3, 2e-4), true), true)
    np.testing.assert_allclose(found.gain.value, 1.0, atol=5e-4)
    np.testing.assert_allclose(found.drift_deg_min, 0.0, atol=0.02)
    assert (found.drift_sigma_deg_min < 0.01).all()
    assert abs(found.length_ratio - 1) < 1e-3
    assert found.end_share < 1e-3


@pytest.mark.parametrize("exact", [True, False])
def test_the_interval_holds_the_gain(exact):
    held = []
    for seed in range(40):
        rng, true = np.random.default_rng(seed), turned(turns_of(500, seed))
        noisy = moved(errors(500, rng, 0.5, 2e-3), true)
        theirs = true if exact else moved(errors(500, rng, 0.5, 2e-3), true)
        found = compared(noisy, theirs, exact=exact).gain
        held.append((found.low <= 1) & (found.high >= 1))
    assert (np.mean(held, axis=0) > 0.85).all()


def test_the_gain_is_free_of_another_trackers_noise_where_ours_is_as_large_and_lies_in_the_bounds():
    rng, turns = np.random.default_rng(3), turns_of(4000)
    ours, theirs = (moved(errors(4000, rng, 0.0, 8e-3), turned(turns * g)) for g in ([1.0, 0.97, 1.0], [1.0, 1.0, 1.0]))
    found = compared(ours, theirs, exact=False)
    low, high = found.gain_bounds
    assert (low < [0.97, 0.96, 0.97, 0.97]).all()  # pulled down by the noise
    assert (low < found.gain.value).all()
    assert (found.gain.value < high).all()
    np.testing.assert_allclose(found.gain.value[:3], [1.0, 0.97, 1.0], atol=0.01)


def test_a_planted_drift_lies_within_two_errors_with_body_axes_of_its_own():
    rng, true = np.random.default_rng(5), turned(turns_of(3000))
    drift = np.deg2rad(0.5) / 60 * np.array([0.0, 0.0, 1.0])
    vectors = np.arange(3000)[:, None] / RATE * drift + errors(3000, rng, 0.0, 2e-3)
    found = compared(moved(vectors, true) @ BODY, true)
    off = np.abs(found.drift_deg_min - [0.0, 0.0, 0.5])
    assert (off < 2 * found.drift_sigma_deg_min).all()
    assert (found.drift_sigma_deg_min < 0.1).all()


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.8, 0.97])
def test_the_error_of_the_drift_is_right_also_where_errors_are_correlated(correlation):
    drift, z = np.deg2rad(0.5) / 60 * np.array([0.0, 1.0, 0.0]), []
    for seed in range(100):
        rng, true = np.random.default_rng(seed), turned(turns_of(900, seed))
        vectors = np.arange(900)[:, None] / RATE * drift + errors(900, rng, correlation, 1e-3)
        found = compared(moved(vectors, true), true)
        z.append((found.drift_deg_min - [0.0, 0.5, 0.0]) / found.drift_sigma_deg_min)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert ((rms > 0.8) & (rms < 1.3)).all(), rms


def test_a_drift_beyond_a_half_turn_is_unwrapped():
    true, t = turned(turns_of(2000)), np.arange(2000) / RATE
    found = compared(moved(t[:, None] * [0.0, 0.1, 0.0], true), true)  # 6.7 rad in all
    np.testing.assert_allclose(found.drift_deg_min, [0.0, np.rad2deg(6.0), 0.0], atol=10.0)


def test_alignment_removes_a_constant_rotation_of_the_lab_and_only_by_its_option():
    turns = turns_of(600)
    ours, theirs = turned(turns * [1.0, 0.97, 1.0]) @ BODY, turned(turns)
    found = compared(ours, LAB @ theirs, align=True, exact=False)  # axes of the track
    np.testing.assert_allclose(found.gain.value[:3], [1.0, 0.97, 1.0], atol=2e-3)
    assert found.apart_deg == pytest.approx(np.rad2deg(Rotation.from_matrix(LAB).magnitude()), abs=0.3)
    assert abs(found.length_ratio - 0.97) < 0.01
    found = compared(LAB @ ours, theirs, align=True)  # axes of the truth
    np.testing.assert_allclose(found.gain.value[:3], [1.0, 0.97, 1.0], atol=2e-3)
    assert abs(compared(LAB @ ours, theirs).gain.value[1] - 1) > 0.1


def test_alignment_is_a_rotation_also_where_the_third_axis_is_noise():
    turns = turns_of(600) * [1.0, 1.0, 0.01]
    found = compared(turned(turns * [1.0, 1.0, -1.0]), turned(turns), align=True)
    assert found.gain.value[2] < -0.5
    assert found.apart_deg < 1


def test_lost_frames_and_gaps_in_time_are_not_spanned():
    turns = turns_of(400)
    true = turned(turns)
    ours = true.copy()
    ours[[50, 51, 120]] = np.nan
    theirs = true.copy()
    theirs[200] = np.nan
    found = compared(ours, theirs)
    assert (found.frames, found.pairs) == (396, 399 - 3 - 2 - 2)
    np.testing.assert_allclose(found.gain.value, 1.0, atol=1e-9)
    np.testing.assert_allclose(found.drift_deg_min, 0.0, atol=1e-6)
    track = track_of(true)
    later = np.arange(400) / RATE + 0.2 * (np.arange(400) >= 100)  # six frames dropped before frame 100
    wrong = true.copy()
    wrong[100:] = true[100:] @ BODY  # the frames there are not compared
    found = behaviour_of(replace(track, time=later, orientation=wrong), Reference(R_lab_body=true))
    assert found.pairs == 398
    np.testing.assert_allclose(found.gain.value, 1.0, atol=1e-9)


def test_where_the_reference_begins_anew_nothing_is_compared():
    true = turned(turns_of(400))
    anew, start = true.copy(), np.arange(400) == 150
    anew[150:] = true[150:] @ true[150].T  # from there on in body axes of its own
    found = compared(true, anew, start=start)
    assert found.pairs == 398
    np.testing.assert_allclose(found.drift_deg_min, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.gain.value, 1.0, atol=1e-9)
    assert found.end_share < 1e-9
    assert compared(true, anew).gain.value[0] != pytest.approx(1.0)
    vectors = np.arange(400)[:, None] / RATE * [0.0, 0.0, 0.01]
    found = compared(moved(vectors, true), anew, start=start)  # the drift goes on
    np.testing.assert_allclose(found.drift_deg_min, [0.0, 0.0, np.rad2deg(0.6)], atol=1.0)


def test_smoothing_keeps_the_gain():
    motion = random_motion(0.26, 0.12, 10.5, 0.03, 45.0, 3).at(torch.arange(600, dtype=torch.float64) / 600.0)
    true, rng = motion.R_lab_body.numpy(), np.random.default_rng(0)
    R = moved(errors(600, rng, 0.0, 6e-4), true)
    unit = torch.eye(3, dtype=torch.float64).expand(600, 3, 3)
    poses = MeasuredPoses(
        time_s=motion.time_s,
        position_lab_mm=motion.position_lab_mm,
        position_cov_mm2=1e-4 * unit,
        R_lab_body=torch.from_numpy(R),
        orientation_cov_rad2=6e-4**2 * unit,
        segment=torch.zeros(600, dtype=torch.int64),
    )
    smooth = smooth_motion(poses, SmoothSettings()).R_lab_body.numpy()
    track = replace(track_of(R, orientation_smooth=smooth), time=motion.time_s.numpy())
    found = behaviour_of(track, Reference(R_lab_body=true)).gain_smooth
    assert found is not None
    np.testing.assert_allclose(found.value, 1.0, atol=1e-3)
    assert ((found.low < 1.0) & (found.high > 1.0)).all()
    lost = replace(track, orientation_smooth=np.where(np.arange(600)[:, None, None] < 560, np.nan, smooth))
    some = behaviour_of(lost, Reference(R_lab_body=true)).gain_smooth
    assert some is not None
    assert np.isnan(some.value).all()
    assert behaviour_of(track_of(R), Reference(R_lab_body=true)).gain_smooth is None


def test_smoothing_keeps_the_gain_of_a_ball_that_an_animal_turns():
    rng = np.random.default_rng(1)
    true, sigma = turned(walked(400, rng)), 1e-4
    R = moved(errors(400, rng, 0.0, sigma), true)
    unit = torch.eye(3, dtype=torch.float64).expand(400, 3, 3)
    poses = MeasuredPoses(
        time_s=torch.arange(400, dtype=torch.float64) / 100.0,
        position_lab_mm=torch.zeros(400, 3, dtype=torch.float64),
        position_cov_mm2=1e-4 * unit,
        R_lab_body=torch.from_numpy(R),
        orientation_cov_rad2=sigma**2 * unit,
        segment=torch.zeros(400, dtype=torch.int64),
    )
    found = smooth_motion(poses, SmoothSettings())
    # A rate without memory: the stated errors stay, but for the share that lasts.
    assert found.orientation_scale == pytest.approx(1 / (1 - SmoothSettings().slow_share) ** 0.5)
    off = so3.geodesic_distance(found.R_lab_body, torch.from_numpy(true))
    assert float(off.median()) < 2.5 * sigma


def test_a_smoother_that_loses_motion_shows_it_at_any_noise_of_the_reference():
    rng, turns = np.random.default_rng(3), turns_of(4000)
    theirs = moved(errors(4000, rng, 0.0, 8e-3), turned(turns))
    track = track_of(turned(turns), orientation_smooth=turned(0.98 * turns))
    found = behaviour_of(track, Reference(R_lab_body=theirs, exact=False))
    assert found.gain_smooth is not None
    np.testing.assert_allclose(found.gain_smooth.value / found.gain.value, 0.98, atol=0.003)


def test_heading_and_path_are_those_of_the_walk():
    turns = turns_of(500)
    ours, true = turned(turns * [1.0, 1.0, 0.97]), turned(turns)
    found, walks = compared(ours, true), [walk_of(np.arange(500) / RATE, R) for R in (ours, true)]
    assert found.heading_rad == pytest.approx(0.03 * turns[1:, 2].sum())  # to the left positive: -z is to the right
    assert np.cos(found.heading_rad) == pytest.approx(np.cos(walks[0].heading_rad[-1] - walks[1].heading_rad[-1]))
    length = np.hypot(turns[1:, 0], turns[1:, 1]).sum()
    assert found.length_ratio == pytest.approx(1.0)
    assert found.end_share == pytest.approx(np.linalg.norm(walks[0].path[-1] - walks[1].path[-1]) / length)
    moving = replace(track_of(ours), position=np.arange(1500.0).reshape(500, 3))
    assert np.isnan(behaviour_of(moving, Reference(R_lab_body=true)).length_ratio)


def test_too_little_gives_nan_and_the_reason():
    true = turned(turns_of(60))
    found = compared(true, true)
    assert found.reason == "59 pairs of neighbouring frames in both, at least 80 needed"
    assert np.isnan(found.gain.value).all()
    assert np.isnan(found.drift_deg_min).all()
    assert np.isnan(found.drift_sigma_deg_min).all()
    assert found.length_ratio == pytest.approx(1.0)  # the walk needs no error
    about_y = turned(np.tile([0.0, 0.05, 0.0], (200, 1)))
    found = compared(about_y, about_y, align=True)
    assert "about one axis only" in found.reason
    assert np.isnan([found.length_ratio, found.apart_deg]).all()
    found = compared(about_y, about_y)
    assert np.isnan(found.gain.value[0])
    assert found.gain.value[1] == pytest.approx(1.0)
    nothing = np.full((200, 3, 3), np.nan)
    assert compared(nothing, about_y).reason.startswith("0 pairs")
    with pytest.raises(ShapeError, match="times of the track"):
        compared(true, true[1:])
