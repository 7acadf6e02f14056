"""OpenCV's camera against OpenCV: points to pixels, pixels to slopes, and distortions that fold."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from camera_examples import ROTVEC, T_MM, brown, f64, whole_picture
from conftest import assert_close
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sphereorient.cameras.brown import BrownCamera, bent, fold2, straightened
from sphereorient.errors import CameraError


def opencv_parameters(camera: BrownCamera) -> tuple[np.ndarray, np.ndarray]:
    (fx, fy), (cx, cy) = camera.f_px.tolist(), camera.centre_px.tolist()
    (k1, k2, k3), (p1, p2) = camera.k.tolist(), camera.p.tolist()
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, p1, p2, k3])


def test_points_appear_where_opencv_puts_them(rng):
    x_lab_mm = (torch.rand(200, 3, generator=rng, dtype=torch.float64) - 0.5) * 200
    K, distortion = opencv_parameters(brown())
    expected, _ = cv2.projectPoints(x_lab_mm.numpy(), np.array(ROTVEC), np.array(T_MM), K, distortion)
    assert_close(brown().project(x_lab_mm), torch.from_numpy(expected[:, 0]), atol=1e-9)
    # p1 and p2 the other way round, as OpenPTV counts them, is another camera.
    assert (brown(p=brown().p.flip(0)).project(x_lab_mm) - brown().project(x_lab_mm)).abs().max() > 0.05


def test_pixels_are_undistorted_as_by_opencv():
    uv_px = whole_picture()
    K, distortion = opencv_parameters(brown())
    slope = (brown().undistort(uv_px) - brown().centre_px) / brown().f_px
    ahead = torch.nn.functional.pad(slope, (0, 1), value=1.0).numpy()
    there, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), K, distortion)
    assert_close(torch.from_numpy(there[:, 0]), uv_px, atol=1e-6)
    # OpenCV's own way back stops after a few rounds.
    back = cv2.undistortPoints(uv_px.numpy()[:, None], K, distortion, None, None, K)
    assert_close(brown().undistort(uv_px), torch.from_numpy(back[:, 0]), atol=0.1)


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(
    k=st.tuples(st.floats(-0.4, 0.6), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2)),
    p=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
    f_px=st.tuples(st.floats(500, 3000), st.floats(500, 3000)),
    centre=st.tuples(st.floats(250, 400), st.floats(180, 300)),
    distance_mm=st.floats(50, 5000),
)
def test_project_undoes_rays_over_the_whole_picture(k, p, f_px, centre, distance_mm):
    try:
        camera = brown(k=f64(k), p=f64(p), f_px=f64(f_px), centre_px=f64(centre))
    except CameraError:
        assume(False)
    uv_px = whole_picture()
    rays = camera.rays(uv_px)
    assert_close(camera.project(rays.origin_lab_mm + distance_mm * rays.direction_lab), uv_px, atol=1e-6)


def test_second_derivatives_of_the_way_back_are_right():
    k, p = f64((-0.2, 0.1, 0.02)).requires_grad_(), f64((2e-3, -1e-3)).requires_grad_()
    xy = f64([[0.3, -0.4], [0.0, 0.0]]).requires_grad_()
    assert torch.autograd.gradgradcheck(straightened, (xy, k, p))


def test_beyond_the_fold_there_is_no_picture_and_no_gradient():
    # r (1 - r^2 / 3) turns back at r = 1, where it reaches 2/3.
    k, p = f64((-1 / 3, 0.0, 0.0)), f64((0.0, 0.0))
    assert fold2(k) == pytest.approx(1.0)
    xy = f64([[0.6, 0.0], [1.1, 0.0], [0.0, 3.0]]).requires_grad_()
    moved = bent(xy, k, p)
    assert torch.isnan(moved).all(-1).tolist() == [False, True, True]
    (gradient,) = torch.autograd.grad(torch.nan_to_num(moved).sum(), xy)
    assert (gradient[1:] == 0).all()
    back = straightened(f64([[0.66, 0.0], [0.67, 0.0]]), k, p)
    assert torch.isnan(back).all(-1).tolist() == [False, True]
    assert_close(bent(back[:1], k, p), f64([[0.66, 0.0]]))


def test_a_strong_distortion_that_rises_everywhere_never_folds():
    k, p = f64((5.0, 2.0, 1.0)), f64((0.0, 0.0))
    assert fold2(k) == float("inf")
    xy = f64([[0.0, 0.0], [1e-9, 0.0], [1.0, 1.0], [3.0, -4.0]])
    assert_close(straightened(bent(xy, k, p), k, p), xy, atol=1e-10)


@pytest.mark.parametrize(
    "changes",
    [{"k": f64((-1.5, 0.0, 0.0))}, {"k": f64((0.0, 0.0, -30.0))}, {"p": f64((0.5, 0.0))}],
    ids=["k1", "k3", "p1"],
)
def test_a_distortion_that_folds_inside_the_picture_is_refused(changes):
    with pytest.raises(CameraError, match=r"k, p: .* folds before"):
        brown(**changes)
