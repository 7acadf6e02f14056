"""OpenPTV's camera and files: against its own order of operations, against OpenCV, there and back."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from camera_examples import f64, openptv, whole_picture
from conftest import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st

from sphereorient.cameras import PortCamera
from sphereorient.cameras.brown import OpenPTVCamera
from sphereorient.cameras.io.openptv import PtvPar, load_openptv, load_ptv_par
from sphereorient.errors import CameraError

# The layout that OpenPTV writes: centre, angles, matrix (not read), shift and distance, glass vector.
ORI = """  105.26320000 102.74580000 403.88220000
    -0.23832910   0.24428100   0.05525770

     0.9688305 -0.0535899  0.2418587
    -0.0033422  0.9734041  0.2290704
    -0.2477021 -0.2227387  0.9428845

      -2.4742   3.2567
     100.0000

       0.000100000000000    0.000010000000000   150.000000000000000
"""
ADDPAR = "-0.00001 0.00000002 0.0 0.00002 -0.00003 1.0 0.002\n"
PAR = "2\nimg/cam1.10099\ncal/cam1.tif\nimg/cam2.10099\ncal/cam2.tif\n1\n0\n1\n1280\n1024\n0.012\n0.011\n0\n"
AIR, TANK = "1\n1\n1\n6\n", "1\n1.49\n1.33\n6\n"


def files(folder: Path, ori: str = ORI, addpar: str = ADDPAR, par: str = PAR + AIR) -> tuple[Path, Path, Path]:
    paths = folder / "cam1.tif.ori", folder / "cam1.tif.addpar", folder / "ptv.par"
    for path, text in zip(paths, (ori, addpar, par), strict=True):
        path.write_text(text)
    return paths


def slow_pixel(x: np.ndarray) -> tuple[float, float]:
    """OpenPTV's own order of operations for ORI and ADDPAR in air, one point, less half a pixel for its corner."""
    omega, phi, kappa = -0.2383291, 0.244281, 0.0552577
    co, so, cp, sp, ck, sk = (f(a) for a in (omega, phi, kappa) for f in (math.cos, math.sin))
    dm = np.array(
        [
            [cp * ck, -cp * sk, sp],
            [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
            [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
        ]
    )
    along = dm.T @ (x - np.array([105.2632, 102.7458, 403.8822]))
    flat_x, flat_y = -100 * along[0] / along[2] - 2.4742, -100 * along[1] / along[2] + 3.2567
    k1, k2, p1, p2, she = -1e-5, 2e-8, 2e-5, -3e-5, 0.002
    r2 = flat_x**2 + flat_y**2
    radial = k1 * r2 + k2 * r2**2
    bent_x = flat_x * (1 + radial) + p1 * (r2 + 2 * flat_x**2) + 2 * p2 * flat_x * flat_y
    bent_y = flat_y * (1 + radial) + p2 * (r2 + 2 * flat_y**2) + 2 * p1 * flat_x * flat_y
    x_mm, y_mm = bent_x - math.sin(she) * bent_y, math.cos(she) * bent_y
    return x_mm / 0.012 + 1280 / 2 - 0.5, 1024 / 2 - y_mm / 0.011 - 0.5


def test_points_appear_where_openptvs_own_order_of_operations_puts_them(tmp_path, rng):
    ori, addpar, par = files(tmp_path)
    camera = load_openptv(ori, load_ptv_par(par), addpar)
    assert isinstance(camera, OpenPTVCamera)
    x_lab_mm = (torch.rand(50, 3, generator=rng, dtype=torch.float64) - 0.5) * 60
    expected = torch.tensor([slow_pixel(x) for x in x_lab_mm.numpy()], dtype=torch.float64)
    assert_close(camera.project(x_lab_mm), expected, atol=1e-8)


def test_about_the_middle_of_the_sensor_it_is_opencvs_camera_in_other_units(rng):
    cc, (k1, k2, k3), (p1, p2) = 18.0, (-4e-4, 6e-7, 1e-9), (1e-4, -2e-4)
    one = f64(1.0)
    camera = openptv(centre_px=f64((324.5, 239.5)), scx=one, she=0 * one)
    x_cam_mm = (torch.rand(100, 3, generator=rng, dtype=torch.float64) - 0.5) * 150 + f64((0.0, 0.0, 520.0))
    distortion = np.array([k1 * cc**2, k2 * cc**4, -p2 * cc, p1 * cc, k3 * cc**6])
    K = np.array([[cc / 0.02, 0, 324.5], [0, cc / 0.021, 239.5], [0, 0, 1]])
    expected, _ = cv2.projectPoints(x_cam_mm.numpy(), np.zeros(3), np.zeros(3), K, distortion)
    x_lab_mm = (x_cam_mm - camera.T_cam_lab_mm) @ camera.R_cam_lab
    assert_close(camera.project(x_lab_mm), torch.from_numpy(expected[:, 0]), atol=1e-8)


def test_the_sensor_shift_moves_the_axis_and_not_the_distortion():
    shifted, centred = openptv(), openptv(centre_px=f64((324.5, 239.5)))
    uv_px = whole_picture()
    assert_close(shifted.undistort(uv_px), centred.undistort(uv_px))
    assert_close(shifted.undistort(f64((324.5, 239.5))), f64((324.5, 239.5)))


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    k=st.tuples(st.floats(-8e-4, 1e-3), st.floats(-1e-6, 1e-6), st.floats(-1e-9, 1e-9)),
    p=st.tuples(st.floats(-5e-4, 5e-4), st.floats(-5e-4, 5e-4)),
    f_mm=st.floats(10, 100),
    scx=st.floats(0.9, 1.1),
    she=st.floats(-0.05, 0.05),
    distance_mm=st.floats(50, 5000),
)
def test_project_undoes_rays_over_the_whole_picture(k, p, f_mm, scx, she, distance_mm):
    camera = openptv(k=f64(k), p=f64(p), f_mm=f64(f_mm), scx=f64(scx), she=f64(she))
    uv_px = whole_picture()
    rays = camera.rays(uv_px)
    assert_close(camera.project(rays.origin_lab_mm + distance_mm * rays.direction_lab), uv_px, atol=1e-6)


YAML = "num_cams: 1\nptv:\n  splitter: false\n  img_name: [a, b]\n  imx: 1280\n  imy: 1024\n  pix_x: 0.012\n"
YAML += "  pix_y: 0.011\n  chfield: 0\n  mmp_n1: 1.0\n  mmp_n2: 1.49\n  mmp_n3: 1.33\n  mmp_d: 6.0\n  hp_flag: true\n"


def test_openptvs_yaml_and_lists_of_four_names_give_the_same_as_ptv_par(tmp_path):
    _, _, par = files(tmp_path, par=PAR + TANK)
    (tmp_path / "parameters_Run1.yaml").write_text(YAML)
    (tmp_path / "padded.par").write_text(PAR.replace("cal/cam2.tif\n", "cal/cam2.tif\n\n\n---\n---\n") + TANK)
    expected = load_ptv_par(par)
    assert expected == PtvPar((1280, 1024), (0.012, 0.011), 1.0, 1.49, 1.33, 6.0)
    assert load_ptv_par(tmp_path / "parameters_Run1.yaml") == expected
    assert load_ptv_par(tmp_path / "padded.par") == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (YAML.replace("pix_x", "pixel"), "expected 9 numbers .* got 8"),
        (YAML.replace("1024", "tall"), "number 2 of 9"),
        (YAML.replace("chfield: 0", "chfield: 1"), "expected whole frames"),
        ("- 1\n", "expected 9 numbers .*, got 0"),
    ],
)
def test_a_yaml_of_openptv_that_lacks_something_is_refused(tmp_path, text, message):
    (tmp_path / "run.yaml").write_text(text)
    with pytest.raises(CameraError, match=message):
        load_ptv_par(tmp_path / "run.yaml")


def test_a_list_of_four_names_that_is_cut_off_is_refused(tmp_path):
    whole = (PAR.replace("cal/cam2.tif\n", "cal/cam2.tif\na\nb\nc\nd\n") + TANK).splitlines()
    for count in range(1, len(whole)):
        (tmp_path / "ptv.par").write_text("\n".join(whole[:count]))
        with pytest.raises(CameraError):
            load_ptv_par(tmp_path / "ptv.par")


def test_the_glass_vector_and_the_media_become_a_port(tmp_path):
    ori, addpar, par = files(tmp_path, par=PAR + "1.25\n1.5\n1.5\n6\n")
    camera = load_openptv(ori, load_ptv_par(par), addpar)
    assert isinstance(camera, PortCamera)
    assert_close(camera.port.normal, f64((0.0001, 0.00001, 150.0)) / 150, atol=1e-9)
    # Snell's law depends on ratios only: 1.25 : 1.5 is 1 : 1.2.
    numbers = [camera.port.offset_mm, camera.port.thickness_mm, camera.port.n_glass, camera.port.n_fluid]
    assert_close(torch.stack(numbers), f64((150.0, 6.0, 1.2, 1.2)), atol=1e-9)
    uv_px = whole_picture((1280, 1024), steps=3)
    rays = camera.rays(uv_px)
    assert_close(camera.project(rays.origin_lab_mm + 100 * rays.direction_lab), uv_px, atol=1e-6)


def test_without_addpar_there_is_no_distortion(tmp_path):
    ori, _, par = files(tmp_path)
    camera = load_openptv(ori, load_ptv_par(par))
    assert_close(camera.undistort(whole_picture()), whole_picture(), atol=1e-10)


def test_a_scale_of_unknown_origin_is_read_with_a_warning(tmp_path):
    ori, addpar, par = files(tmp_path, addpar="0 0 0 0 0 1.01 0")
    with pytest.warns(UserWarning, match="scx = 1.01"):
        camera = load_openptv(ori, load_ptv_par(par), addpar)
    # 100 px to the right of the middle of the sensor and 100 px below it
    assert_close(camera.distort(f64((739.5, 611.5))), f64((740.5, 611.5)), atol=1e-9)


ORI_FAULTS = {
    "truncated": (ORI[: ORI.index("-2.4742")], "expected 21 numbers .* got 15"),
    "too long": (ORI + "1.0\n", "expected 21 numbers .* got 22"),
    "text": (ORI.replace("100.0000", "hundred"), "number 18 of 21"),
    "behind its picture": (ORI.replace("100.0000", "-100.0"), "f_mm: expected above zero"),
}


@pytest.mark.parametrize(("text", "message"), ORI_FAULTS.values(), ids=ORI_FAULTS)
def test_a_faulty_ori_is_refused_in_one_line(tmp_path, text, message):
    ori, addpar, par = files(tmp_path, ori=text)
    with pytest.raises(CameraError, match=message) as refused:
        load_openptv(ori, load_ptv_par(par), addpar)
    assert str(ori) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_glass_vector_of_no_length_is_refused_where_something_refracts(tmp_path):
    ori, addpar, par = files(tmp_path, ori=ORI[: ORI.rindex("0.0001")] + "0 0 0\n", par=PAR + TANK)
    with pytest.raises(CameraError, match="glass vector"):
        load_openptv(ori, load_ptv_par(par), addpar)


PAR_FAULTS = {
    "truncated": (PAR, "expected 12 numbers .* got 8"),
    "no number of cameras": ("cam1.tif\n" + PAR, "number of cameras first"),
    "interlaced": (PAR[:-2] + "1\n" + AIR, "whole frames"),
    "text": (PAR + AIR.replace("6", "six"), "number 12 of 12"),
}


@pytest.mark.parametrize(("text", "message"), PAR_FAULTS.values(), ids=PAR_FAULTS)
def test_a_faulty_par_is_refused_in_one_line(tmp_path, text, message):
    _, _, par = files(tmp_path, par=text)
    with pytest.raises(CameraError, match=message) as refused:
        load_ptv_par(par)
    assert str(par) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_addpar_that_is_short_is_refused(tmp_path):
    ori, addpar, par = files(tmp_path, addpar="0 0 0 0 0 1")
    with pytest.raises(CameraError, match="addpar: expected 7 numbers"):
        load_openptv(ori, load_ptv_par(par), addpar)
