import numpy as np
from scipy.spatial.transform import Rotation

from sphereorient.trajectory.rotations import (
    distance_deg,
    rotation_vectors,
    rotations,
    tait_bryan,
    tait_bryan_sigma,
)

R = Rotation.from_rotvec([[0.3, -0.5, 0.8], [1.1, 0.2, -0.4]]).as_matrix()


def test_sigmas_of_angles_are_those_of_differences():
    cov = np.diag([1.0, 4.0, 9.0]) + 0.5
    step = 1e-6
    turned = [[Rotation.from_rotvec(s * axis).as_matrix() @ R for s in (step, -step)] for axis in np.eye(3)]
    by_turn = np.stack([(tait_bryan(more) - tait_bryan(less)) / (2 * step) for more, less in turned], axis=2)
    expected = np.sqrt(np.einsum("nij,jk,nik->ni", by_turn, cov, by_turn))
    np.testing.assert_allclose(tait_bryan_sigma(R, np.tile(cov, (2, 1, 1))), expected, rtol=1e-6)


def test_near_a_pole_no_sigma_is_known():
    pole = Rotation.from_euler("y", [90.0], degrees=True).as_matrix()
    assert np.isnan(tait_bryan_sigma(pole, np.eye(3)[None])).all()


def test_rotation_vectors_are_those_of_scipy_and_unknown_ones_stay_unknown():
    some = np.concatenate([R, np.full((1, 3, 3), np.nan)])
    np.testing.assert_allclose(rotation_vectors(some)[:2], Rotation.from_matrix(R).as_rotvec(), atol=1e-12)
    assert np.isnan(rotation_vectors(some)[2]).all()
    np.testing.assert_allclose(rotations(rotation_vectors(R)), R, atol=1e-12)
    apart = (Rotation.from_matrix(R[0]).inv() * Rotation.from_matrix(R[1])).magnitude()
    np.testing.assert_allclose(distance_deg(R[:1], R[1:]), np.rad2deg(apart), atol=1e-9)
