import math

import numpy as np
import pytest

from sphereorient.errors import ShapeError
from sphereorient.learn.metrics import reliability


def calibrated(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    probability = rng.beta(2, 1, count)
    return probability, rng.random(count) < probability


def test_outcomes_as_frequent_as_stated_have_an_error_of_chance_alone():
    curve = reliability(*calibrated(20_000))
    assert curve.error < 2 * curve.chance < 0.02
    inside = (curve.low <= curve.probability) & (curve.probability <= curve.high)
    assert inside.sum() >= 8


def test_intervals_hold_what_is_true_95_times_in_100():
    inside = []
    for seed in range(200):
        curve = reliability(*calibrated(400, seed), bins=5)
        inside.append((curve.low <= curve.probability) & (curve.probability <= curve.high))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.025)  # 1000 intervals scatter by 0.007


@pytest.mark.parametrize(("power", "sign"), [(3.0, -1), (1 / 3, 1)], ids=["overconfident", "underconfident"])
def test_the_error_of_planted_misfits_is_the_mean_distance(power, sign):
    stated, _ = calibrated(50_000, 1)
    rng = np.random.default_rng(2)
    true = stated**power
    curve = reliability(stated, rng.random(len(stated)) < true, bins=20)
    assert curve.error == pytest.approx(np.abs(true - stated).mean(), abs=0.005)
    assert (sign * (curve.share - curve.probability)[2:-2] > 0).all()
    assert curve.error > 10 * curve.chance


def test_a_small_set_by_hand():
    curve = reliability([0.2, 0.4, 0.9, 0.7], [False, True, True, False], bins=2)
    np.testing.assert_allclose(curve.probability, [0.3, 0.8])
    np.testing.assert_allclose(curve.share, [0.5, 0.5])
    assert curve.count.tolist() == [2, 2]
    assert curve.error == pytest.approx(0.25)
    # Wilson's interval of 1 in 2: 0.5 +- 0.4055
    np.testing.assert_allclose(curve.low, 0.0945, atol=1e-4)
    np.testing.assert_allclose(curve.high, 0.9055, atol=1e-4)


def test_bins_hold_equal_counts_and_equal_probabilities_stay_together():
    rng = np.random.default_rng(0)
    curve = reliability(rng.random(1000), rng.random(1000) < 0.5)
    assert curve.count.tolist() == [100] * 10
    sure = np.concatenate([np.full(970, 1.0), np.linspace(0.1, 0.4, 30)])
    curve = reliability(sure, np.ones(1000, dtype=bool))
    assert curve.count[-1] == 970
    assert curve.count.sum() == 1000
    assert curve.probability[-1] == 1.0


def test_the_order_of_the_outcomes_does_not_matter_also_among_equal_probabilities():
    rng = np.random.default_rng(3)
    stated = np.round(rng.random(500), 1)
    came = rng.random(500) < stated
    mixed = rng.permutation(500)
    a, b = reliability(stated, came), reliability(stated[mixed], came[mixed])
    assert a.error == pytest.approx(b.error, abs=1e-12)
    np.testing.assert_allclose(a.share, b.share)


def test_chance_is_what_calibrated_sets_show_on_average():
    curves = [reliability(*calibrated(500, seed)) for seed in range(200)]
    assert np.mean([c.error for c in curves]) == pytest.approx(np.mean([c.chance for c in curves]), rel=0.1)


def test_probabilities_that_are_nan_are_left_out_and_none_is_data():
    curve = reliability([0.5, np.nan, 0.5], [True, True, False])
    assert curve.count.tolist() == [2]
    assert curve.error == 0.0
    none = reliability([], [])
    assert math.isnan(none.error)
    assert len(none.count) == 0
    single = reliability([1.0], [True])
    assert single.error == 0.0


@pytest.mark.parametrize(
    ("stated", "came", "bins"),
    [([0.1], [True, False], 10), ([1.5], [True], 10), ([-0.1], [True], 10), ([0.1], [True], 0)],
)
def test_impossible_sets_are_refused(stated, came, bins):
    with pytest.raises(ShapeError, match="expected"):
        reliability(stated, came, bins)
