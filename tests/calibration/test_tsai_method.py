"""Tsai's calibration: planted cameras come back, OpenCV agrees, and undetermined parameters are refused."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from camera_examples import behind_port, f64, port, tsai, turned
from conftest import assert_close, slow
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.solve import fit_to_points, rms_px
from sphereorient.calibration.tsai_method import calibrate_tsai
from sphereorient.cameras import PinholeCamera, TsaiCamera
from sphereorient.cameras.parameters import ROTATION, TRANSLATION
from sphereorient.errors import CameraError, ShapeError

SIZE = (650, 650)
PITCH = (0.02, 0.02)
NOISE_PX = 0.05


def planted(**changes: object) -> TsaiCamera:
    """A camera with its axis in the picture's middle and s_x = 1."""
    middle = {"image_size": SIZE, "centre_px": f64((324.5, 324.5)), "pixel_pitch_mm": f64(PITCH), "sx": f64(1.0)}
    return tsai(**(middle | changes))


def in_space(n: int = 60, seed: int = 1) -> Tensor:
    return 120 * (torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5)


def in_plane() -> Tensor:
    """A plate of 13 x 13 dots, somewhere in the lab, not along its axes."""
    at = 8 * torch.arange(-6.0, 7.0, dtype=torch.float64)
    flat = torch.cat([torch.cartesian_prod(at, at), torch.zeros(169, 1, dtype=torch.float64)], dim=-1)
    return flat @ turned((0.1, 0.3, -0.4)).mT + f64((5.0, -8.0, 12.0))


def square_on(tilt_rad: float) -> TsaiCamera:
    """A camera whose sensor is that far from parallel to the plate of `in_plane`."""
    R = so3.exp(f64((tilt_rad, 0.0, 0.0))) @ turned((0.1, 0.3, -0.4)).mT
    return planted(R_cam_lab=R)


def noisy(camera: TsaiCamera, points: Tensor, seed: int = 2, sigma_px: float = NOISE_PX) -> Tensor:
    noise = torch.randn(len(points), 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return camera.project(points) + sigma_px * noise


def assert_same_camera(found: TsaiCamera, true: TsaiCamera, tolerance: float = 1e-8) -> None:
    assert float(so3.geodesic_distance(found.R_cam_lab, true.R_cam_lab)) < tolerance
    assert_close(found.T_cam_lab_mm, true.T_cam_lab_mm, atol=1e3 * tolerance)
    assert_close(found.f_mm, true.f_mm, atol=1e2 * tolerance)
    assert_close(found.kappa1, true.kappa1, atol=tolerance)
    assert_close(found.centre_px, true.centre_px, atol=1e3 * tolerance)
    assert_close(found.sx, true.sx, atol=tolerance)


PLACES = {"space": in_space, "plane": in_plane}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kappa1", [0.0, slow(2.2e-4), slow(2e-3), -2e-3])
def test_a_planted_camera_comes_back(place, kappa1):
    camera, points = planted(kappa1=kappa1), PLACES[place]()
    assert_same_camera(calibrate_tsai(points, camera.project(points), SIZE, PITCH), camera)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    "T_mm", [(0.0, 0.0, 520.0), slow((0.0, 25.0, 520.0)), slow((25.0, 0.0, 520.0)), (400.0, -9e3, 9e2)]
)
def test_the_result_does_not_depend_on_where_the_labs_origin_appears(place, T_mm):
    pitch = (0.02, 0.025)
    camera = planted(T_cam_lab_mm=f64((3.0, -4.0, 520.0)), pixel_pitch_mm=f64(pitch))
    shift = camera.R_cam_lab.mT @ (camera.T_cam_lab_mm - f64(T_mm))  # the same scene in another lab
    moved = replace(camera, T_cam_lab_mm=f64(T_mm))
    points = PLACES[place]() + shift
    assert_same_camera(calibrate_tsai(points, moved.project(points), SIZE, pitch), moved, tolerance=1e-7)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    rotvec=st.tuples(*[st.floats(-1.8, 1.8)] * 3),
    place=st.sampled_from(list(PLACES)),
    kappa1=st.floats(-1e-3, 2e-3),
    f_mm=st.floats(15.0, 60.0),
)
def test_cameras_of_any_attitude_come_back(rotvec, place, kappa1, f_mm):  # property
    camera = planted(R_cam_lab=turned(rotvec), T_cam_lab_mm=f64((10.0, -13.0, 12 * f_mm)), f_mm=f_mm, kappa1=kappa1)
    points = PLACES[place]()
    slant = abs(float((camera.R_cam_lab @ turned((0.1, 0.3, -0.4)))[2, 2]))  # cosine of sensor to plate
    if place == "plane" and not 0.15 < slant < 0.97:
        return  # square on there is no answer, edge on there is no picture
    assert_same_camera(calibrate_tsai(points, camera.project(points), SIZE, PITCH), camera, tolerance=1e-6)


@pytest.mark.parametrize("place", PLACES)
def test_with_noise_and_no_distortion_the_camera_is_that_of_opencvs_calibration(place):  # oracle
    points = PLACES[place]()
    pixels = noisy(planted(kappa1=0.0), points)
    found = fit_to_points(as_pinhole(calibrate_tsai(points, pixels, SIZE, PITCH)), POSE_AND_F, points, pixels)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    guess = np.array([[2000.0, 0, 324.5], [0, 2000.0, 324.5], [0, 0, 1]])
    lists = [points.numpy().astype(np.float32)], [pixels.numpy().astype(np.float32)]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 500, 1e-15)
    rms, K, _, rotvecs, Ts = cv2.calibrateCamera(*lists, SIZE, guess, None, flags=flags, criteria=criteria)
    assert float(found.f_px) == pytest.approx(K[0, 0], rel=1e-5)
    assert_close(so3.log(found.R_cam_lab), torch.from_numpy(rotvecs[0][:, 0]), atol=1e-5)
    assert_close(found.T_cam_lab_mm, torch.from_numpy(Ts[0][:, 0]), atol=1e-2)
    assert rms_px(found, points, pixels) == pytest.approx(rms, rel=1e-4)


POSE_AND_F = ("f_px", *ROTATION, *TRANSLATION)


def as_pinhole(camera: TsaiCamera) -> PinholeCamera:
    return PinholeCamera(
        image_size=camera.image_size,
        R_cam_lab=camera.R_cam_lab,
        T_cam_lab_mm=camera.T_cam_lab_mm,
        centre_px=camera.centre_px,
        f_px=camera.f_mm / camera.pixel_pitch_mm[0],
    )


@pytest.mark.slow
def test_with_noise_errors_are_as_large_as_the_covariance_states():
    camera, points = planted(), in_space()
    squares = []
    for seed in range(12):
        found = calibrate_tsai(points, noisy(camera, points, seed, 0.1), SIZE, PITCH)
        turn = so3.log(camera.R_cam_lab @ found.R_cam_lab.mT)
        move = camera.T_cam_lab_mm - found.T_cam_lab_mm
        lens = torch.stack([camera.f_mm - found.f_mm, camera.kappa1 - found.kappa1])
        error = torch.cat([lens, turn, move])
        squares.append(float(error @ torch.linalg.solve(found.covariance.matrix, error)))
    # Chi squared with 8 degrees of freedom, mean of 12: 8 +- 1.2.
    assert 4.5 < np.mean(squares) < 12.0


@pytest.mark.parametrize("place", PLACES)
def test_the_last_fit_is_the_least_sum_of_squares(place):
    points = PLACES[place]()
    pixels = noisy(planted(), points)
    found = calibrate_tsai(points, pixels, SIZE, PITCH)
    least = rms_px(found, points, pixels)
    assert least == pytest.approx(NOISE_PX * math.sqrt(2), rel=0.15)
    for change in (1.0, -1.0):  # small against the sigmas (f: 0.025 mm), and already worse
        assert rms_px(replace(found, f_mm=found.f_mm + 0.01 * change), points, pixels) > least
        assert rms_px(replace(found, kappa1=found.kappa1 + 1e-6 * change), points, pixels) > least


def test_the_centre_and_sx_are_fitted_where_they_are_free():
    camera = planted(sx=1.01, centre_px=f64((331.0, 318.5)), f_mm=25.0, T_cam_lab_mm=f64((4.0, -3.0, 320.0)))
    points = in_space()
    pixels = camera.project(points)
    held = calibrate_tsai(points, pixels, SIZE, PITCH)
    names = ("f", "kappa1", "sx", "centre_u", "centre_v", *ROTATION, *TRANSLATION)
    assert_same_camera(fit_to_points(held, names, points, pixels), camera)
    assert held.centre_px.tolist() == [324.5, 324.5]
    assert rms_px(held, points, pixels) > 0.3


@pytest.mark.parametrize(("relief_mm", "tilt_rad"), [(0.02, 0.4), (0.3, 0.4), (1.0, 0.4), (0.0, 0.1)])
def test_a_plate_that_is_not_quite_flat_or_hardly_tilted_is_taken_as_it_is(relief_mm, tilt_rad):
    plane = in_plane()
    heights = torch.randn(len(plane), 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    points, camera = plane + relief_mm * heights * turned((0.1, 0.3, -0.4))[:, 2], square_on(tilt_rad)
    assert_same_camera(calibrate_tsai(points, camera.project(points), SIZE, PITCH), camera)
    found = calibrate_tsai(points, noisy(camera, points), SIZE, PITCH)
    assert float(found.f_mm) == pytest.approx(45.0, abs=4 * found.covariance.sigmas["f"])


def test_numbers_of_either_precision_and_their_gradients_are_taken():
    camera, points = planted(), in_space()
    found = calibrate_tsai(points.float().requires_grad_(), camera.project(points).float(), SIZE, PITCH)
    assert found.f_mm.dtype == torch.float64
    assert_same_camera(found, camera, tolerance=1e-4)


def test_the_fit_to_points_works_for_a_camera_behind_a_port():
    camera = behind_port(tsai())
    points = in_space()
    near = replace(camera, camera=tsai(T_cam_lab_mm=f64((4.5, -2.0, 524.0))), port=port(n_fluid=1.33))
    names = ("n_fluid", *TRANSLATION)
    with pytest.raises(CameraError, match="port_n_fluid"):
        fit_to_points(near, names, points, camera.project(points))
    found = fit_to_points(near, ("port_n_fluid", *TRANSLATION), points, camera.project(points))
    assert float(found.port.n_fluid) == pytest.approx(1.36, abs=1e-9)
    assert found.covariance.names == ("port_n_fluid", *TRANSLATION)


# Bad input: one clear line each.


@pytest.mark.slow
@pytest.mark.parametrize("tilt_rad", [0.0, 1e-6, 0.005])
@pytest.mark.parametrize("sigma_px", [0.0, 0.05])
def test_a_plane_parallel_to_the_sensor_is_refused(tilt_rad, sigma_px):
    points, camera = in_plane(), square_on(tilt_rad)
    with pytest.raises(CameraError, match="tilt the plate") as refused:
        calibrate_tsai(points, noisy(camera, points, sigma_px=sigma_px), SIZE, PITCH)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("mirror", [(-1, 1, 1), slow((1, -1, 1)), slow((1, 1, -1))])
def test_mirrored_points_are_refused(mirror):
    points, camera = in_space(), planted()
    with pytest.raises(CameraError, match="mirror image"):
        calibrate_tsai(points * f64(mirror), camera.project(points), SIZE, PITCH)


def test_pixels_of_other_points_are_refused():
    points, camera = in_space(), planted()
    with pytest.raises(CameraError, match="order"):
        calibrate_tsai(points, camera.project(points).roll(1, 0), SIZE, PITCH)
    far = camera.project(points)
    far[5] += 100.0
    with pytest.raises(CameraError, match="rms"):
        calibrate_tsai(points, far, SIZE, PITCH)


def test_too_few_points_are_refused_and_just_enough_are_not():
    camera, space, plane = planted(), in_space(), in_plane()[[0, 12, 84, 156, 30]]
    for points, line in (
        (space[:6], "7 or more in space"),
        (plane[:4], "5 or more"),
        (plane[:0], "5 or more"),
    ):
        with pytest.raises(CameraError, match=line):
            calibrate_tsai(points, camera.project(points), SIZE, PITCH)
    for points in (space[:7], plane):
        assert_same_camera(calibrate_tsai(points, camera.project(points), SIZE, PITCH), camera, tolerance=1e-6)


def test_points_on_a_line_and_points_at_one_place_are_refused():
    camera = planted()
    line = torch.linspace(-50, 50, 20, dtype=torch.float64)[:, None] * f64((1.0, 0.3, 0.2))
    for points in (line, line[:1].expand(20, 3)):
        with pytest.raises(CameraError, match="got points on a line"):
            calibrate_tsai(points, camera.project(points), SIZE, PITCH)
    with pytest.raises(CameraError, match="points"):
        calibrate_tsai(in_space(), camera.project(line[:1]).expand(60, 2), SIZE, PITCH)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_refused_with_their_row(bad):
    points = in_space()
    pixels = planted().project(points)
    for which, name in ((0, "x_lab_mm"), (1, "uv_px")):
        arrays = [points.clone(), pixels.clone()]
        arrays[which][3, 1] = bad
        with pytest.raises(CameraError, match=f"{name}, row 3"):
            calibrate_tsai(*arrays, SIZE, PITCH)


def test_arrays_of_other_shapes_and_impossible_sensors_are_refused():
    points = in_space()
    pixels = planted().project(points)
    with pytest.raises(ShapeError, match="60 points and 59 pixels"):
        calibrate_tsai(points, pixels[1:], SIZE, PITCH)
    with pytest.raises(ShapeError, match="x_lab_mm: expected shape"):
        calibrate_tsai(points[None], pixels[None], SIZE, PITCH)
    with pytest.raises(CameraError, match="pixel_pitch_mm: expected above zero"):
        calibrate_tsai(points, pixels, SIZE, (0.02, 0.0))
    with pytest.raises(CameraError, match="image_size"):
        calibrate_tsai(points, pixels, (650, 0), PITCH)


def test_parameters_that_cannot_be_fitted_are_refused():
    square, points = planted(kappa1=0.0), in_space()  # without distortion one scale of f and both pitches is open
    names = ("f", "pixel_pitch_u", "pixel_pitch_v", *ROTATION, *TRANSLATION)
    with pytest.raises(CameraError, match="no information on f, pixel_pitch_u"):
        fit_to_points(square, names, points, square.project(points))
    with pytest.raises(CameraError, match="5 or more for 9"):
        fit_to_points(square, names, points[:4], square.project(points[:4]))
