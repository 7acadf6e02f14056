from __future__ import annotations

import numpy as np
import pytest
from statistics_examples import ensemble

from sphereorient.statistics.isotropy import anisotropic_frame, frame_of_omega, isotropy, zero_mean_p_value
from sphereorient.statistics.segments import ensemble_of
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.synth.ensemble import EnsembleSpec, draw_ensemble, exact_track

FEW = BootstrapSettings(resamples=100)
UNEQUAL = {"omega_rms": (6.0, 8.0, 10.0)}


def verdict(spec: EnsembleSpec) -> str:
    found = ensemble_of(exact_track(draw_ensemble(spec, 1)))
    return anisotropic_frame(isotropy(found, "omega_lab", FEW), isotropy(found, "omega_body", FEW))


@pytest.mark.parametrize("frame", ["lab", "body"])
def test_the_frame_that_has_axes_is_told_from_the_other(frame):  # ERRATA E6
    assert verdict(EnsembleSpec(segments=200, mean_frames=120, frame=frame, **UNEQUAL)) == frame


def test_equal_components_are_isotropic_in_both():
    assert verdict(EnsembleSpec(segments=200, mean_frames=120, omega_rms=(8.0, 8.0, 8.0))) == "neither"


def test_right_size_with_correlated_unequal_segments():
    rng = np.random.default_rng(2)
    wrong = 0
    for _ in range(400):
        lengths = 5 + rng.geometric(0.1, 100)
        x = np.repeat(rng.standard_normal((100, 3)), lengths, axis=0) + 0.3 * rng.standard_normal((lengths.sum(), 3))
        wrong += not isotropy(ensemble(lengths.tolist(), velocity=x), "velocity", FEW).isotropic
    assert 0.02 <= wrong / 400 <= 0.09


def test_shares_and_correlations_are_those_of_the_covariance():
    C = np.array([[4.0, 1.0, 0.0], [1.0, 1.0, -0.5], [0.0, -0.5, 2.0]])
    x = np.random.default_rng(3).multivariate_normal(np.zeros(3), C, 100_000)
    found = isotropy(ensemble([1000] * 100, velocity=x), "velocity", FEW)
    np.testing.assert_allclose(found.variance_share.value, np.diag(C) / 7, atol=0.01)
    np.testing.assert_allclose(found.cross_correlation.value, [0.5, 0.0, -0.5 / np.sqrt(2)], atol=0.02)
    assert not found.isotropic


def test_the_verdict_does_not_depend_on_the_choice_of_axes():
    from scipy.spatial.transform import Rotation

    x = np.random.default_rng(4).standard_normal((3000, 3)) * [1.0, 1.1, 1.0]
    turned = Rotation.random(rng=5).apply(x)
    one, other = (isotropy(ensemble([30] * 100, velocity=y), "velocity", FEW).p_value for y in (x, turned))
    assert one == pytest.approx(other, rel=1e-6)


def test_hotelling_in_one_dimension_is_students_test():
    from scipy.stats import ttest_1samp

    x = np.random.default_rng(6).standard_normal((30, 1)) + 0.2
    assert zero_mean_p_value(x) == pytest.approx(ttest_1samp(x[:, 0], 0).pvalue)


def test_a_row_of_table_i_that_belongs_to_no_frame_is_found():  # ERRATA E6
    true = draw_ensemble(EnsembleSpec(segments=20, mean_frames=60), 2)
    found = ensemble_of(exact_track(true))
    assert frame_of_omega(found, found.values["omega_lab"]).frame == "lab"
    assert frame_of_omega(found, found.values["omega_body"]).frame == "body"
    printed = np.einsum("nij,nj->ni", found.R_lab_body, found.values["omega_lab"])
    assert frame_of_omega(found, printed).frame == "none"
