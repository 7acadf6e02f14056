from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from statistics_examples import ensemble, track

from sphereorient.cameras import PinholeCamera
from sphereorient.errors import TrackError
from sphereorient.statistics.cameras import camera_distances, without_perspective
from sphereorient.statistics.flow import comparisons, flow_scales, lift
from sphereorient.statistics.moments import table_of_moments
from sphereorient.statistics.segments import durations
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.trajectory import CameraTrack

FEW = BootstrapSettings(resamples=200)


def test_decay_time_of_truncated_durations_and_its_interval():
    rng = np.random.default_rng(1)
    held, means = 0, []
    for _ in range(500):
        found = durations(0.08 + rng.exponential(0.15, 40), 0.08)
        held += bool(found.decay_time_s.holds(0.15))
        means.append(float(found.decay_time_s.value))
    assert 0.92 <= held / 500 <= 0.98
    assert np.mean(means) == pytest.approx(0.15, rel=0.02)


def test_every_duration_is_counted_and_the_law_expects_nearly_as_many():
    span = 0.08 + np.random.default_rng(2).exponential(0.15, 3000)
    found = durations(span, 0.08)
    assert found.counts.sum() == found.segments == 3000
    assert found.expected.sum() == pytest.approx(3000, rel=0.01)
    assert np.abs(found.counts - found.expected)[:5].max() < 5 * np.sqrt(found.expected[0])


def test_shorter_durations_do_not_count():
    assert durations(np.array([0.01, 0.2, 0.3]), 0.1).segments == 2
    with pytest.raises(TrackError, match="two segments"):
        durations(np.array([0.01, 0.2]), 0.1)


@pytest.mark.parametrize(
    ("viscosity", "dissipation", "eta_um", "tau_ms"), [(1e-6, 1.0, 31.6, 1.0), (8e-6, 1.7, 131.7, 2.17)]
)
def test_kolmogorovs_scales_of_water_and_of_the_mix(viscosity, dissipation, eta_um, tau_ms):  # ERRATA A5
    found = flow_scales(viscosity, dissipation)
    assert found.eta_m * 1e6 == pytest.approx(eta_um, rel=1e-3)
    assert found.tau_eta_s * 1e3 == pytest.approx(tau_ms, rel=2e-3)


def test_dimensionless_numbers_that_a_person_works_out_by_hand():
    rng = np.random.default_rng(3)
    values = {
        name: scale * rng.choice([-1.0, 1.0], (1000, 3)) for name, scale in (("velocity", 0.36), ("omega_lab", 8.0))
    }
    table = table_of_moments(ensemble([100] * 10, **values), FEW)
    flow = flow_scales(8e-6, 1.7)
    rows = comparisons(table, 18.0, flow, u_rms_m_s=0.6, integral_length_m=0.03)
    found = {row.formula: row.value for row in rows}
    assert found["u_rms / D"] == pytest.approx(33.333, rel=1e-3)
    assert found["omega_rms D / u_rms"] == pytest.approx(0.24, rel=1e-2)
    assert found["D / eta"] == pytest.approx(136.7, rel=1e-2)
    assert found["D / L"] == pytest.approx(0.6)
    assert "u_rms / D" not in {row.formula for row in comparisons(table, 18.0)}


def test_a_planted_lift_is_found_with_its_coefficient():
    rng = np.random.default_rng(4)
    v, omega = rng.standard_normal((2, 20_000, 3))
    a = 0.7 * np.cross(omega, v) + rng.standard_normal((20_000, 3))
    found = lift(ensemble([100] * 200, velocity=v, omega_lab=omega, acceleration=a), FEW)
    assert found.coefficient.holds(0.7).sum() >= 3
    expected = 0.7 * np.sqrt(2) / np.sqrt(0.49 * 2 + 1)
    assert found.correlation.value[3] == pytest.approx(expected, abs=0.02)


def test_without_lift_there_is_no_correlation():
    found = lift(ensemble([100] * 200), FEW)
    assert (np.abs(found.correlation.value) < 4 * found.correlation.error).all()
    assert found.correlation.error[3] == pytest.approx(1 / np.sqrt(60_000), rel=0.3)


def seen(R: np.ndarray) -> CameraTrack:
    return replace(CameraTrack.empty(len(R)), orientation=R)


def test_distances_of_two_cameras_are_the_planted_angles():
    whole = track([60])
    rng = np.random.default_rng(5)
    first = Rotation.random(len(whole), rng)
    angle = rng.uniform(1e-6, np.pi - 1e-3, len(whole))
    axis = rng.standard_normal((len(whole), 3))
    second = first * Rotation.from_rotvec(angle[:, None] * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    A, B = first.as_matrix(), second.as_matrix()
    A[3] = np.nan
    (found,) = camera_distances(replace(whole, cameras={"cam2": seen(B), "cam1": seen(A)}))
    np.testing.assert_allclose(found.distance_rad, np.delete(angle, 3), atol=1e-6)
    assert found.cameras == ("cam1", "cam2")
    assert (found.pdf * np.diff(found.edges_rad)).sum() == pytest.approx(1)
    assert found.uncorrected_rad is None


def test_distances_without_the_correction_come_beside_where_given():
    whole = track([60])
    unit = np.tile(np.eye(3), (len(whole), 1, 1))
    turned = Rotation.from_rotvec([0.2, 0, 0]).as_matrix() @ unit
    both = replace(whole, cameras={"a": seen(unit), "b": seen(unit)})
    (found,) = camera_distances(both, [{"a": unit, "b": turned}])
    assert found.median_rad == pytest.approx(0)
    np.testing.assert_allclose(found.uncorrected_rad, 0.2)


def test_one_camera_has_no_distance():
    assert camera_distances(replace(track([60]), cameras={"a": CameraTrack.empty(62)})) == []


def test_without_perspective_the_side_that_faces_the_camera_seems_to_face_along_its_axis():
    camera = PinholeCamera(
        R_cam_lab=torch.from_numpy(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()),
        T_cam_lab_mm=torch.tensor([10.0, -20.0, 500.0], dtype=torch.float64),
        f_px=torch.tensor(2000.0, dtype=torch.float64),
        centre_px=torch.tensor([320.0, 320.0], dtype=torch.float64),
        image_size=(640, 640),
    )
    whole = track([60])
    count = len(whole)
    rng = np.random.default_rng(4)
    R = Rotation.random(count, rng).as_matrix()
    uv = rng.uniform(0, 640, (count, 2))
    one = replace(CameraTrack.empty(count), orientation=R, centre_px=uv)
    found = without_perspective(replace(whole, cameras={"cam": one, "other": one}), {"cam": camera})
    assert list(found) == ["cam"]
    sight = camera.rays(torch.from_numpy(uv)).direction_lab.numpy()
    axis_lab = camera.R_cam_lab.numpy()[2]
    facing_body = np.einsum("nji,nj->ni", R, sight)
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", found["cam"], facing_body), np.tile(axis_lab, (count, 1)), atol=1e-12
    )
    turned = Rotation.from_matrix(found["cam"] @ R.swapaxes(1, 2)).magnitude()
    np.testing.assert_allclose(turned, np.arccos(sight @ axis_lab), atol=1e-7)


def test_distances_of_many_tracks_are_pooled_by_the_names_of_the_cameras():
    unit, turned = (np.tile(Rotation.from_rotvec([0, 0, x]).as_matrix(), (62, 1, 1)) for x in (0.0, 0.2))
    two = {name: replace(CameraTrack.empty(62), orientation=R) for name, R in (("a", unit), ("b", turned))}
    one = replace(track([60]), cameras=two)
    (found,) = camera_distances([one, one, replace(track([60]), cameras={})], [None, {"a": unit, "b": unit}])
    assert len(found.distance_rad) == 124
    assert found.median_rad == pytest.approx(0.2)
    assert len(found.uncorrected_rad) == 62
    assert found.uncorrected_rad.max() == 0.0
