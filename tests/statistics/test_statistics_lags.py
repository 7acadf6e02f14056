import numpy as np
import pytest
from statistics_examples import STEP_S, ensemble, holds, without

from sphereorient.statistics.lags import Pairs, correlation, increment_density, increments, integral_time
from sphereorient.statistics.settings import BootstrapSettings

FEW = BootstrapSettings(resamples=200)
TAU = 12.0  # frames


def forgetful(segments: int, frames: int, seed: int) -> np.ndarray:
    """Normal numbers with autocorrelation exp(-k / TAU)."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-1 / TAU)
    x = np.empty((segments, frames, 3))
    x[:, 0] = rng.standard_normal((segments, 3))
    for k in range(1, frames):
        x[:, k] = keep * x[:, k - 1] + np.sqrt(1 - keep**2) * rng.standard_normal((segments, 3))
    return x.reshape(-1, 3)


def slow_pairs(whole, lag):
    return {
        (i, j)
        for i in range(len(whole))
        for j in range(len(whole))
        if whole.segment[i] == whole.segment[j] and whole.frame[j] - whole.frame[i] == lag
    }


@pytest.mark.parametrize("lag", [0, 1, 3, 8, 40])
def test_pairs_are_those_that_a_slow_loop_finds(lag):
    whole = ensemble([9, 2, 14])
    gappy = without(whole, np.random.default_rng(1).uniform(size=25) > 0.3)
    first, second = Pairs(gappy).at(lag)
    assert set(zip(first.tolist(), second.tolist(), strict=True)) == slow_pairs(gappy, lag)


@pytest.mark.slow
def test_autocorrelation_and_integral_time_of_a_forgetful_process():
    x = forgetful(600, 150, 1)
    found = correlation(ensemble([150] * 600, velocity=x), "velocity", FEW)
    exact = np.exp(-found.lag_s / STEP_S / TAU)
    assert np.abs((found.value.value - exact[:, None]) / np.maximum(found.value.error, 1e-12))[1:].mean() < 1.5
    assert holds(found.integral_time_s, TAU * STEP_S).sum() >= 3
    # the curve of a sample crosses zero at some 3 TAU, beyond which 4 % of the integral lie
    assert found.integral_time_s.value[3] == pytest.approx(TAU * STEP_S, rel=0.06)


def test_gaps_and_lengths_do_not_bias_an_autocorrelation():
    rng = np.random.default_rng(2)
    whole = ensemble([150] * 600, velocity=forgetful(600, 150, 2))
    lengths = rng.integers(5, 151, 600)
    kept = (whole.frame < lengths[whole.segment]) & (rng.uniform(size=len(whole)) > 0.4)
    found = correlation(without(whole, kept), "velocity", FEW)
    near_s = found.lag_s[found.lag_s <= 40 * STEP_S]
    assert np.abs(found.value.value[: len(near_s), 3] - np.exp(-near_s / STEP_S / TAU)).max() < 0.03


def test_a_cosine_correlates_as_a_cosine():
    frame = np.tile(np.arange(100), 50)
    phase = np.repeat(np.linspace(0, 2 * np.pi, 50, endpoint=False), 100)
    x = np.cos(0.2 * frame + phase)[:, None] * np.ones(3)
    found = correlation(ensemble([100] * 50, velocity=x), "velocity", FEW)
    np.testing.assert_allclose(found.value.value[:, 0], np.cos(0.2 * found.lag_s / STEP_S), atol=1e-10)
    assert found.reached_zero.all()
    assert found.integral_time_s.value[0] == pytest.approx(5 * STEP_S, rel=0.01)  # integral of cos to its zero


def test_the_integral_stops_at_the_first_zero():
    curve = np.array([1.0, 0.5, -0.5, 1.0, 1.0])[:, None]
    assert integral_time(curve, np.arange(5.0))[0] == pytest.approx(0.75 + 0.125)


def test_increments_of_a_forgetful_process():
    found = increments(ensemble([150] * 600, omega_lab=forgetful(600, 150, 3)), settings=FEW)
    exact = np.sqrt(2 * (1 - np.exp(-found.lag_frames / TAU)))
    assert found.lag_frames[0] == 1
    np.testing.assert_allclose(found.rms.value[:, 3], exact, rtol=0.02)
    np.testing.assert_allclose(found.flatness.value[:, 3], 3.0, rtol=0.06)


def test_increments_of_independent_values_have_half_the_excess():
    x = np.random.default_rng(4).laplace(size=(60_000, 3))  # flatness 6
    found = increments(ensemble([200] * 300, omega_lab=x), lags_s=[7 * STEP_S], settings=FEW)
    assert found.flatness.value[0, 3] == pytest.approx(4.5, rel=0.05)


def test_increments_over_one_frame_have_the_accelerations_tails():  # docs/errata.md E7
    alpha = np.random.default_rng(5).laplace(size=(60_000, 3))
    omega = np.cumsum(alpha, axis=0)
    found = increments(ensemble([200] * 300, omega_lab=omega), lags_s=[STEP_S, 100 * STEP_S], settings=FEW)
    assert found.flatness.value[0, 3] == pytest.approx(6, rel=0.06)
    assert found.flatness.value[1, 3] == pytest.approx(3, rel=0.1)
    narrow = increment_density(ensemble([200] * 300, omega_lab=omega), 100, settings=FEW)
    assert not narrow.fit.better_than_gaussian


def test_lags_that_no_segment_reaches_are_left_out():
    found = increments(ensemble([20] * 30), lags_s=[5 * STEP_S, 19 * STEP_S, 100 * STEP_S], settings=FEW)
    assert found.lag_frames.tolist() == [5, 19]


def test_a_segment_of_isolated_frames_has_no_increments_and_hides_no_other_ones():
    """Before: no lag had pairs in both segments, and the command ended in a traceback."""
    whole = ensemble([300, 60])
    alone = without(whole, np.flatnonzero((whole.segment == 0) | np.isin(whole.frame, [10, 30])))
    found = increments(alone, settings=FEW)
    assert found.lag_frames[0] == 1
    assert found.pairs[0] == 299
    assert np.isfinite(found.rms.value).all()


def test_an_integral_ends_before_lags_that_no_pair_reaches():
    curve = np.array([[1.0], [0.8], [0.6], [np.nan], [0.9]])
    assert integral_time(curve, np.arange(5.0)) == pytest.approx(0.9 + 0.7)
