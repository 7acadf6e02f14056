import math

import cv2
import numpy as np
import pytest
import torch
from synth_examples import behind_wall, camera, f64, scene, seen_at

from sphereorient import so3
from sphereorient.sphere import see_sphere
from sphereorient.sphere.renderer import fine_pixels, lambert
from sphereorient.synth import SynthSettings, make_scene, random_texture, render_frame
from sphereorient.synth.scene import LAMPS, LIT, SUPERSAMPLING, expose, exposures, seeded

UPRIGHT = torch.eye(3, dtype=torch.float64)


def picture(a_scene, place, R_lab_body=UPRIGHT, lens=None, seed=0) -> np.ndarray:
    return render_frame(a_scene, lens or camera(), place[None], R_lab_body[None], seeded(seed))


def centre_of_mass(grey: np.ndarray) -> tuple[float, float]:
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]]
    weight = grey.astype(np.float64)
    return float((u * weight).sum() / weight.sum()), float((v * weight).sum() / weight.sum())


@pytest.mark.parametrize("beside", [(0.0, 0.0), (4.0, -2.3), (-3.1, 2.0), (0.7, 3.3)], ids=str)
def test_a_small_white_sphere_is_where_the_camera_projects_its_centre(beside):
    # 10 px: the ellipse's centre differs from the projection by 1e-3 px only (docs/errata.md A4).
    lens = camera()
    place = seen_at(lens, *beside)
    u, v = centre_of_mass(picture(scene(diameter_mm=5.0, diameter_px=10.0), place, lens=lens))
    expected = lens.project(place).tolist()
    assert u == pytest.approx(expected[0], abs=0.05)
    assert v == pytest.approx(expected[1], abs=0.05)


def test_the_disk_has_its_size_and_the_level_of_white_paint():
    lens = camera()
    grey = picture(scene(white=170.0), seen_at(lens, 0, 0), lens=lens)
    assert grey.dtype == np.uint8
    assert grey.shape == (160, 200)
    assert grey.max() == 170
    assert set(np.unique(grey[:20])) == {0}
    # 18 mm at 400 mm through 800 px: the limb's radius is f tan(asin(9 / 400)) = 18.005 px.
    assert grey.sum() / 170 == pytest.approx(np.pi * 18.005**2, rel=3e-3)


def test_twice_as_far_is_half_as_large():
    near, far = (picture(scene(), seen_at(camera(), 0, 0, depth)).astype(float).sum() for depth in (400.0, 800.0))
    assert near / far == pytest.approx(4.0, rel=0.01)


def test_paint_and_background_have_their_levels():
    lens, half = camera(), torch.zeros(32, 64)
    half[:16] = 1.0  # the northern half is white
    # Body z to the camera's up.
    R_lab_body = lens.R_cam_lab.T @ f64([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    grey = picture(scene(half, white=200.0, black=40.0, background=90.0), seen_at(lens, 0, 0), R_lab_body, lens)
    u, v = (round(c) for c in lens.project(seen_at(lens, 0, 0)).tolist())
    assert grey[v - 8, u] == 200
    assert grey[v + 8, u] == 40
    assert grey[5, 5] == 90


def test_the_underside_is_darker_unless_the_light_is_even():
    lens = camera()
    place = seen_at(lens, 0, 0)
    u, v = (round(c) for c in lens.project(place).tolist())
    up = lens.R_cam_lab[:2, 2].numpy()  # picture direction of lab z
    lit = picture(scene(ambient=0.2), place, lens=lens)
    above, below = ((round(v + s * 12 * up[1]), round(u + s * 12 * up[0])) for s in (1, -1))
    assert lit[above] > lit[below] + 20
    even = picture(scene(ambient=1.0), place, lens=lens)
    assert even[above] == even[below]


def test_a_long_exposure_is_the_mean_of_its_instants():
    lens, a_scene = camera(), scene(random_texture("blobs", 1, 64), background=30.0)
    places = torch.stack([seen_at(lens, 0.0, 0.0), seen_at(lens, 0.5, -0.3)])
    R = so3.random_rotations(2, generator=torch.Generator().manual_seed(1))
    both = render_frame(a_scene, lens, places, R, seeded(0)).astype(float)
    single = [picture(a_scene, place, r, lens).astype(float) for place, r in zip(places, R, strict=True)]
    assert np.abs(both - (single[0] + single[1]) / 2).max() <= 1.0  # each is rounded to whole levels


@pytest.mark.parametrize("beside", [(40.0, 0.0), (-40.0, 0.0), (0.0, 40.0), (0.0, -40.0)], ids=str)
def test_a_sphere_beside_the_picture_leaves_the_background(beside):
    assert (picture(scene(background=17.0), seen_at(camera(), *beside)) == 17).all()


def test_a_sphere_that_the_border_cuts_is_the_part_of_the_whole_one():
    lens, wide = camera((200, 160)), camera((260, 220))
    # The wide picture's axis pixel is 30 px further right and down.
    place = seen_at(lens, 7.0, 5.0)
    assert np.array_equal(picture(scene(), place, lens=lens), picture(scene(), place, lens=wide)[30:190, 30:230])
    assert picture(scene(), place, lens=lens)[:, -1].max() > 0


@pytest.mark.parametrize("beyond_px", [15.0, 17.0, 17.5, 18.0, 18.5, 18.9, 19.5])
def test_a_ball_that_reaches_a_few_rows_of_the_picture_is_there(beyond_px):
    tall, low = camera((200, 160)), camera((200, 100))  # both look along one axis
    place = seen_at(tall, 0.0, math.degrees(math.atan((49.5 + beyond_px) / 800)))
    whole = expose([scene()], tall, place[None, None], UPRIGHT[None, None]).before(5.0)[30:130]
    cut = expose([scene()], low, place[None, None], UPRIGHT[None, None]).before(5.0)
    np.testing.assert_allclose(cut, whole, atol=1e-3)


def test_blur_is_the_gaussian_of_its_width():
    place = seen_at(camera(), 0, 0)
    sharp = picture(scene(), place).astype(np.float32)
    blurred = picture(scene(blur_px=1.5), place).astype(np.float32)
    assert np.abs(blurred - cv2.GaussianBlur(sharp, (0, 0), 1.5)).max() <= 1.0


def test_noise_has_its_standard_deviation_and_its_seed():
    place = seen_at(camera(), 40.0, 0.0)
    dark = [picture(scene(background=60.0, read_noise=3.0), place, seed=s).astype(float) for s in (1, 1, 2)]
    assert np.array_equal(dark[0], dark[1])
    assert not np.array_equal(dark[0], dark[2])
    assert dark[0].std() == pytest.approx(np.hypot(3.0, 12**-0.5), rel=0.03)  # and rounding
    noisy = picture(scene(background=100.0, shot_noise=0.4), place).astype(float)
    assert noisy.std() == pytest.approx(np.hypot(4.0, 12**-0.5), rel=0.03)
    assert noisy.mean() == pytest.approx(100.0, abs=0.2)


def test_a_scene_holds_the_map_at_the_pictures_resolution():
    # 3 rays a pixel: 3 x 40 px of diameter show 377 texels around.
    assert make_scene(torch.zeros(512, 1024), SynthSettings(diameter_px=40.0)).texture.shape == (256, 512)


@pytest.mark.parametrize("lens", [camera(), behind_wall(camera())], ids=["air", "wall"])
def test_fast_pixels_are_those_of_see_sphere(lens):  # oracle: the renderer's own rays, all in double precision
    texture = random_texture("blobs", 3, 64)
    a_scene = scene(texture, ambient=0.3, background=7.0)
    places = torch.stack([seen_at(camera(), 1.0, -0.5), seen_at(camera(), 1.1, -0.45)])
    R = so3.random_rotations(2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    exposure = expose([a_scene], lens, places[None], R[None])
    at = fine_pixels(200, SUPERSAMPLING)[: 160 * SUPERSAMPLING], fine_pixels(200, SUPERSAMPLING)
    v, u = torch.meshgrid(*at, indexing="ij")
    lamps = f64(LAMPS)
    towards = torch.nn.functional.normalize(lamps[:, :3], dim=-1)
    fine = torch.zeros(v.shape, dtype=torch.float64)
    for place, turn in zip(places, R, strict=True):
        seen = see_sphere(lens.rays(torch.stack([u, v], -1).flatten(0, 1)), place, turn, a_scene.texture, 9.0)
        light = 0.3 + 0.7 * lambert(seen.normal, towards, lamps[:, 3]) / LIT
        grey = (20.0 + 150.0 * seen.paint) * light
        fine += torch.where(seen.depth2 > 0, grey, 7.0).reshape(v.shape) / 2
    expected = torch.nn.functional.avg_pool2d(fine[None], SUPERSAMPLING)[0]
    assert np.abs(exposure.before(7.0) - expected.numpy()).max() < 0.01


def test_a_movie_is_its_frames_one_by_one():  # the batch law, also where rays are kept and where they are made anew
    lens, a_scene = camera(), scene(random_texture("dots", 4, 64), blur_px=0.6)
    places = torch.stack([seen_at(lens, 0.3 * k - 4.0, 0.1 * k) for k in range(24)]).reshape(1, 12, 2, 3)
    R = so3.random_rotations(24, generator=torch.Generator().manual_seed(3), dtype=torch.float64).reshape(
        1, 12, 2, 3, 3
    )
    movie = list(exposures([a_scene], lens, places, R))
    assert len(movie) == 12
    for k, exposure in enumerate(movie):
        alone = expose([a_scene], lens, places[:, k], R[:, k])
        assert exposure.window == alone.window
        np.testing.assert_array_equal(exposure.light, alone.light)
        np.testing.assert_array_equal(exposure.cover, alone.cover)
        wider = exposure.within(7)
        # The optics blur whole windows: sums of floats in another order.
        np.testing.assert_allclose(wider.before(3.0), exposure.before(3.0), rtol=1e-6)
