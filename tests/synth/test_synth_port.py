"""A ball in liquid behind a wall: outline and paint of its pictures are where the camera shows points of the sphere."""

import pytest
import torch
from conftest import assert_close
from synth_examples import WHITE_MAP, behind_wall, camera, f64, on_the_sphere, outline_of, scene, seen_at

from sphereorient import so3
from sphereorient.errors import CameraError
from sphereorient.sphere import Sampling, SphereRenderer
from sphereorient.sphere.renderer import reach_px
from sphereorient.sphere.texture import map_directions
from sphereorient.synth import random_texture, render_frame
from sphereorient.synth.scene import seeded

RADIUS_MM = 9.0
LENSES = {
    "near": behind_wall(camera()),  # the ball 120 mm behind the wall
    "deep": behind_wall(camera(f_px=600.0), n_fluid=1.9, offset_mm=330.0),  # most of the way lies in a strong liquid
    "beside": behind_wall(camera((500, 400))),  # the ball far from the axis
}
PLACE = {
    "near": seen_at(camera(), 1.0, -1.5),
    "deep": seen_at(camera(), -0.5, 1.0),
    "beside": seen_at(camera(), 11.0, 6.0),
}
TURN = so3.exp(f64([0.9, -1.3, 0.4]))


def clean(name: str, texture: torch.Tensor, R_lab_body: torch.Tensor = TURN, supersampling: int = 4) -> torch.Tensor:
    sampling = Sampling(supersampling=supersampling)
    render = SphereRenderer(texture, radius_mm=RADIUS_MM, camera=LENSES[name], sampling=sampling)
    return render(R_lab_body, PLACE[name])


def mass(grey: torch.Tensor) -> tuple[float, torch.Tensor]:
    """Sum of a picture, and its centre (2,) as (u, v)."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in grey.shape), indexing="ij")
    total = grey.sum()
    return float(total), torch.stack([(grey * u).sum(), (grey * v).sum()]) / total


@pytest.mark.parametrize("name", LENSES)
def test_the_outline_of_a_clean_picture_is_that_of_the_spheres_points(name):  # oracle
    area, middle = mass(clean(name, WHITE_MAP))
    expected_area, expected_middle = outline_of(LENSES[name], PLACE[name], RADIUS_MM)
    assert area == pytest.approx(expected_area, rel=1e-3)
    assert_close(middle, expected_middle, atol=5e-3)
    in_air, _ = outline_of(LENSES[name].camera, PLACE[name], RADIUS_MM)
    assert abs(area / in_air - 1) > 0.1  # the wall and the liquid matter


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_the_limb_is_as_wide_as_a_fine_sample(name):
    # With the soft limb four rays a pixel are right to a hundredth of the step. A limb as wide as directions
    # alone give, without the rays' begin at the wall, misses by two hundredths.
    assert float((clean(name, WHITE_MAP) - clean(name, WHITE_MAP, supersampling=24)).abs().max()) < 0.01


@pytest.mark.parametrize("name", LENSES)
def test_spots_of_paint_are_where_the_camera_shows_that_point_of_the_sphere(name):
    lens, place = LENSES[name], PLACE[name]
    sight = lens.rays(lens.project(place)).direction_lab
    for aside in ([0.0, 0.0, 0.0], [0.5, 0.0, 0.2], [-0.2, 0.4, -0.3]):
        toward = -sight + f64(aside)
        towards_lab = toward / toward.norm()
        spot = map_directions(512).double() @ (TURN.mT @ towards_lab) > 0.998
        _, middle = mass(clean(name, spot.float()))
        points = on_the_sphere(torch.zeros(3, dtype=torch.float64), 1.0, 200_000)
        points = points[points @ towards_lab > 0.998]  # weights: each point has its share of the picture
        facing = -(points @ sight)
        expected = (lens.project(place + RADIUS_MM * points) * facing[:, None]).sum(0) / facing.sum()
        assert_close(middle, expected, atol=0.03)


@pytest.mark.parametrize("name", LENSES)
def test_scene_and_clean_picture_show_the_same_paint(name):
    texture = random_texture("blobs", 3, 256)
    frame = render_frame(scene(texture, black=0.0, white=200.0), LENSES[name], PLACE[name][None], TURN[None], seeded(0))
    sampling = Sampling(blur_px=0.0)
    sharp = 200 * SphereRenderer(texture, radius_mm=RADIUS_MM, camera=LENSES[name], sampling=sampling)(
        TURN, PLACE[name]
    )
    assert float((torch.from_numpy(frame).double() - sharp).square().mean().sqrt()) < 1.5
    assert float((torch.from_numpy(frame).flip(-1).double() - sharp).square().mean().sqrt()) > 10


@pytest.mark.parametrize("name", LENSES)
def test_the_window_holds_the_whole_ball_and_little_more(name):
    lens, place = LENSES[name], PLACE[name]
    far = (lens.project(on_the_sphere(place, RADIUS_MM)) - lens.project(place)).norm(dim=-1).max()
    assert float(far) < reach_px(lens, place[None], RADIUS_MM) < 1.06 * float(far)


def test_a_ball_that_touches_the_wall_is_refused():
    lens = LENSES["near"]
    normal = lens.port.normal_lab
    at_the_wall = PLACE["near"] + (lens.port.offset_mm - 0.5 * RADIUS_MM - PLACE["near"] @ normal) * normal
    with pytest.raises(CameraError, match="visible ball"):
        render_frame(scene(), lens, at_the_wall[None], TURN[None], seeded(0))
