"""Laws of every camera: pictures of points, lines of sight, each the inverse of the other."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from camera_examples import (
    ROTVEC,
    T_MM,
    behind_port,
    brown,
    f64,
    fisheye,
    openptv,
    pinhole,
    telecentric,
    tsai,
    whole_picture,
)
from conftest import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st

from sphereorient.cameras import Camera, centre_lab_mm, perspective_centre_lab_mm, sphere_radius_px
from sphereorient.cameras.model import focal_of_field, middle_of_picture
from sphereorient.errors import CameraError, ShapeError

CAMERAS = {
    "tsai": tsai(),
    "tsai_barrel": tsai(-3e-4),
    "pinhole": pinhole(),
    "brown": brown(),
    "openptv": openptv(),
    "fisheye": fisheye(),
    "telecentric": telecentric(),
}
WALLS = {f"{name}, port": behind_port(CAMERAS[name]) for name in ("tsai", "openptv", "fisheye", "telecentric")}
CAMERAS |= WALLS


@pytest.fixture(params=CAMERAS.values(), ids=CAMERAS)
def camera(request: pytest.FixtureRequest) -> Camera:
    return request.param


def points(rng: torch.Generator, *shape: int) -> torch.Tensor:
    return (torch.rand(*shape, 3, generator=rng, dtype=torch.float64) - 0.5) * 150


def oracle(camera: Camera, x_lab_mm: torch.Tensor) -> torch.Tensor:
    K = np.eye(3)
    K[[0, 1], [0, 1]] = camera.focal_px.numpy()
    K[:2, 2] = camera.centre_px.numpy()
    uv, _ = cv2.projectPoints(x_lab_mm.numpy(), np.array(ROTVEC), np.array(T_MM), K, None)
    return torch.from_numpy(uv[:, 0])


@pytest.mark.parametrize("camera", [tsai(0.0), pinhole()], ids=["tsai", "pinhole"])
def test_without_distortion_points_appear_where_opencv_puts_them(camera, rng):
    x_lab_mm = points(rng, 200)
    assert_close(camera.project(x_lab_mm), oracle(camera, x_lab_mm), atol=1e-9)


def test_a_ray_goes_through_every_point_of_its_pixel(camera, rng):
    x_lab_mm = points(rng, 200)
    rays = camera.rays(camera.project(x_lab_mm))
    along = ((x_lab_mm - rays.origin_lab_mm) * rays.direction_lab).sum(-1, keepdim=True)
    assert (along > 0).all()
    assert_close(rays.origin_lab_mm + along * rays.direction_lab, x_lab_mm, atol=1e-9)
    assert_close(rays.direction_lab.norm(dim=-1), torch.ones(200, dtype=torch.float64))


@settings(max_examples=60, deadline=None)
@given(
    kappa1=st.floats(-5e-3, 5e-3),
    sx=st.floats(0.8, 1.2),
    f_mm=st.floats(5, 200),
    centre=st.tuples(st.floats(200, 450), st.floats(150, 330)),
    distance_mm=st.floats(50, 5000),
)
def test_project_undoes_rays_over_the_whole_picture(kappa1, sx, f_mm, centre, distance_mm):
    # The farthest corner lies up to 11.6 mm off the axis: -1 / (3 * 11.6^2) = -2.5e-3 is the fold; stay inside it.
    camera = tsai(max(kappa1, -1.8e-3), sx=f64(sx), f_mm=f64(f_mm), centre_px=f64(centre))
    uv_px = whole_picture()
    rays = camera.rays(uv_px)
    x_lab_mm = rays.origin_lab_mm + distance_mm * rays.direction_lab
    assert_close(camera.project(x_lab_mm), uv_px, atol=1e-9)


def test_distort_and_undistort_are_inverse_over_the_whole_picture(camera):
    uv_px = whole_picture()
    assert_close(camera.distort(camera.undistort(uv_px)), uv_px, atol=1e-9)
    assert_close(camera.undistort(camera.distort(uv_px)), uv_px, atol=1e-9)


def test_a_batch_is_the_stack_of_its_singles(camera, rng, dtype, batch):
    x_lab_mm = points(rng, *batch).to(dtype)
    uv_px = camera.project(x_lab_mm)
    rays = camera.rays(uv_px)
    assert uv_px.shape == (*batch, 2)
    assert rays.origin_lab_mm.shape == rays.direction_lab.shape == (*batch, 3)
    assert uv_px.dtype == rays.origin_lab_mm.dtype == rays.direction_lab.dtype == dtype
    assert_close(uv_px.double(), camera.project(x_lab_mm.double()), atol=2e-3 if dtype == torch.float32 else 0.0)
    for point, uv, direction in zip(
        x_lab_mm.reshape(-1, 3), uv_px.reshape(-1, 2), rays.direction_lab.reshape(-1, 3), strict=True
    ):
        assert_close(camera.project(point), uv, atol=2e-3 if dtype == torch.float32 else 1e-10)
        assert_close(camera.rays(uv).direction_lab, direction, atol=1e-6 if dtype == torch.float32 else 1e-12)


def test_gradients_with_respect_to_points_and_pixels_are_right(camera, rng):
    x_lab_mm = points(rng, 5).requires_grad_()
    assert torch.autograd.gradcheck(camera.project, x_lab_mm)
    uv_px = camera.project(x_lab_mm).detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda uv: (camera.rays(uv).origin_lab_mm, camera.rays(uv).direction_lab), uv_px)


def test_a_point_on_the_axis_has_finite_gradients_even_of_second_order(dtype):
    camera = tsai(1e-3)
    on_axis = camera.rays(camera.centre_px).direction_lab * 300 + camera.rays(camera.centre_px).origin_lab_mm
    x_lab_mm = on_axis.to(dtype).requires_grad_()
    (first,) = torch.autograd.grad(camera.project(x_lab_mm).sum(), x_lab_mm, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), x_lab_mm)
    assert torch.isfinite(first).all()
    assert torch.isfinite(second).all()


@pytest.mark.parametrize("camera", list(CAMERAS.values())[:5])
def test_a_point_behind_the_camera_has_no_picture_and_no_gradient(camera):
    centre = camera.rays(f64((0.0, 0.0))).origin_lab_mm
    axis_lab = camera.R_cam_lab[2]
    x_lab_mm = torch.stack([centre - 100 * axis_lab, centre, centre + 100 * axis_lab]).requires_grad_()
    uv_px = camera.project(x_lab_mm)
    assert torch.isnan(uv_px).all(-1).tolist() == [True, True, False]
    (gradient,) = torch.autograd.grad(torch.nan_to_num(uv_px).sum(), x_lab_mm)
    assert torch.isfinite(gradient).all()
    assert (gradient[:2] == 0).all()


def test_R_cam_lab_takes_lab_axes_to_camera_axes_and_v_counts_downwards():
    # A camera that looks along lab +y with lab z up: camera x = lab x, camera y = -lab z, camera z = lab y.
    R_cam_lab = f64([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    camera = pinhole(R_cam_lab=R_cam_lab, T_cam_lab_mm=f64((0.0, 0.0, 100.0)), centre_px=f64((300.0, 200.0)))
    assert_close(camera.project(f64((0.0, 0.0, 0.0))), f64((300.0, 200.0)))
    assert_close(camera.project(f64((1.0, 0.0, 0.0))), f64((307.0, 200.0)))  # lab x: to the right, 700 px / 100
    assert_close(camera.project(f64((0.0, 0.0, 1.0))), f64((300.0, 193.0)))  # lab up: upwards, smaller v
    assert_close(camera.rays(f64((300.0, 200.0))).origin_lab_mm, f64((0.0, -100.0, 0.0)))
    turned_wrongly = pinhole(R_cam_lab=R_cam_lab.mT, T_cam_lab_mm=f64((0.0, 0.0, 100.0)), centre_px=f64((300.0, 200.0)))
    assert turned_wrongly.project(f64((0.0, 0.0, 1.0)))[1] > 200


def test_parameters_given_as_plain_numbers_keep_all_their_digits():
    camera = tsai(T_cam_lab_mm=[0.1, 0.2, 0.3], f_mm=45.1)
    assert camera.f_mm.item() == 45.1
    assert camera.T_cam_lab_mm.tolist() == [0.1, 0.2, 0.3]


@pytest.mark.parametrize("model", [pinhole, brown, fisheye, telecentric])
def test_a_focal_length_and_a_scale_are_above_zero(model):
    name = "scale_mm_px" if model is telecentric else "f_px"
    with pytest.raises(CameraError, match=f"{name}: expected above zero"):
        model(**{name: -getattr(model(), name)})


@pytest.mark.parametrize("method", ["project", "rays", "distort", "undistort"])
def test_another_last_axis_is_refused(camera, method):
    with pytest.raises(ShapeError, match="expected shape"):
        getattr(camera, method)(torch.zeros(5, 4))


def test_whole_numbers_are_refused_because_the_camera_would_be_rounded(camera):
    with pytest.raises(ShapeError, match="floating-point"):
        camera.project(torch.zeros(3, dtype=torch.int64))


@pytest.mark.parametrize("kind", ["pinhole", "tsai", "fisheye", "port", "telecentric"])
def test_lines_of_sight_about_a_point_meet_in_its_perspective_centre(kind):
    lens = (CAMERAS | {"port": behind_port(pinhole())})[kind]
    X = f64([[4.0, -3.0, 6.0], [0.0, 0.0, 0.0]])
    centre = perspective_centre_lab_mm(lens, X)
    assert centre.shape == X.shape
    if kind in ("pinhole", "tsai", "fisheye"):
        assert_close(centre, centre_lab_mm(lens).expand_as(centre), atol=1e-9)
        return
    towards = torch.nn.functional.normalize(X - centre, dim=-1)
    assert_close(towards, lens.rays(lens.project(X)).direction_lab, atol=1e-9)
    if kind == "telecentric":
        assert (X - centre).norm(dim=-1).min() > 1e5
        return
    # A small sphere's picture is as large as from there: the width of a pixel grows with the distance from it.
    near, far = (sphere_radius_px(lens, X + move * towards, 0.1) for move in (-1.0, 1.0))
    assert_close(near / far, ((X - centre).norm(dim=-1) + 1) / ((X - centre).norm(dim=-1) - 1), atol=3e-3)


def test_the_field_of_view_is_that_of_the_full_height():
    f_px = focal_of_field(288, 45.0)
    assert f_px == pytest.approx(347.6467, abs=1e-4)  # 144 / tan(22.5 degrees)
    camera = pinhole(
        image_size=(384, 288), f_px=f64(f_px), centre_px=middle_of_picture((384, 288)),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
    )  # fmt: skip
    top, bottom = camera.rays(f64([(191.5, -0.5), (191.5, 287.5)])).direction_lab
    assert math.degrees(torch.acos(top @ bottom)) == pytest.approx(45.0, abs=1e-9)
    assert abs(191.5 / math.tan(math.radians(22.5)) - f_px) > 100  # the width would give another


def test_the_middle_of_a_picture_lies_between_its_outer_pixel_centres():
    assert_close(middle_of_picture((384, 288)), f64((191.5, 143.5)))


@pytest.mark.parametrize("vfov_deg", [0.0, -3.0, 180.0, math.nan])
def test_an_impossible_field_of_view_is_refused(vfov_deg):
    with pytest.raises(CameraError, match="vfov_deg: expected an angle"):
        focal_of_field(288, vfov_deg)
