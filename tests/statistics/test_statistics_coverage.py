"""A reduced version of scripts/ensemble_coverage.py."""

import ensemble_coverage as coverage
import numpy as np
import pytest
from ensembles import EnsembleSpec, draw_ensemble, smoothed_track

from sphereorient.statistics.segments import ensemble_of
from sphereorient.statistics.settings import BootstrapSettings


@pytest.mark.slow
def test_intervals_hold_the_nominal_values_as_often_as_stated():
    spec = EnsembleSpec(mean_frames=100.0)
    truth = coverage.truths(spec)
    few = BootstrapSettings(resamples=300)
    held = {"rms": [], "flatness": [], "a": []}
    for seed in range(12):
        for key, _, low, high in coverage.measure(ensemble_of(draw_ensemble(spec, seed)), few):
            held[key[1]].append(low <= truth[key] <= high)
    # 12 times 18 (6 for a) intervals, those of one repetition partly dependent
    for name, times in held.items():
        assert 0.86 <= np.mean(times) <= 0.995, name


@pytest.mark.slow
def test_one_repetition_with_noise_recovers_every_rms():
    spec = EnsembleSpec(segments=40, mean_frames=90.0)
    _, known = smoothed_track(draw_ensemble(spec, 100), coverage.NOISE_DEG, coverage.NOISE_MM, 100)
    truth = dict.fromkeys(coverage.truths(spec), 0.0)
    result = coverage.repeat(coverage.Work(seed=0, spec=spec, truth=truth, known=known))
    assert result.keys() == truth.keys()
    for (_, name, _), (ratio, _) in result.items():
        assert abs(ratio - 1) < {"rms": 0.03, "flatness": 0.12, "a": 0.08}[name]
