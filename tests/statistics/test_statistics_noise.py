from dataclasses import replace

import numpy as np
import pytest
import torch
from ensembles import EnsembleSpec, draw_ensemble, filtered_track

from sphereorient.errors import TrackError
from sphereorient.motion import gaussian_derivative, gaussian_kernel
from sphereorient.statistics.noise import multi_lag, width_curve
from sphereorient.statistics.settings import BootstrapSettings

FEW = BootstrapSettings(resamples=200)
NOISE_DEG, NOISE_MM = 0.1, 0.05


@pytest.fixture(scope="module")
def true():
    return draw_ensemble(EnsembleSpec(segments=200, mean_frames=150), 3)


@pytest.fixture(scope="module")
def track(true):
    return filtered_track(true, NOISE_DEG, NOISE_MM, 4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quantity", "noise"), [("acceleration", NOISE_MM * 1e-3), ("alpha_lab", np.radians(NOISE_DEG))]
)
def test_many_lags_separate_the_motions_variance_from_the_noise(true, track, quantity, noise):
    found = multi_lag([track], quantity, settings=FEW)
    exact = np.sqrt(np.square(getattr(true, quantity)).mean(0))
    np.testing.assert_allclose(found.rms, exact, rtol=0.03)
    np.testing.assert_allclose(np.sqrt(found.noise_variance.value), noise, rtol=0.04)
    assert (found.naive[0] > 4 * found.variance.value).all()  # over one frame it is mostly noise


@pytest.mark.slow
def test_two_degrees_of_noise_drown_alpha_but_not_its_estimate(true):
    found = multi_lag([filtered_track(true, 2.0, NOISE_MM, 5)], "alpha_lab", settings=FEW)
    np.testing.assert_allclose(np.sqrt(found.noise_variance.value), np.radians(2.0), rtol=0.04)
    assert (found.naive[0] > 500 * 560**2).all()


def test_a_segment_too_few_is_refused(track):
    one = track.at(np.flatnonzero(track.segment == 0))
    with pytest.raises(TrackError, match="two segments"):
        multi_lag([one], "acceleration")


def test_rms_falls_with_the_width_and_so_does_the_noise(true, track):
    found = width_curve([track], "acceleration", settings=FEW)
    exact = np.sqrt(np.square(true.acceleration).mean(0))
    assert (np.diff(found.noise_share.value, axis=0) < 0).all()
    assert (np.diff(found.rms.value, axis=0) < 0).all()
    # the plateau: without the noise, narrow kernels all give the motion's own rms
    np.testing.assert_allclose(found.corrected_rms.value[:4], np.tile(exact, (4, 1)), rtol=0.03)
    assert (found.rms.value[0] > 1.5 * exact).all()


def test_flatness_of_alpha_is_recovered_by_the_narrowest_kernels_and_lost_by_wide_ones(true, track):
    found = width_curve([track], "alpha_lab", settings=FEW)
    exact = (true.alpha_lab**4).mean(0) / np.square((true.alpha_lab**2).mean(0))
    assert (np.diff(found.corrected_flatness.value.mean(1)) < 0).all()
    assert found.corrected_flatness.value[0].mean() == pytest.approx(exact.mean(), rel=0.1)


def test_predicted_noise_is_what_a_standing_sphere_shows(track):
    rng = np.random.default_rng(6)
    still = replace(track, position=NOISE_MM * rng.standard_normal(track.position.shape))
    found = width_curve([still], "acceleration", settings=FEW)
    np.testing.assert_allclose(found.noise_share.value[:5], 1.0, atol=0.05)
    by_hand = 1e-3 * NOISE_MM * float(gaussian_kernel(2.0, 2).norm()) * 600.0**2
    np.testing.assert_allclose(found.rms.value[2], by_hand, rtol=0.03)
    assert np.isnan(found.corrected_flatness.value[:5]).all()  # nothing but noise


def test_one_segment_is_differentiated_as_motion_does_it(track):
    one = track.at(np.flatnonzero(track.segment < 2))
    found = width_curve([one], "acceleration", (2.0,), FEW)
    parts = [torch.from_numpy(one.position[one.segment == k]) for k in (0, 1)]
    values = np.concatenate([gaussian_derivative(x, 1 / 600, 2.0, 2).numpy() for x in parts]) * 1e-3
    np.testing.assert_allclose(found.rms.value[0], np.sqrt(np.nanmean(values**2, axis=0)), rtol=1e-6)


def test_a_lost_frame_is_not_differentiated_over(track):
    position = track.position.copy()
    position[::20] = np.nan
    found = width_curve([replace(track, position=position)], "acceleration", (1.0, 2.0), FEW)
    assert np.isfinite(found.rms.value).all()


def test_widths_of_tracks_of_two_rates_are_times(true, track):
    """Before: frames of each track's own rate, averaged as if they were of the first one."""
    part = true.at(np.flatnonzero(true.segment < 40))
    every = np.arange(len(part)) % 2 == 0
    slow = replace(part.at(np.flatnonzero(every)), frame_rate=part.frame_rate / 2)
    widths = (2.0, 4.0)
    of_slow = width_curve([slow], "acceleration", widths, FEW)
    of_fast = width_curve([part], "acceleration", [2 * width for width in widths], FEW)
    np.testing.assert_allclose(of_fast.rms.value, of_slow.rms.value, rtol=0.05)  # one motion, one width in s
    for both in ([slow, part], [part, slow]):
        found = width_curve(both, "acceleration", widths, FEW)
        np.testing.assert_allclose(found.width_s, of_slow.width_s)
        np.testing.assert_allclose(found.rms.value, of_slow.rms.value, rtol=0.05)


def test_tracks_of_two_rates_have_no_lags_in_common(track):
    slow = replace(track, time=2 * track.time, frame_rate=track.frame_rate / 2)
    with pytest.raises(TrackError, match="tracks of one frame rate") as caught:
        multi_lag([track, slow], "acceleration", settings=FEW)
    assert "\n" not in str(caught.value)


def test_a_track_of_one_frame_has_no_width_and_disturbs_no_other(track):
    alone = width_curve([track], "acceleration", (2.0,), FEW)
    for segment in (0, -1):
        one = replace(track.at(np.array([0])), segment=np.array([segment]))
        for both in ([one, track], [track, one]):
            found = width_curve(both, "acceleration", (2.0,), FEW)
            np.testing.assert_array_equal(found.rms.value, alone.rms.value)
            np.testing.assert_array_equal(found.width_s, alone.width_s)
