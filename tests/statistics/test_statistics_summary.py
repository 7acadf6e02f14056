from dataclasses import replace

import numpy as np
import pytest
from ensembles import EnsembleSpec, draw_ensemble, filtered_track
from statistics_examples import STEP_S, track

from sphereorient.errors import TrackError
from sphereorient.statistics import StatisticsSettings, Surroundings, summarise
from sphereorient.statistics.lags import correlation
from sphereorient.statistics.segments import UNITS, ensemble_of

FEW = StatisticsSettings(resamples=100)


@pytest.fixture(scope="module")
def planted():
    spec = EnsembleSpec(segments=60, mean_frames=90.0)
    return spec, filtered_track(draw_ensemble(spec, 3), 0.1, 0.05, 3)


@pytest.fixture(scope="module")
def whole(planted):
    return summarise(planted[1], FEW, Surroundings(diameter_mm=18.0, viscosity_m2_s=8e-6, dissipation_w_kg=1.7))


@pytest.mark.slow
def test_everything_is_there_and_belongs_to_the_same_samples(whole):
    more = whole.distributions
    assert whole.table.keys() == more.densities.keys() == more.isotropies.keys() == UNITS.keys()
    assert {part.samples for part in whole.table.values()} == {len(whole.ensemble)}
    for parts in more.densities.values():
        assert all(part.counts.sum() > 0.99 * len(whole.ensemble) for part in parts)
    assert more.increments.lag_frames[0] == 1
    assert next(iter(more.increment_densities)) == 1
    assert more.increments.lag_s[-1] == pytest.approx(more.correlations["omega_lab"].integral_time_s.value[3], rel=0.2)
    assert {name: row.frame for name, row in more.rows.items()} == {"omega_lab": "lab", "omega_body": "body"}


@pytest.mark.slow
def test_the_velocitys_integral_time_is_measured_and_chooses_the_segments(planted, whole):
    _, tracked = planted
    by_all = correlation(ensemble_of(tracked), "velocity", settings=FEW).integral_time_s.value[3]
    assert whole.integral_time_s == pytest.approx(float(by_all))
    assert whole.ensemble.span_s.min() >= 0.25 * whole.integral_time_s
    longer = summarise(tracked, FEW.model_copy(update={"min_integral_times": 1.5}))
    assert longer.ensemble.segments < whole.ensemble.segments
    assert longer.ensemble.span_s.min() >= 1.5 * longer.integral_time_s


@pytest.mark.slow
def test_an_integral_time_that_is_given_is_not_measured(planted):
    found = summarise(planted[1], FEW.model_copy(update={"integral_time_s": 0.3}))
    assert found.integral_time_s == 0.3
    assert found.ensemble.span_s.min() >= 0.075


@pytest.mark.slow
def test_the_surroundings_make_the_dimensionless_numbers(whole):
    numbers = {one.formula: one.value for one in whole.dimensionless_numbers}
    v, omega = (np.sqrt(np.square(whole.table[q].corrected_rms.value[:3]).mean()) for q in ("velocity", "omega_lab"))
    assert numbers["omega_rms D / v_rms"] == pytest.approx(omega * 0.018 / v)
    assert numbers["D / eta"] == pytest.approx(0.018 / (8e-6**3 / 1.7) ** 0.25)
    assert not summarise(track([60, 60]), FEW).dimensionless_numbers


@pytest.mark.slow
def test_the_flows_integral_time_counts_unless_the_settings_give_one(planted):
    flow = Surroundings(integral_time_s=0.2)
    found = summarise(planted[1], FEW, flow)
    assert found.integral_time_s == 0.2
    assert 0.05 <= found.ensemble.span_s.min() < 0.1  # 0.25 of it; at least 50 frames
    longer = summarise(planted[1], FEW, replace(flow, integral_time_s=0.6))
    np.testing.assert_array_equal(longer.ensemble.span_s, found.ensemble.span_s[found.ensemble.span_s >= 0.15])
    assert longer.ensemble.segments < found.ensemble.segments
    given = FEW.model_copy(update={"integral_time_s": 0.3})
    assert summarise(planted[1], given, flow).integral_time_s == 0.3


@pytest.mark.parametrize("frames", [40, 4], ids=["too few", "fewer"])
def test_without_a_segment_that_counts_the_numbers_are_nan(frames):
    found = summarise(track([frames]), FEW, Surroundings(diameter_mm=18.0))
    assert found.ensemble.segments == 0
    assert found.table.keys() == UNITS.keys()
    assert all(np.isnan(part.rms.value).all() and np.isnan(part.rms.low).all() for part in found.table.values())
    assert not found.warnings
    assert not found.dimensionless_numbers
    assert found.distributions is None


def test_frames_without_any_motion_are_not_refused_but_frames_without_a_pose_are():
    still = replace(track([60]), velocity=np.full((62, 3), np.nan))
    assert np.isnan(summarise(still, FEW).table["omega_lab"].rms.value).all()
    with pytest.raises(TrackError, match="no valid frame"):
        summarise(replace(still, valid=np.zeros(62, bool)), FEW)


def test_one_segment_has_numbers_and_no_intervals():
    one = track([80])
    found = summarise(one, FEW)
    rows = one.segment >= 0
    assert found.distributions is None
    np.testing.assert_allclose(found.table["alpha_lab"].rms.value[:3], one.alpha_lab[rows].std(0))
    assert np.isnan(found.table["alpha_lab"].rms.low).all()
    assert np.isnan(found.integral_time_s)


@pytest.mark.slow
def test_a_long_record_cut_into_pieces_has_intervals_and_no_durations():
    found = summarise(track([900]), FEW.model_copy(update={"max_duration_s": 90 * STEP_S, "integral_time_s": 0.01}))
    assert found.ensemble.segments == 10
    assert found.distributions.durations is None
    assert np.isfinite(found.table["omega_lab"].rms.low).all()


@pytest.mark.slow
def test_noise_is_warned_of_by_name():
    noisy = track([80, 80])
    sigma = noisy.alpha_body_sigma.copy()
    sigma[:, 1] = 0.5
    found = summarise(replace(noisy, alpha_body_sigma=sigma), FEW)
    assert [words.split(":")[0] for words in found.warnings] == ["alpha_body y"]


@pytest.mark.slow
def test_the_progress_goes_up_to_its_end(planted):
    steps = []
    summarise(planted[1], FEW, progress=lambda done, total: steps.append((done, total)))
    done, totals = zip(*steps, strict=True)
    assert set(totals) == {10}
    assert list(done) == sorted(done)
    assert done[-1] == 10
