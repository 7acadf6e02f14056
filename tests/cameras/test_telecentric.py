"""The telecentric camera: parallel rays, no depth."""

from __future__ import annotations

import pytest
import torch
from camera_examples import f64, telecentric, turned, whole_picture
from conftest import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st

from sphereorient.errors import CameraError, ShapeError


def test_one_pixel_is_as_many_mm_as_the_scale_says_right_and_down():
    camera = telecentric(R_cam_lab=torch.eye(3, dtype=torch.float64), T_cam_lab_mm=f64((0.0, 0.0, 0.0)))
    assert_close(camera.project(f64((0.23, 0.46, 7.0))), f64((332.0, 230.5)))
    # The scale the other way round, px per mm, would move it by a twentieth of that.
    assert camera.project(f64((0.23, 0.0, 0.0)))[0] - 331 > 0.9


def test_the_picture_does_not_depend_on_depth_also_behind_the_plane():
    camera = telecentric()
    x_lab_mm = f64((3.0, -5.0, 8.0))
    for depth in (-5e3, -1.0, 1e4):
        assert_close(camera.project(x_lab_mm + depth * camera.R_cam_lab[2]), camera.project(x_lab_mm), atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(
    scale=st.floats(1e-3, 10),
    centre=st.tuples(st.floats(-100, 700), st.floats(-100, 700)),
    rotvec=st.tuples(*[st.floats(-3, 3)] * 3),
    distance_mm=st.floats(-5000, 5000),
)
def test_project_undoes_rays_over_the_whole_picture(scale, centre, rotvec, distance_mm):
    camera = telecentric(scale_mm_px=f64(scale), centre_px=f64(centre), R_cam_lab=turned(rotvec))
    uv_px = whole_picture()
    rays = camera.rays(uv_px)
    assert_close(rays.direction_lab, camera.R_cam_lab[2].expand(len(uv_px), 3))
    assert_close(camera.project(rays.origin_lab_mm + distance_mm * rays.direction_lab), uv_px, atol=1e-6)


def test_rays_begin_in_the_plane_of_the_camera_frame():
    camera = telecentric()
    origin = camera.rays(whole_picture()).origin_lab_mm
    z_cam = (origin @ camera.R_cam_lab.mT + camera.T_cam_lab_mm)[..., 2]
    assert_close(z_cam, torch.zeros_like(z_cam), atol=1e-9)


def test_a_batch_is_the_stack_of_its_singles(rng, dtype, batch):
    camera = telecentric()
    x_lab_mm = torch.randn(*batch, 3, generator=rng, dtype=torch.float64).to(dtype) * 50
    uv_px = camera.project(x_lab_mm)
    rays = camera.rays(uv_px)
    assert uv_px.shape == (*batch, 2)
    assert rays.origin_lab_mm.shape == rays.direction_lab.shape == (*batch, 3)
    assert uv_px.dtype == rays.origin_lab_mm.dtype == rays.direction_lab.dtype == dtype
    atol = 1e-3 if dtype == torch.float32 else 1e-10
    for point, uv in zip(x_lab_mm.reshape(-1, 3), uv_px.reshape(-1, 2), strict=True):
        assert_close(camera.project(point), uv, atol=atol)


def test_there_is_no_distortion():
    assert torch.equal(telecentric().undistort(whole_picture()), whole_picture())
    assert torch.equal(telecentric().distort(whole_picture()), whole_picture())


@pytest.mark.parametrize("name", ["centre_px", "scale_mm_px", "R_cam_lab", "T_cam_lab_mm"])
def test_gradients_with_respect_to_parameters_are_right(name, rng):
    x_lab_mm = torch.randn(3, 3, generator=rng, dtype=torch.float64) * 50

    def seen(parameter: torch.Tensor) -> tuple[torch.Tensor, ...]:
        camera = telecentric(**{name: parameter})
        rays = camera.rays(whole_picture(steps=2))
        return camera.project(x_lab_mm), rays.origin_lab_mm, rays.direction_lab

    assert torch.autograd.gradcheck(seen, getattr(telecentric(), name).clone().requires_grad_())


@pytest.mark.parametrize("method", ["project", "rays", "distort", "undistort"])
def test_another_last_axis_is_refused(method):
    with pytest.raises(ShapeError, match=r"expected shape \(\.\.\., [23]\), got \(5, 4\)"):
        getattr(telecentric(), method)(torch.zeros(5, 4))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale_mm_px": 0.0}, "scale_mm_px: expected above zero"),
        ({"image_size": (650, 0)}, "image_size: expected two whole numbers"),
        ({"R_cam_lab": -torch.eye(3, dtype=torch.float64)}, "R_cam_lab: expected a rotation"),
    ],
)
def test_impossible_parameters_are_refused(changes, message):
    with pytest.raises(CameraError, match=message):
        telecentric(**changes)
