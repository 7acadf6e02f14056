import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import erf
from statistics_examples import ensemble

from sphereorient.statistics.density import (
    density,
    fit_stretched,
    flatness_of,
    log_stretched_exponential,
    stretched_exponential,
)
from sphereorient.statistics.settings import BootstrapSettings

FEW = BootstrapSettings(resamples=200)


def moment(power: int, a: float) -> float:
    def integrand(u: float) -> float:  # x = exp(u)
        return 2 * np.exp(u * (power + 1)) * float(stretched_exponential(np.exp(u), a))

    return quad(integrand, -40, 12, limit=500, points=[-5, 0, 2, 5])[0]


@pytest.mark.parametrize("a", [0.2, 0.45, 0.6, 0.9])
def test_the_stretched_exponential_has_unit_area_unit_variance_and_its_flatness(a):
    assert moment(0, a) == pytest.approx(1, rel=1e-6)
    assert moment(2, a) == pytest.approx(1, rel=1e-6)
    assert moment(4, a) == pytest.approx(float(flatness_of(a)), rel=1e-5)


def test_the_papers_two_values():
    assert float(flatness_of(0.45)) == pytest.approx(4.05, abs=0.01)
    assert float(flatness_of(0.6)) == pytest.approx(7.6, abs=0.01)


def test_far_tails_do_not_underflow_where_the_printed_form_does():
    x, a = np.array([5.0, 300.0]), 0.45
    printed = np.exp(1.5 * a**2) / (4 * np.sqrt(3)) * (1 - erf((np.log(x / np.sqrt(3)) + 2 * a**2) / (np.sqrt(2) * a)))
    ours = stretched_exponential(x, a)
    assert ours[0] == pytest.approx(printed[0], rel=1e-9)
    assert printed[1] == 0 < ours[1]
    assert np.isfinite(log_stretched_exponential(np.array([0.0, 1e-300, 1e30]), a)).all()


def planted(a: float, count: int, seed: int) -> np.ndarray:
    """Exactly of the stretched law: a uniform number times a log-normal one."""
    rng = np.random.default_rng(seed)
    return 40.0 * rng.uniform(-1, 1, count) * rng.lognormal(0, a, count) + 3.0


@pytest.mark.parametrize("a", [0.45, 0.6])
def test_the_fit_finds_a_planted_width(a):
    x = planted(a, 100_000, 1)
    fit = fit_stretched(x, np.arange(100_000) // 500, 200, FEW)
    assert fit.a.low <= a <= fit.a.high
    assert float(fit.a.value) == pytest.approx(a, abs=0.01)
    assert fit.better_than_gaussian


def test_the_fit_agrees_with_a_search_on_the_exact_likelihood():
    from scipy.optimize import minimize_scalar

    x = planted(0.6, 5000, 2)
    normal = (x - x.mean()) / x.std()
    exact = minimize_scalar(lambda a: -log_stretched_exponential(normal, a).sum(), bounds=(0.1, 1.4), method="bounded")
    fit = fit_stretched(x, np.arange(5000) // 50, 100, FEW)
    assert float(fit.a.value) == pytest.approx(exact.x, abs=0.002)


@pytest.mark.slow
def test_its_intervals_hold_the_planted_width_as_often_as_stated():
    held = 0
    for seed in range(100):
        fit = fit_stretched(planted(0.6, 6000, seed), np.arange(6000) // 60, 100, FEW)
        held += bool(fit.a.low <= 0.6 <= fit.a.high)
    assert 88 <= held <= 99


def test_normal_numbers_are_likelier_under_the_gaussian():
    x = np.random.default_rng(3).standard_normal(50_000)
    assert not fit_stretched(x, np.arange(50_000) // 500, 100, FEW).better_than_gaussian


def test_a_density_is_that_of_the_law_within_its_error_bars():
    x = np.column_stack([planted(0.6, 200_000, 4)] * 3)
    found = density(ensemble([1000] * 200, velocity=x), "velocity", 0, settings=FEW)
    law = stretched_exponential(found.centres, 0.6)
    near = np.abs(found.centres) < 4
    off = (found.pdf.value - law)[near] / found.pdf.error[near]
    assert np.abs(off).mean() < 1.3
    assert found.counts.sum() <= 200_000


def test_a_noisy_density_is_the_convolution():
    a, share = 0.7, 0.05
    x = np.linspace(-12, 12, 6001)
    step = x[1] - x[0]
    clean, noise = np.sqrt(1 - share), np.sqrt(share)
    kernel = np.exp(-((x / noise) ** 2) / 2) / (noise * np.sqrt(2 * np.pi))
    expected = np.convolve(stretched_exponential(x / clean, a) / clean, kernel, mode="same") * step
    found = np.exp(log_stretched_exponential(x, a, share))
    inner = np.abs(x) < 8
    np.testing.assert_allclose(found[inner], expected[inner], rtol=2e-3)


@pytest.mark.slow
def test_the_fit_corrects_for_noise_of_known_share():
    rng = np.random.default_rng(11)
    x = planted(0.7, 200_000, 11)
    noisy = x + np.sqrt(0.05) * x.std() * rng.standard_normal(len(x))
    segment = np.arange(200_000) // 1000
    corrected, uncorrected = (fit_stretched(noisy, segment, 200, FEW, share) for share in (0.05 / 1.05, 0.0))
    assert float(corrected.a.value) == pytest.approx(0.7, abs=0.01)
    assert float(uncorrected.a.value) < 0.68
