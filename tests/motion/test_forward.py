"""Rates forward in time on planted motion: honest sigmas, nothing from later, gaps, jumps, laws."""

import math

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.motion.forward import FIRST_STEPS, JUDGED, TICKS, ForwardRate
from sphereorient.synth.motion import Motion6D, random_motion

FIRST = FIRST_STEPS + JUDGED + 2  # measurements before the first rate
SIGMA_MM = np.array([0.01, 0.01, 0.05])  # of one camera that looks along z
Floats = NDArray[np.float64]


def planted(omega_rms: float, correlation_s: float, time_s: Floats, seed: int = 3) -> Motion6D:
    return random_motion(0.26, 0.12, omega_rms, correlation_s, 45.0, seed).at(torch.from_numpy(time_s))


def noisy(truth: Motion6D, sigma: Floats, seed: int = 5) -> Floats:
    """Return orientations with white noise of sigma (3,), rad, lab."""
    noise = torch.from_numpy(np.random.default_rng(seed).normal(size=(len(truth.time_s), 3)) * sigma)
    return (so3.exp(noise) @ truth.R_lab_body).numpy()


def turning(time_s: Floats, R: Floats, sigma: Floats, found: tuple[int, ...] = ()) -> tuple[Floats, Floats]:
    """Return omega (N, 3) and its sigmas."""
    rates, filtered = [], ForwardRate()
    for k in range(len(R)):
        if k in found:
            filtered.restart()
        turn = R[k] @ R[max(k - 1, 0)].T
        step_s = time_s[k] - time_s[max(k - 1, 0)]
        rates.append(filtered.measured(step_s, cv2.Rodrigues(turn)[0][:, 0], np.diag(sigma**2), turn))
    return np.array([rate.value for rate in rates]), np.array([rate.sigma for rate in rates])


def over_sigma(value: Floats, sigma: Floats, true: torch.Tensor) -> float:
    there = np.isfinite(value).all(1)
    return float(np.sqrt((((value - true.numpy()) / sigma)[there] ** 2).mean()))


@pytest.mark.parametrize(
    ("rate_hz", "omega_rms", "correlation_s", "sigma_deg"),
    [
        (600, 10.5, 0.03, 0.036),
        (200, 0.05, 0.3, 0.016),  # next to still
        (100, 3.0, 0.3, 0.1),
        (30, 10.0, 0.3, 0.016),  # 19 degrees a frame
    ],
)
def test_errors_of_omega_are_as_stated_and_smaller_than_those_of_differences(
    rate_hz, omega_rms, correlation_s, sigma_deg
):
    time_s, sigma = np.arange(600) / rate_hz, math.radians(sigma_deg) * np.array([1.0, 1.0, 2.0])
    truth = planted(omega_rms, correlation_s, time_s)
    R = noisy(truth, sigma)
    value, stated = turning(time_s, R, sigma)
    assert np.isnan(value[:FIRST]).all()
    assert np.isnan(stated[:FIRST]).all()
    assert np.isfinite(value[FIRST:]).all()
    assert 0.8 < over_sigma(value, stated, truth.omega_lab_rad_s) < 1.3
    differences = so3.log(torch.from_numpy(R[FIRST:] @ R[FIRST - 1 : -1].transpose(0, 2, 1))) * rate_hz
    off = truth.omega_lab_rad_s[FIRST:]
    assert np.square(value[FIRST:] - off.numpy()).mean() < 0.5 * float((differences - off).square().mean())


def test_errors_of_velocity_are_as_stated_where_one_axis_is_worse_than_the_others():
    time_s = np.arange(600) / 600
    truth = planted(10.5, 0.03, time_s)
    axes = so3.exp(torch.tensor([0.4, -0.7, 0.2], dtype=torch.float64)).numpy()  # of the camera
    X = truth.position_lab_mm.numpy() + np.random.default_rng(6).normal(size=(600, 3)) * SIGMA_MM @ axes.T
    covariance, filtered = axes @ np.diag(SIGMA_MM**2) @ axes.T, ForwardRate()
    rates = [filtered.measured(1 / 600, X[k] - X[max(k - 1, 0)], covariance) for k in range(600)]
    value, stated = np.array([rate.value for rate in rates]), np.array([rate.sigma for rate in rates])
    assert 0.8 < over_sigma(value, stated, 1e3 * truth.velocity_m_s) < 1.3
    off = (value - 1e3 * truth.velocity_m_s.numpy())[FIRST:] @ axes
    assert np.square(off[:, 0]).mean() < 0.5 * np.square(off[:, 2]).mean(), "the good axes keep their own accuracy"


def test_omega_is_right_handed_in_the_lab_per_second():
    turn = so3.exp(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64) * torch.arange(60)[:, None] / 100)
    start = so3.exp(torch.tensor([1.0, -0.5, 0.3], dtype=torch.float64))
    value, _ = turning(np.arange(60) / 100, (turn @ start).numpy(), np.full(3, 1e-4))
    np.testing.assert_allclose(value[-1], [0.0, 0.0, 2.0], atol=1e-3)


def test_nothing_comes_from_later():
    time_s, sigma = np.arange(120) / 200, np.full(3, 3e-4)
    R = noisy(planted(10.0, 0.05, time_s), sigma)
    whole, part = turning(time_s, R, sigma), turning(time_s[:70], R[:70], sigma)
    for one, other in zip(whole, part, strict=True):
        assert one[:70].tobytes() == other.tobytes()


def test_frames_that_are_missing_and_uneven_times_are_allowed_for():
    rng = np.random.default_rng(2)
    time_s = np.sort(rng.choice(1500, 1000, replace=False) + rng.uniform(-0.3, 0.3, 1000)) / 300
    sigma = np.full(3, 3e-4)
    truth = planted(10.0, 0.05, time_s)
    value, stated = turning(time_s, noisy(truth, sigma), sigma)
    assert np.isfinite(value).all(1).sum() > 900
    assert 0.8 < over_sigma(value, stated, truth.omega_lab_rad_s) < 1.3


def test_memory_does_not_grow():
    time_s = np.cumsum(np.random.default_rng(1).uniform(0.001, 0.09, 1200))
    filtered = ForwardRate()
    for step_s in np.diff(time_s):
        filtered.measured(float(step_s), np.zeros(3), 1e-6 * np.eye(3))
    assert len(filtered._transitions) <= 1.5 * TICKS


@pytest.mark.parametrize("searched", [True, False])
def test_a_jump_begins_the_motion_anew(searched):
    """`searched`: the tracker searched for the ball; else the jump contradicts the motion before it."""
    time_s, sigma = np.arange(300) / 200, np.full(3, 3e-4)
    truth = planted(10.0, 0.05, time_s)
    R = noisy(truth, sigma)
    R[200:] = R[200:] @ so3.exp(torch.tensor([0.3, 0.4, -0.2], dtype=torch.float64)).numpy()
    value, stated = turning(time_s, R, sigma, (200,) if searched else ())
    unknown = np.flatnonzero(np.isnan(value).any(1))
    assert unknown[FIRST:].tolist() == [200, 201]
    assert 0.7 < over_sigma(value[200:230], stated[200:230], truth.omega_lab_rad_s[200:230]) < 1.4


def test_time_that_stands_or_goes_back_begins_anew():
    time_s = np.arange(100) / 200
    time_s[60:] = time_s[59] + np.arange(40) / 200
    time_s[80:] -= 10.0
    sigma = np.full(3, 3e-4)
    value, _ = turning(time_s, noisy(planted(1.0, 0.3, np.arange(100) / 200), sigma), sigma)
    unknown = np.flatnonzero(np.isnan(value).any(1))
    assert unknown[FIRST:].tolist() == [60, 61, 80, 81]


def test_noise_that_is_greater_than_stated_is_found():
    time_s, sigma = np.arange(600) / 200, np.full(3, 6e-4)
    truth = planted(3.0, 0.1, time_s)
    value, stated = turning(time_s, noisy(truth, sigma), sigma / 2)
    assert 0.8 < over_sigma(value, stated, truth.omega_lab_rad_s) < 1.3
