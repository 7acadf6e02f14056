import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from statistics_examples import ensemble, holds

from sphereorient.statistics.bootstrap import bootstrap, segment_sums
from sphereorient.statistics.moments import LET_THROUGH, moments, table_of_moments
from sphereorient.statistics.noise import noise_warnings
from sphereorient.statistics.settings import BootstrapSettings

FEW = BootstrapSettings(resamples=200)


def test_moments_agree_with_scipy():
    rng = np.random.default_rng(1)
    x = rng.gamma(3.0, 2.0, (500, 3)) + np.array([0, 100, -3])
    found = moments(ensemble([200, 300], velocity=x), "velocity", FEW)
    every = np.column_stack([x, np.linalg.norm(x, axis=1)])
    np.testing.assert_allclose(found.mean.value, every.mean(0))
    np.testing.assert_allclose(found.rms.value, every.std(0))
    np.testing.assert_allclose(found.skewness.value, stats.skew(every))
    np.testing.assert_allclose(found.flatness.value, stats.kurtosis(every, fisher=False))


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(shift=st.floats(-1e4, 1e4), scale=st.floats(1e-3, 1e3))
def test_intervals_move_and_stretch_with_the_data(shift, scale):
    x = np.random.default_rng(2).standard_normal((300, 3))
    one = moments(ensemble([100] * 3, velocity=x), "velocity", FEW)
    other = moments(ensemble([100] * 3, velocity=shift + scale * x), "velocity", FEW)
    atol = 1e-6 * scale + 1e-9 * abs(shift)
    np.testing.assert_allclose(other.mean.low[:3], shift + scale * one.mean.low[:3], atol=atol)
    np.testing.assert_allclose(other.rms.high[:3], scale * one.rms.high[:3], rtol=1e-5)
    np.testing.assert_allclose(other.flatness.low[:3], one.flatness.low[:3], rtol=1e-5)


def test_equal_samples_within_a_segment_widen_the_interval_as_if_they_were_one():
    rng = np.random.default_rng(3)
    one = rng.standard_normal((400, 3))
    single = moments(ensemble([1] * 400, velocity=one), "velocity").mean
    repeated = moments(ensemble([25] * 400, velocity=np.repeat(one, 25, axis=0)), "velocity").mean
    np.testing.assert_allclose(repeated.error, single.error, rtol=1e-6)
    assert repeated.error[0] == pytest.approx(1 / 20, rel=0.1)


@pytest.mark.slow
def test_intervals_of_a_skewed_mean_hold_it_as_often_as_stated():
    rng = np.random.default_rng(4)
    held = 0
    for _ in range(400):
        sums = np.column_stack([rng.lognormal(0, 0.7, 60), np.ones(60)])
        found = bootstrap(sums, lambda total: total[..., :1] / total[..., 1:], FEW)
        held += bool(holds(found, np.exp(0.245))[0])
    assert 0.90 <= held / 400 <= 0.98


@pytest.mark.slow
def test_interval_agrees_with_scipys_bca():
    x = np.random.default_rng(5).lognormal(0, 0.6, 80)
    ours = bootstrap(
        np.column_stack([x, np.ones(80)]), lambda t: t[..., :1] / t[..., 1:], BootstrapSettings(resamples=20000)
    )
    theirs = stats.bootstrap((x,), np.mean, n_resamples=20000, method="BCa", rng=6).confidence_interval
    assert ours.low[0] == pytest.approx(theirs.low, rel=0.01)
    assert ours.high[0] == pytest.approx(theirs.high, rel=0.01)


def test_sums_by_segment_add_up():
    x = np.arange(10.0)
    assert segment_sums(x, np.array([0, 0, 1, 1, 1, 2, 2, 2, 2, 2]), 3).tolist() == [1, 9, 35]


def noisy(share: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Intermittent motion with a flatness of 6, its noise, and the noise's sigma."""
    rng = np.random.default_rng(7)
    motion = rng.laplace(0, np.sqrt(0.5), (400_000, 3))
    sigma = np.sqrt(share)
    return motion, motion + sigma * rng.standard_normal(motion.shape), sigma


@pytest.mark.slow
def test_noise_that_a_kernel_let_through_is_subtracted():
    _, measured, sigma = noisy(0.3)
    found = moments(ensemble([4000] * 100, velocity=measured, sigma=sigma), "velocity", FEW)
    np.testing.assert_allclose(found.corrected_rms.value[:3], 1.0, rtol=0.01)
    np.testing.assert_allclose(found.corrected_flatness.value[:3], 6.0, rtol=0.04)
    np.testing.assert_allclose(found.noise_share.value[:3], 0.3 / 1.3, rtol=0.02)


def test_motion_that_a_smoother_removed_is_added_again():
    # a best estimate of normal motion from noisy data: its own variance and its error's make up the motion's
    rng = np.random.default_rng(8)
    motion = rng.standard_normal((200_000, 3))
    estimate = (motion + 0.5 * rng.standard_normal(motion.shape)) / 1.25
    sigma = np.sqrt(0.25 / 1.25)
    found = moments(ensemble([2000] * 100, error="removed", velocity=estimate, sigma=sigma), "velocity", FEW)
    np.testing.assert_allclose(found.corrected_rms.value[:3], 1.0, rtol=0.01)
    np.testing.assert_allclose(found.corrected_flatness.value[:3], 3.0, rtol=0.02)
    np.testing.assert_allclose(found.noise_share.value[:3], 0.2, rtol=0.02)


@pytest.mark.slow
def test_noise_that_a_smoother_let_through_does_not_flatten_heavy_tails():
    # LET_THROUGH is the error's share of noise: a shrunk motion plus noise of that variance
    rng = np.random.default_rng(9)
    motion = rng.laplace(0, np.sqrt(0.5), (400_000, 3))
    sigma = 0.3
    estimate = 0.97 * motion + np.sqrt(LET_THROUGH) * sigma * rng.standard_normal(motion.shape)
    found = moments(ensemble([4000] * 100, error="removed", velocity=estimate, sigma=sigma), "velocity", FEW)
    assert found.flatness.value[:3].max() < 5.75
    np.testing.assert_allclose(found.corrected_flatness.value[:3], 6.0, rtol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "warned"), [(0.08, False), (0.13, True)])
def test_a_warning_comes_above_a_tenth_of_the_variance(share, warned):
    _, measured, sigma = noisy(share)
    table = table_of_moments(ensemble([4000] * 100, velocity=measured[:400_000], sigma=sigma), FEW)
    assert table["velocity"].noisy == warned
    named = {words.split()[0] for words in noise_warnings({"velocity": table["velocity"]}, "added")}
    assert named == ({"velocity"} if warned else set())


def test_the_norm_has_intervals_though_nothing_is_known_of_its_noise():
    found = moments(ensemble([60] * 40, sigma=0.1), "velocity", FEW)
    for name in ("mean", "rms", "skewness", "flatness"):
        part = getattr(found, name)
        assert (part.low < part.value).all(), name
        assert (part.value < part.high).all(), name
    assert np.isnan(found.corrected_rms.value[3])
    assert np.isnan(found.corrected_rms.low[3])


def test_a_constant_has_no_scatter_and_no_error():
    found = moments(ensemble([50, 50], velocity=np.full((100, 3), 2.5)), "velocity", FEW)
    assert found.mean.value[:3].tolist() == [2.5] * 3
    assert found.rms.value[:3].tolist() == [0.0] * 3
