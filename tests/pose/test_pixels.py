import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from camera_examples import behind_port, fisheye, pinhole, telecentric
from conftest import assert_close
from refine_examples import LOOKS, camera_of, f64, scene_of

from sphereorient.cameras import Camera, sphere_radius_px
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.cameras.model import TelecentricCamera
from sphereorient.locate import CameraScene
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.pixels import VECTOR, LinesOfSight, Pixels, cut_pixels, disk_stencil, stacked, whole_vectors

WIDTH, HEIGHT = 60, 44
PLACES = 224  # of the 253 within nine pixels: as many as fill vectors
BACKGROUND = np.full((HEIGHT, WIDTH), 7.0, np.float32)


def camera(model: str) -> Camera:
    common = {"R_cam_lab": f64(LOOKS[0]), "T_cam_lab_mm": f64([1.0, -2.0, 260.0]), "image_size": (WIDTH, HEIGHT)}
    if model == "telecentric":
        return TelecentricCamera(scale_mm_px=f64(0.3), centre_px=f64([29.5, 21.5]), **common)
    return replace(camera_of(model, LOOKS[0], 30, WIDTH), **common)


def places() -> np.ndarray:
    """A picture whose grey level is the pixel: u + 100 v."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return (u + 100 * v).astype(np.float32)


def disk(model: str = "pinhole", middle=(30.2, 20.7), radius_px: float = 9.0, step_px: int = 1, **more) -> Pixels:
    stencil = disk_stencil(radius_px, step_px)
    return cut_pixels(places(), scene_of(BACKGROUND), LinesOfSight(camera(model)), middle, stencil, **more)


@pytest.mark.parametrize("model", ["pinhole", "tsai", "telecentric"])
def test_every_pixel_looks_along_its_line_of_sight(model):
    pixels = disk(model)
    uv = torch.stack([pixels.grey[0] % 100, torch.div(pixels.grey[0], 100, rounding_mode="floor")], dim=-1).double()
    rays = camera(model).rays(uv)
    assert_close(pixels.direction[0].T.double(), rays.direction_lab, atol=1e-7)
    assert_close(pixels.origin[0].double().expand(3, len(uv)).T, rays.origin_lab_mm, atol=3e-5)
    # Half a pixel beside is another line.
    beside = camera(model).rays(uv + 0.5)
    assert (beside.direction_lab - rays.direction_lab).norm(dim=-1).min() > 1e-4 or model == "telecentric"


@pytest.mark.parametrize("kind", ["pinhole", "fisheye", "port", "telecentric"])
def test_a_balls_size_gives_its_distance_also_behind_a_port(kind):
    lens = (
        behind_port(pinhole())
        if kind == "port"
        else {"fisheye": fisheye, "telecentric": telecentric}.get(kind, pinhole)()
    )
    X, radius_mm = f64([4.0, -3.0, 6.0]), 2.0
    middle_px, radius_px = lens.project(X), sphere_radius_px(lens, X, radius_mm)
    direction, there, distance = LinesOfSight(lens).of_size(middle_px[None].numpy(), radius_mm / float(radius_px))
    origin = f64(there[0] - distance[0] * direction[0])
    away = float((X - f64(there[0])).norm())
    if kind == "telecentric":  # its pictures do not show the distance
        assert distance[0] == 0.0
        assert float(torch.linalg.cross(X - origin, f64(direction[0])).norm()) < 0.2
    else:
        assert away < 0.04 * float((X - origin).norm())


@pytest.mark.parametrize(("model", "origins"), [("pinhole", 1), ("tsai", 1), ("telecentric", PLACES)])
def test_origins_are_kept_once_where_all_lines_begin_in_one_point(model, origins):
    pixels = disk(model)
    assert pixels.grey.shape == (1, PLACES)
    assert pixels.origin.shape == (1, 3, origins)


@pytest.mark.parametrize("model", ["pinhole", "telecentric"])
def test_lines_of_sight_of_many_disks_are_those_of_each_ones_pixels(model):
    middles, stencil = np.array([(30.2, 20.7), (2.0, 46.5), (58.5, 1.0)]), disk_stencil(9.0)
    direction, origin = LinesOfSight(camera(model)).of(middles, stencil)
    for k, middle in enumerate(middles):
        one = disk(model, middle=tuple(middle))
        assert np.array_equal(direction[k], one.direction[0].numpy())
        assert np.array_equal(origin[k if len(origin) > 1 else 0], one.origin[0].numpy())


def test_axes_are_the_pictures_right_and_down_in_the_lab():
    # The camera looks along lab +y with lab z up: right is lab +x, down is lab -z.
    assert disk().axes.tolist() == [[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]]


def test_pitch_is_the_angle_between_neighbours_at_the_middle():
    near, aside = (1 / (30 / 18 * 260), (30.2, 20.7)), (None, (4.0, 3.0))
    assert disk(middle=near[1]).pitch_rad.item() == pytest.approx(near[0], rel=3e-3)
    one = camera("pinhole")
    rays = one.rays(f64([[4.0, 3.0], [5.0, 3.0], [4.0, 4.0]])).direction_lab
    expected = 0.5 * ((rays[1] - rays[0]).norm() + (rays[2] - rays[0]).norm())
    assert disk(middle=aside[1]).pitch_rad.item() == pytest.approx(float(expected), rel=1e-3)


@pytest.mark.parametrize("middle", [(0.0, 0.0), (WIDTH - 1.0, HEIGHT - 1.0), (-40.0, 900.0)])
def test_pitch_exists_in_the_corners_and_beyond(middle):
    assert disk(middle=middle).pitch_rad.item() == pytest.approx(1 / (30 / 18 * 260), rel=0.02)


def test_a_camera_of_one_centre_has_no_pitch_in_mm_and_a_telecentric_one_no_other():
    assert disk("tsai").pitch_mm.item() == 0
    parallel = disk("telecentric")
    assert parallel.pitch_mm.item() == pytest.approx(0.3, rel=1e-4)
    assert parallel.pitch_rad.item() == pytest.approx(0, abs=1e-6)


def test_the_disk_is_cut_about_the_nearest_whole_pixel():
    pixels = disk(middle=(30.6, 20.4))
    assert pixels.grey[0, 0].item() == 31 + 100 * 20
    u, v = pixels.grey[0] % 100 - 31, torch.div(pixels.grey[0], 100, rounding_mode="floor") - 20
    assert (u.square() + v.square()).max() <= 81
    assert len(set(pixels.grey[0].tolist())) == PLACES
    assert pixels.inside.all()
    assert (pixels.behind == 7).all()


def test_grey_levels_are_as_they_were():
    frame = np.random.default_rng(3).integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
    stencil = disk_stencil(6.0)
    pixels = cut_pixels(frame, scene_of(BACKGROUND), LinesOfSight(camera("pinhole")), (20, 15), stencil)
    expected = frame[15 + stencil.down, 20 + stencil.right].astype(np.float32)
    assert pixels.grey.dtype == torch.float32
    assert pixels.grey[0].numpy().tolist() == expected.tolist()


@pytest.mark.parametrize("middle", [(2, 3), (WIDTH - 1, 20), (30, HEIGHT + 4), (-8, 20), (-30, -30), (400, 20)])
def test_places_beyond_the_picture_are_not_inside_and_the_others_are_right(middle):
    stencil, pixels = disk_stencil(9.0), disk(middle=middle)
    u, v = middle[0] + stencil.right, middle[1] + stencil.down
    within = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    assert pixels.inside[0].numpy().tolist() == within.tolist()
    assert pixels.grey[0].numpy()[within].tolist() == (u + 100 * v)[within].tolist()
    uv = torch.from_numpy(np.stack([u, v], axis=-1)[within]).double()
    assert_close(pixels.direction[0].T.double()[within], camera("pinhole").rays(uv).direction_lab, atol=1e-7)
    for part in (pixels.grey, pixels.direction, pixels.behind):
        assert part.isfinite().all()


def test_a_blurred_disk_is_that_of_the_blurred_picture():
    frame = np.random.default_rng(3).normal(100, 30, (HEIGHT, WIDTH)).astype(np.float32)
    background, stencil = frame[::-1].copy(), disk_stencil(9.0)
    sight = LinesOfSight(camera("pinhole"))
    for middle in ((30, 20), (25, 24)):
        pixels = cut_pixels(frame, scene_of(background), sight, middle, stencil, blur_px=1.5)
        at = np.s_[middle[1] + stencil.down, middle[0] + stencil.right]
        for part, picture in ((pixels.grey, frame), (pixels.behind, background)):
            whole = cv2.GaussianBlur(picture, (0, 0), 1.5)
            # The window is cut three deviations beyond the disk; OpenCV's own kernel ends there too.
            assert np.abs(part[0].numpy() - whole[at]).max() < 0.5
        assert pixels.grey.std() < 12


def test_the_frame_is_not_written_to():
    frame, behind = places(), BACKGROUND.copy()
    cut_pixels(frame, scene_of(behind), LinesOfSight(camera("pinhole")), (30, 20), disk_stencil(9.0), blur_px=1.0)
    assert (frame == places()).all()
    assert (behind == BACKGROUND).all()


@pytest.mark.parametrize(("radius_px", "step_px"), [(9.0, 1), (20.5, 1), (20.5, 2), (31.0, 3)])
def test_a_stencil_is_all_places_within_its_radius_but_the_outermost_few(radius_px, step_px):
    stencil = disk_stencil(radius_px, step_px)
    got = set(zip(stencil.right.tolist(), stencil.down.tolist(), strict=True))
    around = range(-40, 41)
    expected = {
        (u, v) for u in around for v in around if u % step_px == v % step_px == 0 and u * u + v * v <= radius_px**2
    }
    assert got <= expected
    assert len(got) == len(stencil.right) == len(expected) // VECTOR * VECTOR
    # Left-out places are farther than all others.
    left_out = [u * u + v * v for u, v in expected - got]
    assert min(left_out, default=math.inf) >= max(u * u + v * v for u, v in got)
    assert stencil.reach >= max(abs(u) for u, _ in got)


@pytest.mark.parametrize(("count", "whole"), [(1, 32), (31, 32), (32, 32), (33, 32), (63, 32), (64, 64), (253, 224)])
def test_batches_fill_whole_vectors(count, whole):
    assert whole_vectors(count) == whole


def test_places_are_in_order_of_distance_and_the_first_ones_are_well_within():
    stencil = disk_stencil(20.5)
    distance = np.hypot(stencil.right, stencil.down)
    assert (np.diff(distance) >= 0).all()
    assert distance[stencil.inner - 1] < 0.67 * 20.5 <= distance[stencil.inner]


@pytest.mark.parametrize("every", [2, 4, 8])
@pytest.mark.parametrize("radius_px", [14.0, 22.3, 43.0])
def test_every_nth_place_covers_the_disk_evenly(radius_px, every):
    stencil = disk_stencil(radius_px)
    right, down = stencil.right / radius_px, stencil.down / radius_px
    for first in range(every):
        u, v = right[first::every], down[first::every]
        # Means of n independent places scatter by 0.5 / sqrt(n); a row-by-row order has a mean of 0.4.
        limit = 4 * 0.5 / math.sqrt(len(u))
        assert abs(u.mean()) < limit
        assert abs(v.mean()) < limit
        assert abs((u * v).mean()) < limit
        assert abs((u * u - v * v).mean()) < limit
        assert np.mean(u * u + v * v) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("radius_px", "blur_px", "tile_px"), [(9.0, 0.0, 6), (22.3, 0.5, 6), (30.0, 0.9, 9), (30.0, 3.0, 10)]
)
def test_tiles_are_squares_of_neighbours(radius_px, blur_px, tile_px):
    stencil = disk_stencil(radius_px, blur_px=blur_px)
    tile = stencil.tile.numpy()
    # Without gaps in their numbers, each a square, all places of a square in one.
    assert set(tile.tolist()) == set(range(tile.max() + 1))
    for k in range(tile.max() + 1):
        one = tile == k
        assert np.ptp(stencil.right[one]) < tile_px
        assert np.ptp(stencil.down[one]) < tile_px
        assert one.sum() <= tile_px**2
    assert tile.max() + 1 <= (2 * math.ceil(radius_px) // tile_px + 1) ** 2
    assert (np.bincount(tile) == tile_px**2).any()


def test_some_of_the_disks_by_mask_and_by_index():
    three = stacked([disk(middle=(20 + k, 20)) for k in range(3)])
    assert len(three) == 3
    by_mask, by_index = three.where(torch.tensor([True, False, True])), three.where(torch.tensor([2, 0]))
    for name in ("grey", "behind", "inside", "direction", "origin", "axes", "pitch_rad", "pitch_mm"):
        part = getattr(three, name)
        assert len(part) == 3
        assert getattr(by_mask, name).equal(part[[0, 2]])
        assert getattr(by_index, name).equal(part[[2, 0]])
    assert by_mask.inner == three.inner


@pytest.mark.parametrize("model", ["pinhole", "telecentric"])
def test_every_third_place(model):
    pixels = disk(model, radius_px=12.0)
    some = pixels.thinned(3)
    places = torch.arange(0, pixels.grey.shape[1], 3)[: some.grey.shape[1]]
    assert len(places) == whole_vectors((pixels.grey.shape[1] + 2) // 3)
    assert some.grey.equal(pixels.grey[:, places])
    assert some.inside.equal(pixels.inside[:, places])
    assert some.direction.equal(pixels.direction[:, :, places])
    assert some.tile.equal(pixels.tile[places])
    assert some.origin.shape[-1] == (len(places) if model == "telecentric" else 1)
    # The first `inner` places of the rest are again those well within.
    assert 0 < some.inner < len(places)
    assert (places[: some.inner] < pixels.inner).all()
    assert (places[some.inner :] >= pixels.inner).all()
    assert some.pitch_rad.equal(pixels.pitch_rad)


def test_cameras_of_one_and_of_many_origins_stand_in_one_record():
    one, many = disk("pinhole"), disk("telecentric")
    both = stacked([one, many, one])
    assert both.origin.shape == (3, 3, PLACES)
    assert both.origin[0].equal(one.origin[0].expand(3, PLACES))
    assert both.origin[1].equal(many.origin[0])
    assert both.direction[2].equal(one.direction[0])


def wide(**changes: object) -> FisheyeCamera:
    """A lens whose picture covers more than all directions."""
    common = {"R_cam_lab": f64(LOOKS[0]), "T_cam_lab_mm": f64([0.0, 0.0, 60.0]), "image_size": (WIDTH, HEIGHT)}
    lens = {"centre_px": f64([29.5, 21.5]), "f_px": f64([8.0, 8.0]), "k": f64([0.0] * 4)}
    return FisheyeCamera(**common | lens | changes)


def test_pixels_without_a_line_of_sight_do_not_count():
    far = math.hypot(29.5, 21.5) / 8.0
    scene = CameraScene(background=scene_of(BACKGROUND), diameter_px=18.0)
    view = CameraView.of("cam1", wide(), scene)
    assert far > math.pi
    assert view.background.shown is not None
    assert not view.background.shown[0, 0]
    assert view.background.shown[21, 29]
    assert view.background.shown[21, 42]  # 1.56 rad from the axis
    assert not view.background.shown[21, 44]  # 1.81 rad: a ball there is no disk
    assert torch.isfinite(view.sight.direction).all()
    cut = cut_pixels(places(), view.background, view.sight, (16.0, 12.0), disk_stencil(9.0))
    assert 0 < int(cut.inside.sum()) < cut.inside.numel()
    assert CameraView.of("cam1", camera("pinhole"), scene).background.shown is None


@pytest.mark.parametrize("u", [29, 35, 42, 50])
def test_axes_of_a_disk_are_square_to_its_line_of_sight_beside_a_fisheye_lens_too(u):
    sight = LinesOfSight(wide())
    (axes,) = sight.axes_at(torch.tensor([[u + 0.3, 20.7]]))
    assert_close(axes @ axes.mT, torch.eye(2), atol=1e-6)
    assert_close(axes @ sight.direction[:, 21, u], torch.zeros(2), atol=1e-6)
    assert_close(LinesOfSight(camera("tsai")).axes_at(torch.tensor([[u, 20]]))[0], f64(LOOKS[0])[:2].float())
