import numpy as np
import pytest
from ensembles import EnsembleSpec, draw_ensemble
from scipy.spatial.transform import Rotation
from statistics_examples import ensemble

from sphereorient.statistics.isotropy import (
    anisotropic_frame,
    euler_densities,
    five_dimensional,
    frame_of_omega,
    isotropy,
    uniformity,
    zero_mean_p_value,
)
from sphereorient.statistics.segments import ensemble_of
from sphereorient.statistics.settings import BootstrapSettings

FEW = BootstrapSettings(resamples=100)
UNEQUAL = {"omega_rms": (6.0, 8.0, 10.0)}


def verdict(spec: EnsembleSpec) -> str:
    found = ensemble_of(draw_ensemble(spec, 1))
    return anisotropic_frame(isotropy(found, "omega_lab", FEW), isotropy(found, "omega_body", FEW))


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["lab", "body"])
def test_the_frame_that_has_axes_is_distinguished_from_the_other(frame):  # docs/errata.md E6
    assert verdict(EnsembleSpec(segments=200, mean_frames=120, frame=frame, **UNEQUAL)) == frame


@pytest.mark.slow
def test_equal_components_are_isotropic_in_both():
    assert verdict(EnsembleSpec(segments=200, mean_frames=120, omega_rms=(8.0, 8.0, 8.0))) == "neither"


@pytest.mark.slow
def test_right_size_with_correlated_unequal_segments():
    rng = np.random.default_rng(2)
    wrong = 0
    for _ in range(400):
        lengths = 5 + rng.geometric(0.1, 100)
        x = np.repeat(rng.standard_normal((100, 3)), lengths, axis=0) + 0.3 * rng.standard_normal((lengths.sum(), 3))
        wrong += isotropy(ensemble(lengths.tolist(), velocity=x), "velocity", FEW).p_value < 0.05
    assert 0.02 <= wrong / 400 <= 0.09


def test_shares_and_correlations_are_those_of_the_covariance():
    C = np.array([[4.0, 1.0, 0.0], [1.0, 1.0, -0.5], [0.0, -0.5, 2.0]])
    x = np.random.default_rng(3).multivariate_normal(np.zeros(3), C, 100_000)
    found = isotropy(ensemble([1000] * 100, velocity=x), "velocity", FEW)
    np.testing.assert_allclose(found.variance_share.value, np.diag(C) / 7, atol=0.01)
    np.testing.assert_allclose(found.cross_correlation.value, [0.5, 0.0, -0.5 / np.sqrt(2)], atol=0.02)
    assert found.p_value < 0.05


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


def test_a_row_of_table_i_that_belongs_to_no_frame_is_found():  # docs/errata.md E6
    true = draw_ensemble(EnsembleSpec(segments=20, mean_frames=60), 2)
    found = ensemble_of(true)
    assert frame_of_omega(found, found.values["omega_lab"]).frame == "lab"
    assert frame_of_omega(found, found.values["omega_body"]).frame == "body"
    printed = np.einsum("nij,nj->ni", found.R_lab_body, found.values["omega_lab"])
    assert frame_of_omega(found, printed).frame == "none"


REPETITIONS = 300


def rejected(draw, repetitions=REPETITIONS) -> float:
    """Share of repetitions that the test rejects at 5 %."""
    return float(np.mean([not uniformity(*draw(np.random.default_rng(seed))).uniform for seed in range(repetitions)]))


def test_the_five_dimensional_matrices_are_a_representation():
    A, B = Rotation.random(20, 1), Rotation.random(20, 2)
    both = five_dimensional((A * B).as_matrix())
    np.testing.assert_allclose(both, five_dimensional(A.as_matrix()) @ five_dimensional(B.as_matrix()), atol=1e-12)
    np.testing.assert_allclose(both @ both.swapaxes(1, 2), np.tile(np.eye(5), (20, 1, 1)), atol=1e-12)
    angle = (A * B).magnitude()
    np.testing.assert_allclose(np.trace(both, axis1=1, axis2=2), np.sin(2.5 * angle) / np.sin(angle / 2), atol=1e-9)


@pytest.mark.slow
def test_the_statistic_of_independent_attitudes_has_the_mean_of_chi_squared():
    values = [uniformity(Rotation.random(300, seed).as_matrix()).statistic for seed in range(200)]
    assert np.mean(values) == pytest.approx(34, abs=3 * np.sqrt(68 / 200))


@pytest.mark.slow
def test_size_on_independent_attitudes():
    share = rejected(lambda rng: (Rotation.random(100, rng).as_matrix(),), 600)
    assert 0.03 <= share <= 0.07


def walks(rng: np.random.Generator, segments: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Uniform starts and slow random rotations in segments of unequal length."""
    lengths = 20 + rng.geometric(1 / 30, segments)
    segment = np.repeat(np.arange(segments), lengths)
    R = np.empty((len(segment), 3, 3))
    now, first = Rotation.random(segments, rng), np.concatenate([[0], np.cumsum(lengths)[:-1]])
    for k in range(lengths.max()):
        alive = lengths > k
        R[first[alive] + k] = now.as_matrix()[alive]
        now = Rotation.from_rotvec(0.08 * rng.standard_normal((segments, 3))) * now
    return R, segment


@pytest.mark.slow
def test_size_on_tracks_with_the_allowance_for_correlation():
    share = rejected(walks)
    assert 0.03 <= share <= 0.07


@pytest.mark.slow
def test_without_the_allowance_tracks_would_be_rejected_nearly_always():
    assert rejected(lambda rng: walks(rng)[:1], 20) > 0.9


def test_effective_number_is_near_that_of_the_segments_where_they_hardly_turn():
    R = Rotation.random(400, 3).as_matrix()
    found = uniformity(np.repeat(R, 30, axis=0), np.repeat(np.arange(400), 30))
    assert found.effective == pytest.approx(400, rel=1e-6)
    assert found.p_value == pytest.approx(uniformity(R).p_value, abs=0.01)


def biased(rng: np.random.Generator) -> tuple[np.ndarray]:
    """One attitude in seven lies within 20 degrees or so of a preferred one."""
    R = Rotation.random(600, rng)
    near = Rotation.from_rotvec(0.35 * rng.standard_normal((600, 3)))
    return (np.where((rng.uniform(size=600) < 0.14)[:, None, None], near.as_matrix(), R.as_matrix()),)


def axial(rng: np.random.Generator) -> tuple[np.ndarray]:
    """An axis of the body prefers the vertical, up or down alike: no mean, only a second moment."""
    R = Rotation.random(1500, rng).as_matrix()
    return (R[rng.uniform(size=1500) < (0.5 + 0.5 * R[:, 2, 2] ** 2)],)


@pytest.mark.slow
@pytest.mark.parametrize("draw", [biased, axial])
def test_a_slight_bias_is_found(draw):
    assert rejected(draw, 100) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["lab", "body"])
def test_uniform_synthetic_tracks_pass_mostly(frame):
    spec = EnsembleSpec(segments=80, mean_frames=60, frame=frame)
    tracks = [draw_ensemble(spec, seed) for seed in range(10)]
    assert np.mean([uniformity(t.orientation, t.segment).p_value < 0.01 for t in tracks]) <= 0.1


def test_euler_angles_of_uniform_attitudes_follow_the_uniform_law():
    densities = euler_densities(ensemble([200] * 300), settings=BootstrapSettings(resamples=200))
    for one in densities:
        width = np.diff(one.edges_rad)
        assert (one.uniform * width).sum() == pytest.approx(1)
        assert (one.pdf.value * width).sum() == pytest.approx(1)
        off = (one.pdf.value - one.uniform) / one.pdf.error
        assert np.sqrt((off**2).mean()) < 1.6
