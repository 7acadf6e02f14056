"""Dots in pictures: all whole ones, no cut ones, to a few hundredths of a pixel."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from conftest import assert_close, slow
from plate_drawing import PLATE, SIZE, Scene
from scipy.integrate import dblquad

from sphereorient.calibration.bundle import disk_centre_shift
from sphereorient.calibration.dots import Dots, DotSettings, find_dots
from sphereorient.cameras import TsaiCamera
from sphereorient.errors import CameraError, ShapeError


def against_truth(dots: Dots, scene: Scene) -> tuple[set[tuple[int, int]], np.ndarray]:
    """Return the found dots and the error of each, less the perspective bias."""
    index = scene.plate.indices
    points, diameter = torch.from_numpy(scene.plate.points(index)), torch.from_numpy(scene.plate.diameters(index))
    shift = disk_centre_shift(scene.camera, scene.R_lab_plate, scene.T_lab_plate, points, diameter).numpy()
    expected = scene.centres_px(index) + shift
    away = np.linalg.norm(dots.uv_px[:, None] - expected[None], axis=-1)
    nearest = away.argmin(axis=1)
    assert (away.min(axis=1) < 1).all()  # nothing but dots of the plate
    assert len(set(nearest.tolist())) == len(dots)  # and none twice
    return {(int(i), int(j)) for i, j in index[nearest]}, dots.uv_px - expected[nearest]


def rms(miss: np.ndarray) -> float:
    return float(np.sqrt(np.mean(miss**2)))


@pytest.mark.parametrize(
    "scene",
    [
        Scene(),
        slow(Scene(tilt_deg=40, about_deg=20, spin_deg=15)),
        slow(Scene(tilt_deg=60, about_deg=80, distance_mm=230)),
        Scene(tilt_deg=60, about_deg=-35, spin_deg=-30, distance_mm=230),
    ],
    ids=["front", "tilt40", "tilt60", "tilt60 askew"],
)
def test_all_dots_of_a_tilted_plate_are_found_to_a_few_hundredths_of_a_pixel(scene: Scene) -> None:
    found, miss = against_truth(find_dots(scene.picture()), scene)
    assert found == scene.whole()
    assert len(found) == 99
    assert rms(miss) < 0.03
    assert np.abs(miss.mean(axis=0)).max() < 0.008


@pytest.mark.parametrize("seed", [0, slow(1), slow(2)])
def test_the_stated_sigma_is_the_scatter_about_the_truth(seed: int) -> None:
    scene = Scene(tilt_deg=30, about_deg=25, spin_deg=10)
    dots = find_dots(scene.picture(noise=10.0, seed=seed))
    _, miss = against_truth(dots, scene)
    # Frame noise is smaller on the dots than about them, where most pixels are: the sigma is a little too large.
    assert 0.65 < rms(miss / dots.sigma_px[:, None]) < 1.2


@pytest.mark.parametrize("uneven", [slow(0.5), 0.85])
def test_uneven_light_hides_no_dot_and_moves_none(uneven: float) -> None:
    scene = Scene(tilt_deg=35, about_deg=50)
    found, miss = against_truth(find_dots(scene.picture(uneven=uneven, noise=1.0)), scene)
    assert found == scene.whole()
    assert rms(miss) < 0.03
    assert np.abs(miss.mean(axis=0)).max() < 0.01


def test_bright_dots_on_a_dark_plate_are_found_as_well() -> None:
    scene = Scene(plate=replace(PLATE, dark=False), tilt_deg=40, about_deg=20)
    found, miss = against_truth(find_dots(scene.picture(), dark=False), scene)
    assert found == scene.whole()
    assert rms(miss) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("at_mm", [(45.0, 0.0), (-50.0, 30.0), (10.0, -47.3), (38.2, 44.9)])
def test_dots_cut_by_the_edge_of_the_picture_are_left_out_and_whole_ones_kept(at_mm: tuple[float, float]) -> None:
    scene = Scene(at_mm=at_mm, tilt_deg=25, about_deg=10, spin_deg=4, distance_mm=200)
    found, miss = against_truth(find_dots(scene.picture()), scene)
    # Within 0.15 px of the edge, noise decides.
    assert scene.whole(0.15) <= found <= scene.whole(-0.15)
    assert len(scene.whole()) < 99
    assert rms(miss) < 0.03


@pytest.mark.slow
def test_a_dot_that_touches_the_edge_is_measured_as_well_as_others() -> None:
    # Slides the plate in steps of a twentieth of a pixel; the leftmost column then touches the edge here and there.
    worst = []
    for step in range(4):
        scene = Scene(at_mm=(-25.05 + 0.045 * step, 0.0))
        found, miss = against_truth(find_dots(scene.picture(noise=1.0)), scene)
        assert scene.whole(0.1) <= found
        worst.append(np.abs(miss).max())
    assert max(worst) < 0.05


@pytest.mark.slow
def test_eight_and_sixteen_bits_and_fractions_give_the_same_dots() -> None:
    picture = Scene().picture()
    eight = find_dots(picture)
    for other in (picture.astype(np.uint16) * 257, picture.astype(np.float64) / 255):
        assert_close(torch.from_numpy(find_dots(other).uv_px), torch.from_numpy(eight.uv_px), atol=2e-3)


@pytest.mark.slow
def test_a_picture_shifted_by_whole_pixels_shifts_the_dots() -> None:
    picture = Scene().picture()
    moved = find_dots(np.roll(picture, (3, 5), axis=(0, 1)))
    still = find_dots(picture)
    assert_close(torch.from_numpy(moved.uv_px), torch.from_numpy(still.uv_px + np.array([5, 3])), atol=1e-6)


def test_whole_numbers_are_pixel_centres() -> None:
    # A dot about pixel (30, 20), symmetric by construction: (u, v) = (30, 20), not (20, 30) or (30.5, 20.5).
    picture = np.full((48, 64), 200, dtype=np.uint8)
    v, u = np.mgrid[:48, :64]
    picture[np.hypot(u - 30, v - 20) < 4.3] = 20
    dots = find_dots(picture)
    assert len(dots) == 1
    assert_close(torch.from_numpy(dots.uv_px), torch.tensor([[30.0, 20.0]], dtype=torch.float64), atol=1e-3)
    assert abs(math.sqrt(dots.area_px[0] / math.pi) - 4.3) < 0.15


def test_a_picture_without_dots_gives_none() -> None:
    noise = np.random.default_rng(0).normal(100, 10, (200, 300)).clip(0, 255).astype(np.uint8)
    for picture in (np.zeros((200, 300), np.uint8), noise):
        dots = find_dots(picture)
        assert len(dots) == 0
        assert dots.area_px.shape == (0,)


def test_squares_bars_and_half_disks_are_no_dots() -> None:
    picture = np.full((120, 200), 180.0)
    picture[20:32, 20:32] = 20
    picture[60:64, 20:60] = 20
    v, u = np.mgrid[:120, :200]
    picture[(np.hypot(u - 140, v - 60) < 12) & (v > 60)] = 20
    assert len(find_dots(picture, settings=DotSettings(worst_misfit=0.08))) == 0


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.zeros((40, 40, 3)), r"plate picture: expected \(H, W\)"),
        (np.zeros((4, 40)), "of 16 px or more"),
        (np.full((40, 40), np.nan), "got NaN"),
    ],
)
def test_an_array_that_is_no_grey_picture_is_refused_in_one_line(picture: np.ndarray, words: str) -> None:
    with pytest.raises(CameraError, match=words) as refused:
        find_dots(picture)
    assert "\n" not in str(refused.value)


def slow_centroid(camera: TsaiCamera, R: torch.Tensor, T: torch.Tensor, point: torch.Tensor, diameter: float) -> list:
    """The centroid by integrating pixel area over the disk, with derivatives by differences."""

    def uv(x: float, y: float) -> torch.Tensor:
        return camera.project((point + torch.tensor([x, y, 0.0], dtype=torch.float64)) @ R.mT + T)

    def stretch(x: float, y: float) -> float:
        e = 1e-4
        du, dv = (uv(x + e, y) - uv(x - e, y)) / (2 * e), (uv(x, y + e) - uv(x, y - e)) / (2 * e)
        return abs(float(du[0] * dv[1] - du[1] * dv[0]))

    def over_disk(weight) -> float:
        def polar(angle: float, r: float) -> float:
            x, y = r * math.cos(angle), r * math.sin(angle)
            return weight(x, y) * stretch(x, y) * r

        return dblquad(polar, 0, diameter / 2, 0, 2 * math.pi, epsabs=1e-7, epsrel=1e-7)[0]

    area, centre = over_disk(lambda x, y: 1.0), uv(0, 0)
    return [over_disk(lambda x, y, k=k: float(uv(x, y)[k] - centre[k])) / area for k in (0, 1)]


def strong_camera() -> TsaiCamera:
    return TsaiCamera(
        image_size=SIZE,
        R_cam_lab=torch.eye(3),
        T_cam_lab_mm=torch.zeros(3),
        centre_px=[239.5, 199.5],
        f_mm=12.0,
        pixel_pitch_mm=[0.02, 0.02],
        sx=1.0,
        kappa1=1e-3,
    )


@pytest.mark.slow
def test_the_perspective_bias_is_the_centroid_of_the_disks_picture() -> None:
    scene = Scene(tilt_deg=55, about_deg=30)
    R, T = scene.R_lab_plate, torch.tensor([10.0, -5.0, 90.0], dtype=torch.float64)
    points = torch.tensor([[0.0, 0.0, 0.0], [12.0, -9.0, 0.0]], dtype=torch.float64)
    diameter = torch.tensor([6.0, 6.0], dtype=torch.float64)
    got = disk_centre_shift(strong_camera(), R, T, points, diameter)
    expected = [slow_centroid(strong_camera(), R, T, point, 6.0) for point in points]
    assert float(got.norm(dim=-1).min()) > 0.03
    assert_close(got, torch.tensor(expected, dtype=torch.float64), atol=2e-4)


def test_a_tilted_disk_seems_nearer_on_the_side_that_is_nearer() -> None:
    # By hand, tilt t about the picture's u axis, on the axis of a pinhole: the ellipse's centre is off by
    # f r^2 sin t cos t / Z^2 to second order, towards the near half, which is magnified.
    scene = Scene(tilt_deg=45, about_deg=0, distance_mm=200, f_px=1000)
    diameter = torch.tensor([4.0], dtype=torch.float64)
    args = scene.camera, scene.R_lab_plate, scene.T_lab_plate, torch.zeros(1, 3, dtype=torch.float64)
    shift = disk_centre_shift(*args, diameter)
    by_hand = 1000 * 2.0**2 * 0.5 / 200**2
    assert abs(abs(float(shift[0, 1])) - by_hand) < 0.01 * by_hand
    near = scene.R_lab_plate[:, 1] * (
        -1 if scene.R_lab_plate[2, 1] > 0 else 1
    )  # the plate's y axis, towards the camera
    assert math.copysign(1, shift[0, 1]) == math.copysign(1, near[1])


def test_a_disk_facing_the_camera_and_a_corner_have_no_bias() -> None:
    scene = Scene()
    points = torch.tensor([[0.0, 0.0, 0.0], [20.0, 8.0, 0.0]], dtype=torch.float64)
    diameter = torch.tensor([5.0, 0.0], dtype=torch.float64)
    R = Scene(tilt_deg=50).R_lab_plate
    facing = disk_centre_shift(scene.camera, scene.R_lab_plate, scene.T_lab_plate, points, diameter)
    assert_close(facing, torch.zeros(2, 2, dtype=torch.float64), atol=1e-9)
    turned = disk_centre_shift(scene.camera, R, scene.T_lab_plate, points, diameter)
    assert float(turned[0].norm()) > 0.01
    assert_close(turned[1], torch.zeros(2, dtype=torch.float64))


def test_the_bias_of_a_batch_is_the_stack_of_single_ones(batch: tuple[int, ...]) -> None:
    scene = Scene(tilt_deg=30, about_deg=10)
    generator = torch.Generator().manual_seed(1)
    T = scene.T_lab_plate + torch.randn((*batch, 3), generator=generator, dtype=torch.float64)
    R = scene.R_lab_plate.expand(*batch, 3, 3)
    points = 10 * torch.randn((*batch, 4, 3), generator=generator, dtype=torch.float64) * torch.tensor([1, 1, 0])
    diameter = torch.full((*batch, 4), 3.2, dtype=torch.float64)
    got = disk_centre_shift(scene.camera, R, T, points, diameter)
    assert got.shape == (*batch, 4, 2)
    flat = zip(T.reshape(-1, 3), points.reshape(-1, 4, 3), strict=True)
    single = [disk_centre_shift(scene.camera, scene.R_lab_plate, t, p, diameter.new_full((4,), 3.2)) for t, p in flat]
    if single:
        assert_close(got.reshape(-1, 4, 2), torch.stack(single))


def test_the_bias_is_differentiable_also_for_corners() -> None:
    scene = Scene(tilt_deg=30, about_deg=10)
    points = torch.tensor([[0.0, 0.0, 0.0], [20.0, 8.0, 0.0]], dtype=torch.float64, requires_grad=True)
    diameter = torch.tensor([5.0, 0.0], dtype=torch.float64)
    args = scene.camera, scene.R_lab_plate
    T = scene.T_lab_plate.requires_grad_()
    assert torch.autograd.gradcheck(lambda t, p: disk_centre_shift(*args, t, p, diameter), (T, points), atol=1e-6)
    with pytest.raises(ShapeError, match="points_plate"):
        disk_centre_shift(*args, T, points[:, :2], diameter)


@pytest.mark.slow
def test_coarse_grain_gives_no_faint_dots_beside_the_plates_own() -> None:
    # Enlarged pictures have grain as large as small dots.
    scene = Scene(tilt_deg=20, distance_mm=420)
    coarse = cv2.resize(scene.picture(noise=12.0), None, fx=2.5, fy=2.5, interpolation=cv2.INTER_CUBIC)
    assert len(find_dots(coarse)) == 99
    assert len(find_dots(coarse, settings=DotSettings(faintest=0.0))) > 99
