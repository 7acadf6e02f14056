"""The telecentric camera: parallel rays, no depth."""

from __future__ import annotations

import torch
from camera_examples import f64, telecentric, turned, whole_picture
from conftest import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st


def test_one_pixel_is_as_many_mm_as_the_scale_right_and_down():
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
    z_cam = (rays.origin_lab_mm @ camera.R_cam_lab.mT + camera.T_cam_lab_mm)[..., 2]
    assert_close(z_cam, torch.zeros_like(z_cam), atol=1e-9)  # rays begin in the plane of the camera's frame
