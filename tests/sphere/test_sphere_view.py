"""The canonical view: normals of its pixels, and its pictures (docs/errata.md A4)."""

import math
from functools import partial

import pytest
import torch
from conftest import assert_close
from sphere_examples import f64, looked_up, random_map

from sphereorient import so3
from sphereorient.cameras import PinholeCamera
from sphereorient.errors import ShapeError
from sphereorient.sphere import orthographic_view, perspective_view, sphere_normals
from sphereorient.sphere.view import disk_offsets

TO_CAMERA = f64([0, 0, -1])
# Body +z, a pole, towards the camera: view z points away from it.
NORTH_TO_CAMERA = f64([[1, 0, 0], [0, -1, 0], [0, 0, -1]])


def test_offsets_are_pixel_centres_in_radii_right_and_down():
    offset = disk_offsets(4)
    assert_close(offset[0, 0], f64([-0.75, -0.75]))
    assert_close(offset[0, 3], f64([0.75, -0.75]))  # row 0 is the top, column 3 the right
    assert_close(offset[2, 1], f64([-0.25, 0.25]))


@pytest.mark.parametrize("view_of", [orthographic_view, lambda s, dtype: perspective_view(s, 2.0, dtype)])
def test_normals_are_units_that_face_the_camera(dtype, tolerance, view_of):
    view = view_of(31, dtype=dtype)
    assert view.normal_view.dtype == dtype
    assert_close(view.normal_view.norm(dim=-1), torch.ones(int(view.inside.sum()), dtype=dtype), atol=tolerance)
    assert (view.normal_view[:, 2] < 0).all()
    assert torch.equal(view.inside, disk_offsets(31).norm(dim=-1) < 1)
    # The middle of an odd disk looks straight back, the pixel right of it to the right, the one below down.
    picture = view.picture(view.normal_view.mT, outside=0.0)
    assert_close(picture[:, 15, 15].double(), TO_CAMERA)
    assert picture[0, 15, 16] > 0.01
    assert picture[1, 16, 15] > 0.01


def test_the_orthographic_pixel_at_0_6_0_shows_the_normal_0_6_0_minus_0_8():
    view = orthographic_view(5, torch.float64)  # pixel centres at -0.8, -0.4, 0, 0.4, 0.8 radii
    picture = view.picture(view.normal_view.mT)
    assert_close(picture[:, 2, 4], f64([0.8, 0.0, -0.6]), atol=1e-15)
    assert_close(picture[:, 1, 2], f64([0.0, -0.4, -math.sqrt(0.84)]))


def test_a_picture_holds_the_disks_values_row_by_row_and_leaves_them_alone():
    view = orthographic_view(4)
    values = torch.arange(float(view.inside.sum()), requires_grad=True)
    picture = view.picture(torch.stack([values, -values]), outside=9.0)
    assert picture.shape == (2, 4, 4)
    assert torch.equal(picture[0][view.inside], values)
    assert (picture[:, ~view.inside] == 9.0).all()
    (gradient,) = torch.autograd.grad(picture[0].sum(), values)
    assert torch.equal(gradient, torch.ones_like(values))


@pytest.mark.parametrize("distance", [1.05, 2.0, 60.0])
def test_the_visible_cap_ends_before_the_great_circle_by_asin_of_1_over_distance(distance):
    view = perspective_view(801, distance, torch.float64)
    tilt = torch.rad2deg(torch.acos(view.normal_view @ TO_CAMERA))
    rim_deg = 90 - math.degrees(math.asin(1 / distance))
    assert tilt.max() < rim_deg
    # The pixel nearest to the rim lies within half a pixel of it, where the normal turns as a square root.
    assert tilt.max() > rim_deg - 4
    assert orthographic_view(801, torch.float64).normal_view[:, 2].max() > -math.sin(math.radians(4))


def test_the_perspective_normal_is_the_one_of_the_law_of_sines():
    distance = 2.0
    view = perspective_view(41, distance, torch.float64)
    offset = disk_offsets(41)[view.inside]
    ray = torch.atan(offset.norm(dim=-1) / math.sqrt(distance**2 - 1))  # angle from the axis; 30 degrees at the rim
    tilt = torch.asin(distance * ray.sin()) - ray  # of the normal; 60 degrees at the rim
    assert_close(torch.atan2(view.normal_view[:, :2].norm(dim=-1), -view.normal_view[:, 2]), tilt, atol=1e-12)
    sideways = view.normal_view[:, :2] - offset * (tilt.sin() / offset.norm(dim=-1).clamp_min(1e-9))[:, None]
    assert sideways.abs().max() < 1e-12


def test_from_very_far_the_perspective_view_is_the_orthographic_one():
    far, flat = perspective_view(40, 1e6, torch.float64), orthographic_view(40, torch.float64)
    assert torch.equal(far.inside, flat.inside)
    assert_close(far.normal_view, flat.normal_view, atol=1e-5)
    near = perspective_view(40, 30.0, torch.float64)
    assert (near.normal_view - flat.normal_view).abs().max() > 0.01


def test_off_the_axis_the_outline_is_longer_and_its_centre_is_not_the_projected_centre():
    # docs/errata.md A4's numbers: 15 degrees off the axis, diameter / depth 0.035, 80 px: 3.5 % longer, 0.2 px beside.
    focal_px, aside = 80 / 0.035, math.radians(15)
    camera = PinholeCamera(
        image_size=(2000, 400),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
        T_cam_lab_mm=torch.zeros(3, dtype=torch.float64),
        centre_px=f64([200, 200]),
        f_px=f64(focal_px),
    )
    centre, radius = f64([math.tan(aside), 0, 1.0]), 0.0175
    u, v = camera.project(centre)
    steps = torch.arange(-50, 50, 0.002, dtype=torch.float64)

    def extent(along: torch.Tensor) -> tuple[float, float]:
        rays = camera.rays(torch.stack([u, v]) + steps[:, None] * along)
        _, depth2 = sphere_normals(rays.origin_lab_mm, rays.direction_lab, centre, radius)
        return float(steps[depth2 > 0].min()), float(steps[depth2 > 0].max())

    left, right = extent(f64([1, 0]))
    top, bottom = extent(f64([0, 1]))
    assert (left + right) / 2 == pytest.approx(0.2, abs=0.02)
    assert abs(top + bottom) < 0.005
    assert (right - left) / (bottom - top) == pytest.approx(1.035, abs=0.002)


# --- rays and spheres


def test_a_ray_meets_the_near_side():
    normal, depth2 = sphere_normals(f64([0, 0, 0]), f64([0, 0, 7]), f64([0, 0, 10]), 2.0)
    assert depth2 > 0
    assert_close(normal, f64([0, 0, -1]))
    normal, depth2 = sphere_normals(f64([0, 1.2, 0]), f64([0, 0, 1]), f64([0, 0, 10]), 2.0)
    assert depth2 > 0
    assert_close(normal, f64([0, 0.6, -0.8]), atol=1e-15)


def test_a_ray_that_misses_gets_the_normal_nearest_to_it():
    normal, depth2 = sphere_normals(f64([3, 0, 0]), f64([0, 0, 1]), f64([0, 0, 10]), 2.0)
    assert depth2 < 0
    assert_close(normal, f64([1, 0, 0]))


def test_normals_lead_from_the_centre_to_a_point_of_the_ray(rng, dtype):
    origin = torch.randn(200, 3, generator=rng, dtype=torch.float64).to(dtype)
    centre = origin.new_tensor([2.0, 1.0, 14.0])
    direction = centre + 1.5 * torch.randn(200, 3, generator=rng, dtype=torch.float64).to(dtype) - origin
    normal, depth2 = sphere_normals(origin, direction, centre, 2.5)
    assert 20 < int((depth2 > 0).sum()) < 200
    point = (centre + 2.5 * normal - origin)[depth2 > 0]
    off = torch.linalg.cross(point, direction[depth2 > 0] / direction[depth2 > 0].norm(dim=-1, keepdim=True))
    assert off.abs().max() < {torch.float64: 1e-12, torch.float32: 5e-5}[dtype]
    assert ((normal * direction)[depth2 > 0].sum(-1) <= 0).all()


def test_gradients_in_the_centre_are_right_inside_the_disk(rng):
    direction = torch.nn.functional.pad(0.05 * torch.randn(8, 2, generator=rng, dtype=torch.float64), (0, 1), value=1.0)
    centre = f64([0.1, -0.2, 10.0]).requires_grad_()
    origin = torch.zeros(3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c: sphere_normals(origin, direction, c, 2.0)[0], centre)


@pytest.mark.parametrize("aside", [2.0, 2.0 - 1e-15, 2.0 - 1e-9, 2.0 + 1e-9, 0.0])
def test_gradients_are_finite_at_the_limb_and_in_the_middle(dtype, aside):
    origin = torch.tensor([aside, 0, 0], dtype=dtype)
    centre = torch.tensor([0, 0, 10.0], dtype=dtype, requires_grad=True)
    normal, _ = sphere_normals(origin, origin.new_tensor([0, 0, 1.0]), centre, 2.0)
    (gradient,) = torch.autograd.grad(normal.sum(), centre)
    assert torch.isfinite(normal).all()
    assert torch.isfinite(gradient).all()


def test_a_batch_of_rays_is_the_stack_of_its_singles(rng, dtype, tolerance, batch):
    direction = torch.randn(*batch, 3, generator=rng, dtype=torch.float64).to(dtype)
    origin, centre = direction.new_zeros(3), direction.new_tensor([0, 0, 3.0])
    normal, depth2 = sphere_normals(origin, direction, centre, 2.5)
    assert normal.shape == (*batch, 3)
    assert depth2.shape == batch
    for k, single in enumerate(direction.reshape(-1, 3)):
        one, one_depth2 = sphere_normals(origin, single, centre, 2.5)
        assert_close(one, normal.reshape(-1, 3)[k], atol=10 * tolerance)
        assert (one_depth2 > 0) == (depth2.reshape(-1)[k] > 0)


def test_rays_without_three_components_are_refused():
    with pytest.raises(ShapeError, match=r"direction: expected shape \(\.\.\., 3\)"):
        sphere_normals(torch.zeros(3), torch.zeros(4, 2), torch.zeros(3), 1.0)


# --- pictures


@pytest.mark.parametrize("view_of", [orthographic_view, lambda s, dtype: perspective_view(s, 3.0, dtype)])
def test_it_agrees_with_a_lookup_in_numpy_pixel_by_pixel(rng, dtype, view_of):
    texture, view = random_map(rng), view_of(24, dtype=dtype)
    R_view_body = so3.random_rotations(6, generator=rng)
    picture = view.render(texture.to(dtype), R_view_body.to(dtype), outside=-1.0)
    assert picture.dtype == dtype
    assert picture.shape == (6, 24, 24)
    atol = {torch.float64: 1e-12, torch.float32: 3e-5}[dtype]
    for got, R in zip(picture, R_view_body, strict=True):
        assert (got[~view.inside] == -1.0).all()
        expected = looked_up(texture, torch.stack([R.T @ n for n in view.normal_view.double()]))
        assert_close(got[view.inside].double(), torch.from_numpy(expected), atol=atol)
        # The transpose is another attitude, with another picture.
        transposed = torch.from_numpy(looked_up(texture, view.normal_view.double() @ R.T))
        assert (got[view.inside].double() - transposed).abs().mean() > 0.1


def test_turning_the_body_about_the_line_of_sight_turns_the_picture(rng):
    view = orthographic_view(20, torch.float64)
    render = partial(view.render, random_map(rng))
    R_view_body = so3.random_rotations((), generator=rng)
    # z points away from the camera, y down: a rotation by +90 degrees takes right to down, clockwise for the view.
    turned = render(so3.exp(f64([0, 0, math.pi / 2])) @ R_view_body)
    assert_close(turned, render(R_view_body).rot90(-1), atol=1e-12)


def test_gradients_are_right_in_the_orientation_and_in_the_map(rng):
    view = orthographic_view(6, torch.float64)
    texture = random_map(rng, 4)
    R_view_body = so3.random_rotations(2, generator=rng).requires_grad_()
    assert torch.autograd.gradcheck(view.render, (texture.clone().requires_grad_(), R_view_body))


def test_the_pictures_slope_is_the_turning_of_the_map(rng):
    # Grey = latitude: turning about the view's x axis by a small angle moves the paint along the meridian through the
    # disk's middle by that angle, with any interpolation.
    height = 180
    latitude = math.pi / 2 - math.pi * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    texture = latitude[:, None].expand(height, 2 * height)
    render = partial(orthographic_view(11, torch.float64).render, texture)
    # Body x towards the camera, body z up.
    R_view_body = f64([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    delta = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    middle = render(so3.exp(delta) @ R_view_body)[5, 5]
    (gradient,) = torch.autograd.grad(middle, delta)
    # A rotation about x takes y down to z away: paint facing the camera (-z) moves down (+y), northern paint comes in.
    assert_close(gradient, f64([1, 0, 0]), atol=1e-6)


@pytest.mark.parametrize("pole", [1.0, -1.0])
def test_gradients_are_finite_where_a_pixel_shows_a_pole(rng, dtype, pole):
    view = orthographic_view(7, dtype)
    R = (NORTH_TO_CAMERA * f64([1, pole, pole])).to(dtype).requires_grad_()
    picture = view.render(random_map(rng).to(dtype), R)
    (gradient,) = torch.autograd.grad(picture.sum(), R)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() < 1e3


def test_gradients_are_finite_at_the_limb(rng, dtype):
    for view in (orthographic_view(41, dtype), perspective_view(41, 1.5, dtype)):
        R = so3.random_rotations((), generator=rng, dtype=dtype).requires_grad_()
        texture = random_map(rng, 8).to(dtype).requires_grad_()
        picture = view.render(texture, R)
        for gradient in torch.autograd.grad(picture.square().sum(), (R, texture)):
            assert torch.isfinite(gradient).all()


def test_a_batch_is_the_stack_of_its_singles(rng, dtype, tolerance, batch):
    render = partial(orthographic_view(9, dtype).render, random_map(rng, 8).to(dtype))
    R_view_body = so3.random_rotations(batch, generator=rng, dtype=dtype)
    picture = render(R_view_body)
    assert picture.shape == (*batch, 9, 9)
    assert picture.dtype == dtype
    for R, expected in zip(R_view_body.reshape(-1, 3, 3), picture.reshape(-1, 9, 9), strict=True):
        assert_close(render(R), expected, atol=20 * tolerance)


def test_a_matrix_that_is_no_rotation_is_refused(rng):
    with pytest.raises(ShapeError, match="R_view_body"):
        orthographic_view(8).render(random_map(rng), torch.zeros(3, 4))
