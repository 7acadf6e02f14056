import numpy as np
import pytest
from statistics_examples import holds

from sphereorient.statistics.bootstrap import bootstrap, studentized
from sphereorient.statistics.settings import BootstrapSettings

SETTINGS = BootstrapSettings(resamples=400)
POSITIVE = np.array([False, True])


def mean_and_size(totals: np.ndarray) -> np.ndarray:
    """Mean and rms of (number, sum, sum of squares)."""
    count, first, second = np.moveaxis(totals, -1, 0)
    return np.stack([first / count, np.sqrt(second / count)], axis=-1)


def sums_of(x: np.ndarray) -> np.ndarray:
    """(S, n) samples of one group as (S, 1, 3)."""
    return np.stack([np.full(len(x), x.shape[1]), x.sum(1), (x**2).sum(1)], axis=-1)[:, None]


def test_for_normal_samples_the_interval_is_students():
    x = 3.0 + 2.0 * np.random.default_rng(1).standard_normal((400, 5))
    found = studentized(sums_of(x), mean_and_size, POSITIVE, BootstrapSettings(resamples=4000))
    assert found.value[0].tolist() == pytest.approx([x.mean(), np.sqrt((x**2).mean())])
    error = 2.0 / np.sqrt(2000)
    assert found.error[0, 0] == pytest.approx(error, rel=0.06)
    assert found.high[0, 0] - found.value[0, 0] == pytest.approx(1.96 * error, rel=0.1)
    assert found.value[0, 0] - found.low[0, 0] == pytest.approx(1.96 * error, rel=0.1)


def test_errors_come_from_segments_not_from_samples():
    rng = np.random.default_rng(2)
    x = np.repeat(rng.standard_normal((300, 1)), 8, axis=1)  # of one segment all alike
    found = studentized(sums_of(x), mean_and_size, POSITIVE, SETTINGS)
    assert found.error[0, 0] == pytest.approx(1 / np.sqrt(300), rel=0.15)


@pytest.mark.slow
def test_for_skewed_samples_it_holds_the_truth_more_often_than_percentiles_do():
    truth, held = np.exp(0.5), {"studentized": 0, "percentiles": 0}
    for seed in range(150):
        sums = sums_of(np.exp(np.random.default_rng([3, seed]).standard_normal((100, 1))))
        both = {"studentized": studentized(sums, mean_and_size, np.array([True, True]), SETTINGS),
                "percentiles": bootstrap(sums, mean_and_size, SETTINGS)}  # fmt: skip
        for name, found in both.items():
            held[name] += bool(holds(found.part((0, 0)), truth))
    assert held["studentized"] >= 135
    assert held["studentized"] > held["percentiles"]


def test_positive_quantities_have_positive_ends_and_do_not_depend_on_the_unit():
    sums = sums_of(np.random.default_rng(4).standard_normal((25, 2)) ** 3)
    found = studentized(sums, mean_and_size, POSITIVE, SETTINGS)
    assert (found.low[0, 1] > 0).all()
    other = studentized(sums * np.array([1, 10.0, 100.0]), mean_and_size, POSITIVE, SETTINGS)
    np.testing.assert_allclose(other.low, 10 * found.low, rtol=1e-6)
    np.testing.assert_allclose(other.high, 10 * found.high, rtol=1e-6)


def test_groups_do_not_depend_on_each_other():
    rng = np.random.default_rng(5)
    a, b = (sums_of(rng.standard_normal((60, 3))) for _ in range(2))
    both = studentized(np.concatenate([a, b], axis=1), mean_and_size, POSITIVE, SETTINGS)
    np.testing.assert_allclose(both.high[1], studentized(b, mean_and_size, POSITIVE, SETTINGS).high[0], rtol=1e-9)


def test_an_undefined_statistic_is_nan_and_a_constant_has_no_width():
    sums = sums_of(np.ones((30, 2)))
    found = studentized(sums, lambda t: mean_and_size(t) - [0.0, 2.0], POSITIVE, SETTINGS)
    assert found.low[0, 0] == pytest.approx(1)
    assert found.high[0, 0] == pytest.approx(1)
    assert np.isnan([found.low[0, 1], found.high[0, 1], found.error[0, 1]]).all()


def test_few_segments_have_the_other_bootstraps_intervals():
    sums = sums_of(np.random.default_rng(6).standard_normal((12, 4)))
    found, plain = studentized(sums, mean_and_size, POSITIVE, SETTINGS), bootstrap(sums, mean_and_size, SETTINGS)
    assert found.low.tolist() == plain.low.tolist()


def test_the_same_seed_gives_the_same_intervals_and_another_one_others():
    sums = sums_of(np.random.default_rng(7).standard_normal((50, 4)))
    first, second = (studentized(sums, mean_and_size, POSITIVE, SETTINGS) for _ in range(2))
    assert first.low.tolist() == second.low.tolist()
    other = studentized(sums, mean_and_size, POSITIVE, SETTINGS.model_copy(update={"seed": 1}))
    assert first.low[0, 0] != other.low[0, 0]
