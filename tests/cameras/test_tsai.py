"""Tsai's distortion: which point its polynomial acts on, its inverse, and where it folds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from camera_examples import f64, level, tsai, turned, whole_picture
from conftest import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st

from sphereorient.cameras.brown import FOLD, shrinkage
from sphereorient.errors import CameraError


def test_the_polynomial_acts_on_the_distorted_point():
    # f = 10 mm, pixels of 1 mm. x_d = 10 mm, kappa1 = 1e-3: x_u = 10 (1 + 1e-3 * 100) = 11 mm, the point (1.1, 0, 1).
    camera = level(1e-3)
    assert_close(camera.project(f64((1.1, 0.0, 1.0))), f64((30.0, 20.0)))
    assert_close(camera.undistort(f64((30.0, 20.0))), f64((31.0, 20.0)))
    opencv_reading = 20 + 11 * (1 + 1e-3 * 11**2)  # the polynomial on the undistorted point: 12.331 mm
    opencv_inverse = 20 + 11 / (1 + 1e-3 * 11**2)  # 9.813 mm
    assert abs(opencv_reading - 30) > 2
    assert abs(opencv_inverse - 30) > 0.15


def test_the_radius_is_measured_on_the_sensor_and_not_in_pixels():
    camera = tsai(1e-3)
    u, v = 431.0, 128.5
    x_d, y_d = (u - 331.0) * 0.02 / 1.03, (v - 228.5) * 0.021
    scale = 1 + 1e-3 * (x_d**2 + y_d**2)
    expected = f64((331.0 + 1.03 * x_d * scale / 0.02, 228.5 + y_d * scale / 0.021))
    assert_close(camera.undistort(f64((u, v))), expected, atol=1e-10)


@settings(max_examples=100, deadline=None)
@given(bend=st.floats(-4 / 27 * 0.999, 1e4))
def test_shrinkage_agrees_with_the_roots_that_numpy_finds(bend):
    roots = np.roots([bend, 0.0, 1.0, -1.0]) if abs(bend) > 1e-9 else np.array([1.0 - bend])
    real = roots[np.abs(roots.imag) < 1e-7].real
    expected = real[np.argmin(np.abs(real - 1.0))]  # the branch through s(0) = 1
    atol = 1e-8 if bend < -0.147 else 1e-12  # beside the fold the roots are two close ones
    assert_close(shrinkage(f64(bend)), f64(expected), atol=atol * max(1.0, abs(expected)))


@pytest.mark.parametrize("bend", [0.0, 1e-300, -1e-300, 1e-12, -1e-12, -0.1, -0.148, 0.3, 50.0])
def test_shrinkage_has_right_first_and_second_derivatives_also_at_zero(bend):
    at = f64(bend).requires_grad_()
    s = shrinkage(at)
    (first,) = torch.autograd.grad(s, at, create_graph=True)
    (second,) = torch.autograd.grad(first, at)
    # q s^3 + s = 1: s' = -s^3 / (1 + 3 q s^2); differentiate once more by hand.
    slope = 1 + 3 * bend * s**2
    expected = -(s**3) / slope
    expected_second = -(6 * s**2 * expected + 6 * bend * s * expected**2) / slope
    torch.testing.assert_close(first, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(second, expected_second, rtol=1e-6, atol=1e-9)


def test_beyond_the_fold_there_is_no_picture_and_no_gradient():
    camera = tsai(-1.8e-3)
    far = f64([(331.0, 228.5), (5000.0, 228.5)]).requires_grad_()
    for bent in (camera.distort(far), camera.undistort(far)):
        assert torch.isnan(bent).all(-1).tolist() == [False, True]
        (gradient,) = torch.autograd.grad(torch.nan_to_num(bent).sum(), far)
        assert torch.isfinite(gradient).all()
    assert torch.isnan(shrinkage(f64(FOLD)))


def test_a_distortion_that_folds_inside_the_picture_is_refused():
    corners_mm = (whole_picture(steps=2) - f64((331.0, 228.5))) * f64((0.02 / 1.03, 0.021))
    fold = -1.0 / (3.0 * float(corners_mm.square().sum(-1).max()))
    camera = tsai(fold * 0.99)
    uv_px = whole_picture()
    assert_close(camera.distort(camera.undistort(uv_px)), uv_px, atol=1e-9)
    with pytest.raises(CameraError, match=r"kappa1: .* folds over"):
        tsai(fold * 1.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"f_mm": f64(-45.0)}, "f_mm: expected above zero"),
        ({"f_mm": f64(float("nan"))}, "f_mm: expected finite numbers"),
        ({"sx": f64(0.0)}, "sx: expected above zero"),
        ({"pixel_pitch_mm": f64((0.02, -0.02))}, "pixel_pitch_mm: expected above zero"),
        ({"centre_px": f64((1.0, 2.0, 3.0))}, "centre_px: expected shape"),
        ({"T_cam_lab_mm": f64((0.0, float("inf"), 0.0))}, "T_cam_lab_mm: expected finite numbers"),
        ({"R_cam_lab": 1.01 * turned()}, "R_cam_lab: .* det = 1.03"),
        ({"R_cam_lab": f64([[1, 0, 0], [0, 1, 0], [0, 0, -1]])}, "R_cam_lab: .* det = -1"),
        ({"R_cam_lab": torch.eye(2, dtype=torch.float64)}, "R_cam_lab: expected shape"),
        ({"image_size": (650, 0)}, "image_size: expected two whole numbers"),
        ({"image_size": (650, 480, 3)}, "image_size: expected two whole numbers"),
        ({"image_size": (650.5, 480)}, "image_size: expected two whole numbers"),
    ],
)
def test_an_impossible_camera_is_refused_in_one_line(changes, message):
    with pytest.raises(CameraError, match=message) as refused:
        tsai(**changes)
    assert "\n" not in str(refused.value)
