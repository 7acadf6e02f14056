"""The view frame (docs/errata.md A1)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from camera_examples import f64
from conftest import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sphereorient.cameras import PinholeCamera, R_cam_view, without_perspective
from sphereorient.errors import ShapeError

Z = f64((0.0, 0.0, 1.0))


@settings(deadline=None)
@given(x=st.floats(-3, 3), y=st.floats(-3, 3), z=st.floats(0.1, 3))
def test_it_is_the_turn_about_z_cross_direction_that_scipy_makes(x, y, z):
    axis = np.array([-y, x, 0.0])
    sine = np.linalg.norm(axis)
    rotvec = axis / sine * np.arctan2(sine, z) if sine > 0 else axis
    assert_close(R_cam_view(f64((x, y, z))), torch.from_numpy(Rotation.from_rotvec(rotvec).as_matrix()), atol=1e-12)


def test_its_last_column_is_the_direction_to_the_sphere():
    R = R_cam_view(f64((3.0, 0.0, 4.0)))
    assert_close(R @ Z, f64((0.6, 0.0, 0.8)))
    assert_close(R, f64([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]))
    # The paper's R_persp, read in a frame with z forward, rotates the other way: its transpose fails.
    assert not torch.allclose(R.mT @ Z, f64((0.6, 0.0, 0.8)))


@pytest.mark.parametrize("aside", [0.0, 1e-30, 1e-9, 1e-4])
def test_straight_ahead_value_and_gradient_are_finite(aside, dtype, tolerance):
    direction = torch.tensor([aside, -aside, 2.0], dtype=dtype, requires_grad=True)
    R = R_cam_view(direction)
    assert_close(R[:, 2], torch.tensor([aside / 2, -aside / 2, 1.0], dtype=dtype), atol=max(tolerance, 1e-8))
    jacobian = torch.autograd.functional.jacobian(R_cam_view, direction)
    assert torch.isfinite(jacobian).all()
    assert_close(jacobian[0, 2, 0], torch.tensor(0.5, dtype=dtype), atol=max(tolerance, 1e-7))


def test_gradients_are_right(rng):
    direction = (torch.rand(5, 3, generator=rng, dtype=torch.float64) + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(R_cam_view, direction)


def test_straight_backwards_there_is_no_view_frame():
    direction = f64([(0.0, 0.0, -1.0), (0.0, 0.0, 1.0)]).requires_grad_()
    R = R_cam_view(direction)
    assert torch.isnan(R[0]).all()
    (gradient,) = torch.autograd.grad(torch.nan_to_num(R).sum(), direction)
    assert torch.isfinite(gradient).all()


def test_a_batch_is_the_stack_of_its_singles(rng, dtype, tolerance, batch):
    direction = torch.rand(*batch, 3, generator=rng, dtype=torch.float64).to(dtype) + 0.1
    R = R_cam_view(direction)
    assert R.shape == (*batch, 3, 3)
    assert R.dtype == dtype
    for single, expected in zip(direction.reshape(-1, 3), R.reshape(-1, 3, 3), strict=True):
        assert_close(R_cam_view(single), expected, atol=tolerance)


def test_another_last_axis_is_refused():
    with pytest.raises(ShapeError, match="direction_cam: expected shape"):
        R_cam_view(torch.zeros(4, 2))


def test_without_perspective_the_side_that_faces_the_camera_seems_to_face_along_its_axis():
    camera = PinholeCamera(
        R_cam_lab=torch.from_numpy(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()),
        T_cam_lab_mm=f64((10.0, -20.0, 500.0)),
        f_px=f64(2000.0),
        centre_px=f64((320.0, 320.0)),
        image_size=(640, 640),
    )
    rng = np.random.default_rng(4)
    R = Rotation.random(62, rng).as_matrix()
    uv = torch.from_numpy(rng.uniform(0, 640, (62, 2)))
    found = without_perspective(camera, uv, torch.from_numpy(R)).numpy()
    sight = camera.rays(uv).direction_lab.numpy()
    axis_lab = camera.R_cam_lab.numpy()[2]
    facing_body = np.einsum("nji,nj->ni", R, sight)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", found, facing_body), np.tile(axis_lab, (62, 1)), atol=1e-12)
    turned = Rotation.from_matrix(found @ R.swapaxes(1, 2)).magnitude()
    np.testing.assert_allclose(turned, np.arccos(sight @ axis_lab), atol=1e-7)
