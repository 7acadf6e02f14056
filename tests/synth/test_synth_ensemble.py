import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from ensembles import EnsembleSpec, Law, draw_ensemble, filtered_track, nominal, smoothed_track
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from sphereorient.motion import omega_from_orientations
from sphereorient.statistics.moments import moments
from sphereorient.statistics.segments import ensemble_of
from sphereorient.statistics.settings import BootstrapSettings

FEW = BootstrapSettings(resamples=100)


def sample(law: Law, count: int = 200_000):
    rng = np.random.default_rng(1)
    return law.draw(count, rng).at(rng.uniform(0, 1, count), np.arange(count))


def flatness(x: np.ndarray) -> float:
    return float((x**4).mean() / (x**2).mean() ** 2)


@pytest.mark.slow
@pytest.mark.parametrize(("omega", "alpha"), [(4.0, 7.6), (3.5, 5.0), (3.0, 3.0)])
def test_a_law_has_its_given_moments(omega, alpha):
    rate, slope = sample(Law.of(7.8, 560.0, omega, alpha))
    assert rate.std() == pytest.approx(7.8, rel=0.01)
    assert slope.std() == pytest.approx(560, rel=0.01)
    assert flatness(rate) == pytest.approx(omega, rel=0.03)
    assert flatness(slope) == pytest.approx(alpha, rel=0.04)


def test_a_laws_derivative_is_its_derivative_and_its_integral_its_integral():
    law = Law.of(0.3, 5.5)
    draw = law.draw(2, np.random.default_rng(2))
    t, segment = np.linspace(0, 0.2, 20_001), np.zeros(20_001, dtype=np.int64)
    rate, slope = draw.at(t, segment)
    np.testing.assert_allclose(np.gradient(rate, t)[1:-1], slope[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(draw.integral(t, segment), t)[1:-1], rate[1:-1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["lab", "body"])
def test_true_moments_are_the_nominal_ones_in_both_frames(frame):
    spec = EnsembleSpec(segments=3000, mean_frames=70, frame=frame)
    true, expected = draw_ensemble(spec, 4), nominal(spec)
    for name, law in expected.items():
        x = getattr(true, name)
        np.testing.assert_allclose(np.sqrt((x**2).mean(0)), law.rms, rtol=0.02, err_msg=name)
        np.testing.assert_allclose((x**4).mean(0) / (x**2).mean(0) ** 2, law.flatness, rtol=0.08, err_msg=name)


@pytest.mark.parametrize("frame", ["lab", "body"])
def test_orientations_rotate_by_omega(frame):
    true = draw_ensemble(EnsembleSpec(segments=5, mean_frames=80, frame=frame, frame_rate_hz=6000.0), 5)
    omega, _ = omega_from_orientations(
        torch.from_numpy(true.orientation), 1 / 6000, (1,), segment=torch.from_numpy(true.segment)
    )
    off = omega.numpy() - true.omega_lab
    assert np.sqrt(np.nanmean(off**2)) < 2e-3
    np.testing.assert_allclose(np.einsum("nij,nj->ni", true.orientation, true.omega_body), true.omega_lab, atol=1e-9)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", true.orientation, true.alpha_body), true.alpha_lab, atol=1e-6)


def test_positions_move_by_the_velocity():
    true = draw_ensemble(EnsembleSpec(segments=3), 6)
    one = true.segment == 1
    moved = np.gradient(true.position[one], 1 / 600, axis=0)[1:-1] * 1e-3
    np.testing.assert_allclose(moved, true.velocity[one][1:-1], atol=2e-3)


@pytest.mark.slow
def test_durations_are_exponential_beyond_the_shortest():
    true = draw_ensemble(EnsembleSpec(segments=1000, mean_frames=70), 7)
    frames = np.bincount(true.segment)
    assert frames.min() >= 50
    assert kstest((frames - 50 + 0.5) / 20, "expon").pvalue > 0.01


def test_the_same_seed_gives_the_same_ensemble():
    spec = EnsembleSpec(segments=3)
    a, b, c = (draw_ensemble(spec, seed).orientation for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert a.shape != c.shape or (a != c).any()


def test_noise_has_its_size_and_the_kernels_track_its_sigmas():
    true = draw_ensemble(EnsembleSpec(segments=40), 8)
    track = filtered_track(true, 0.5, 0.02, 9)
    turned = Rotation.from_matrix(track.orientation) * Rotation.from_matrix(true.orientation).inv()
    assert np.degrees(turned.as_rotvec()).std() == pytest.approx(0.5, rel=0.02)
    assert (track.position - true.position).std() == pytest.approx(0.02, rel=0.02)
    assert track.orientation_cov[0, 0, 0] == pytest.approx(math.radians(0.5) ** 2)


def test_a_track_without_noise_has_the_ensembles_own_moments():
    true = draw_ensemble(EnsembleSpec(segments=20), 9)
    found = moments(ensemble_of(true), "alpha_body", FEW)
    np.testing.assert_allclose(found.rms.value[:3], true.alpha_body.std(0))
    np.testing.assert_allclose(found.corrected_rms.value[:3], found.rms.value[:3])


@pytest.mark.slow
def test_the_smoother_recovers_a_quiet_ensemble_and_warns_of_a_loud_one():
    true = draw_ensemble(EnsembleSpec(segments=30, mean_frames=100), 10)
    clean = ensemble_of(true)
    quiet, loud = (ensemble_of(smoothed_track(true, deg, 0.05, 11)[0]) for deg in (0.1, 2.0))
    same = np.isin(clean.time_s.round(7), quiet.time_s.round(7))  # the ends of segments do not count after smoothing
    assert same.sum() == len(quiet)
    for name in clean.values:
        found = moments(quiet, name, FEW)
        np.testing.assert_allclose(found.corrected_rms.value[:3], clean.values[name][same].std(0), rtol=0.01)
        assert not found.noisy
    found = moments(loud, "alpha_lab", FEW)
    assert found.noisy
    # the rms lacks motion that the smoother removed; added again, it is nearer, and never subtracted twice
    off, corrected_off = (
        abs(x.value[:3] / clean.values["alpha_lab"].std(0) - 1) for x in (found.rms, found.corrected_rms)
    )
    assert (corrected_off < off).all()


@pytest.mark.slow
def test_components_in_the_other_frame_are_isotropic_for_any_laws():
    spec = replace(EnsembleSpec(), omega_rms=(2.0, 8.0, 14.0))
    law = nominal(spec)["omega_body"]
    np.testing.assert_allclose(law.rms, math.sqrt((4 + 64 + 196) / 3))
    rng = np.random.default_rng(12)
    w = np.column_stack([sample_one(one, rng) for one in spec.omega_laws()])
    x = Rotation.random(len(w), rng).apply(w)
    assert flatness(x[:, 0]) == pytest.approx(law.flatness[0], rel=0.04)


def sample_one(law: Law, rng: np.random.Generator, count: int = 60_000) -> np.ndarray:
    return law.draw(count, rng).at(np.zeros(count), np.arange(count))[0]
