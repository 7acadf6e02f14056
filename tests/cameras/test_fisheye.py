"""The fisheye camera: OpenCV's `fisheye` model, also behind the camera."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from camera_examples import ROTVEC, T_MM, behind_port, f64, fisheye, load_opencv, pinhole, whole_picture
from conftest import assert_close

from sphereorient.cameras import load_cameras, sphere_disk_px
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.errors import CameraError

K = np.array([[210.0, 0, 331], [0, 214, 228.5], [0, 0, 1]])
D = np.array([-0.02, 0.005, -0.004, 0.001])
HEAD = "schema: sphereorient-cameras/1\ncameras:\n  cam1: {model: fisheye, image_size: [200, 160], "


def wide(**changes: object) -> FisheyeCamera:
    """A lens that shows 140 degrees over the picture's diagonal."""
    return fisheye(**({"f_px": f64((210.0, 214.0))} | changes))


def own(**changes: object) -> FisheyeCamera:
    """The same, whose frame is the lab."""
    return wide(R_cam_lab=torch.eye(3, dtype=torch.float64), T_cam_lab_mm=f64((0.0, 0.0, 0.0)), **changes)


def around(rng: torch.Generator, angle: float, count: int = 300) -> torch.Tensor:
    """Points at up to `angle` from the axis z, 1 to 500 mm away."""
    theta, phi, far = torch.rand(3, count, generator=rng, dtype=torch.float64)
    theta, phi, far = theta * angle, phi * 2 * math.pi, 1 + 499 * far
    return far[:, None] * torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)


def lab(x_cam_mm: torch.Tensor) -> torch.Tensor:
    camera = wide()
    return (x_cam_mm - camera.T_cam_lab_mm) @ camera.R_cam_lab


def test_points_appear_where_opencv_puts_them(rng):
    x_lab_mm = lab(around(rng, 1.5))
    expected, _ = cv2.fisheye.projectPoints(x_lab_mm.numpy()[:, None], np.array(ROTVEC), np.array(T_MM), K, D)
    assert_close(wide().project(x_lab_mm), torch.from_numpy(expected[:, 0]), atol=1e-9)
    # As a pinhole with Brown's distortion the same numbers are another lens.
    brown, _ = cv2.projectPoints(x_lab_mm.numpy(), np.array(ROTVEC), np.array(T_MM), K, D)
    assert float(np.abs(brown - expected).max()) > 50


def test_rays_of_pixels_agree_with_opencv():
    camera, uv_px = own(), whole_picture()
    uv_px = uv_px[((uv_px - camera.centre_px) / camera.f_px).norm(dim=-1) < 1.5]  # OpenCV stops at pi / 2
    sure = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    slopes = cv2.fisheye.undistortPoints(uv_px.numpy()[:, None], K, D, criteria=sure)[:, 0]
    direction = camera.rays(uv_px).direction_lab
    assert_close(direction[:, :2] / direction[:, 2:], torch.from_numpy(slopes), atol=1e-9)


@pytest.mark.parametrize("k", [(0.0,) * 4, tuple(D), (0.02, 0.0, 0.0, 0.0)])
def test_rays_undo_project_also_behind_the_camera(rng, k):
    camera, x_mm = own(k=f64(k)), around(rng, 3.1)
    rays = camera.rays(camera.project(x_mm))
    assert_close(rays.direction_lab, x_mm / x_mm.norm(dim=-1, keepdim=True), atol=1e-9)


def test_an_equidistant_lens_by_hand():
    camera = own(k=f64((0.0,) * 4), f_px=f64((100.0, 200.0)), centre_px=f64((300.0, 200.0)))
    for x_mm, uv_px in [
        ((0.0, 0.0, 7.0), (300.0, 200.0)),
        ((5.0, 0.0, 5.0), (300.0 + 25 * math.pi, 200.0)),  # 45 degrees; a pinhole has it at 400
        ((0.0, 3.0, 0.0), (300.0, 200.0 + 100 * math.pi)),  # beside the camera
        ((-1.0, 0.0, -1.0), (300.0 - 75 * math.pi, 200.0)),
    ]:
        assert_close(camera.project(f64(x_mm)), f64(uv_px), atol=1e-12)


def test_beyond_the_fold_and_straight_behind_there_is_no_picture(rng):
    folds = own(k=f64((-0.1, 0.0, 0.0, 0.0)))  # 1 = 0.3 theta^2 at 1.826 rad
    for angle, seen in ((1.82, True), (1.83, False)):
        x_mm = f64((math.sin(angle), 0.0, math.cos(angle))).requires_grad_()
        uv_px = folds.project(x_mm)
        assert bool(torch.isfinite(uv_px).all()) == seen
        (gradient,) = torch.autograd.grad(torch.nan_to_num(uv_px).sum(), x_mm)
        assert torch.isfinite(gradient).all()
        assert bool(gradient.any()) == seen
    reach = 1.82574 * (1 - 0.1 * 1.82574**2)
    assert torch.isnan(folds.rays(folds.centre_px + f64((210.0 * reach + 1, 0.0))).direction_lab).all()
    assert torch.isfinite(folds.rays(folds.centre_px + f64((210.0 * reach - 1, 0.0))).direction_lab).all()
    assert torch.isnan(own().project(f64([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0]]))).all()
    ideal = own(k=f64((0.0,) * 4))
    beyond = ideal.centre_px + f64((210.0 * 3.2, 0.0))
    uv_px = beyond.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(torch.nan_to_num(ideal.rays(uv_px).direction_lab).sum(), uv_px)
    assert torch.isnan(ideal.rays(beyond).direction_lab).all()
    assert (gradient == 0).all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0299, 0.0301, 1.0, math.pi / 2, 3.0])
def test_values_and_gradients_are_right_at_every_angle(angle):
    camera = own()
    x_mm = (40 * f64((math.sin(angle), 0.0, math.cos(angle)))).requires_grad_()
    assert torch.autograd.gradcheck(camera.project, x_mm, atol=1e-6)
    uv_px = camera.project(x_mm)
    assert_close(uv_px[0], camera.centre_px[0] + 210 * angle * (1 + sum(D * angle ** np.arange(2, 9, 2))), atol=1e-9)
    uv_px = uv_px.detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda uv: camera.rays(uv).direction_lab, uv_px, atol=1e-7)
    for start, of in ((x_mm, camera.project), (uv_px, lambda uv: camera.rays(uv).direction_lab)):
        (first,) = torch.autograd.grad(of(start).sum(), start, create_graph=True)
        (second,) = torch.autograd.grad(first.sum(), start)
        assert torch.isfinite(second).all()


@pytest.mark.parametrize("angle", [0.0, 0.8, math.pi / 2, 2.0])
def test_a_sphere_has_the_radius_of_its_picture_across_the_way_to_the_axis(angle):
    camera, X = own(k=f64((0.0,) * 4)), 100 * f64((math.sin(angle), 0.0, math.cos(angle)))
    middle, radius = sphere_disk_px(camera, X, 5.0)
    stretch = angle / math.sin(angle) if angle else 1.0
    assert float(radius) == pytest.approx(214 * 0.05 * stretch if angle else 210 * 0.05, rel=3e-3)
    assert_close(middle, camera.project(X))


def test_behind_a_wall_pixels_that_look_beside_it_see_nothing():
    tank = behind_port(wide())
    uv_px = whole_picture()
    rays = tank.rays(uv_px)
    seen = torch.isfinite(rays.direction_lab).all(-1)
    assert seen.any()
    assert_close(tank.project(rays.origin_lab_mm + 80 * rays.direction_lab)[seen], uv_px[seen], atol=1e-9)


def written(folder: Path, keys: str) -> FisheyeCamera:
    (folder / "cameras.yaml").write_text(f"{HEAD}{keys}}}\n")
    camera = load_cameras(folder / "cameras.yaml")["cam1"]
    assert isinstance(camera, FisheyeCamera)
    return camera


def test_a_field_of_view_is_an_angle_for_each_pixel(tmp_path):
    camera = written(tmp_path, "vfov_deg: 120")
    assert camera.f_px.tolist() == pytest.approx([160 / math.radians(120)] * 2)  # 76.4 px/rad
    assert camera.centre_px.tolist() == [99.5, 79.5]
    assert camera.k.tolist() == [0.0] * 4
    assert written(tmp_path, "fx: 70, fy: 71, cx: 90, k: [0.1, 0, 0, 0.2]").centre_px.tolist() == [90.0, 79.5]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("cx: 3", "vfov_deg, got none"),
        ("fx: 70", "vfov_deg, got fx"),
        ("fx: 70, fy: 70, vfov_deg: 90", "got fx, fy, vfov_deg"),
        ("vfov_deg: 360", "vfov_deg: .* got 360"),
        ("fx: 70, fy: 70, k: [0.1, 0.2]", "k"),
        ("fx: 70, fy: 70, p: [0.1, 0.2]", "got 'p'"),
    ],
)
def test_faults_of_the_file_are_one_line(tmp_path, keys, message):
    with pytest.raises(CameraError, match=message) as refused:
        written(tmp_path, keys)
    assert "\n" not in str(refused.value)


def opencv_text(**changed: str) -> str:
    """Return a file as OpenCV's sample, or ROS, writes it."""
    whole = {"image_width": "640", "image_height": "480"} | changed
    lines = [f"{key}: {value}" for key, value in whole.items()]
    for key, shape, data in (
        ("camera_matrix", (3, 3), "300., 0., 319.5, 0., 300., 239.5, 0., 0., 1."),
        ("distortion_coefficients", (4, 1), "-0.02, 0.005, -0.004, 0.001"),
    ):
        rows, cols = shape
        lines.append(f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]")
    return "\n".join(["%YAML:1.0", "---", *lines, ""])


@pytest.mark.parametrize(
    ("key", "u"),
    [
        ({"fisheye_model": "1"}, 527.06),
        ({"distortion_model": "equidistant"}, 527.06),
        ({"fisheye_model": "0"}, 568.94),
        ({"distortion_model": "plumb_bob"}, 568.94),
        ({}, 568.94),
    ],
)
def test_the_file_names_the_lens_of_its_four_numbers(tmp_path, key, u):
    (tmp_path / "cam.yml").write_text(opencv_text(**key))
    camera = load_opencv(tmp_path / "cam.yml")
    assert float(camera.project(f64((321.394, 0.0, 383.022)))[0]) == pytest.approx(u, abs=0.01)


def test_a_model_that_is_not_known_is_refused_by_its_name(tmp_path):
    (tmp_path / "cam.yml").write_text(opencv_text(distortion_model="omni"))
    with pytest.raises(CameraError, match="got 'omni'"):
        load_opencv(tmp_path / "cam.yml")
    five = opencv_text(fisheye_model="1").replace("rows: 4", "rows: 5").replace("0.001 ]", "0.001, 0. ]")
    (tmp_path / "cam.yml").write_text(five)
    with pytest.raises(CameraError, match="k1 to k4"):
        load_opencv(tmp_path / "cam.yml")


def test_near_the_axis_it_is_a_pinhole():
    x_lab_mm = lab(f64([[0.01, 0.0, 100.0], [0.0, -0.02, 100.0]]))
    same = pinhole(f_px=f64(210.0)).project(x_lab_mm)
    assert_close(wide(f_px=f64((210.0, 210.0))).project(x_lab_mm), same, atol=1e-8)
