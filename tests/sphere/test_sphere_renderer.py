"""Pictures of the sphere: the renderer against the oracle, its gradients, its batches, and the table for banks."""

from __future__ import annotations

import math

import pytest
import torch
from conftest import assert_close
from sphere_examples import f64, looked_up, random_map

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.sphere import DirectionTable, SphereRenderer, orthographic_view, perspective_view, sample_texture
from sphereorient.synth import random_texture

# Body +z, a pole, towards the camera: view z points away from it.
NORTH_TO_CAMERA = f64([[1, 0, 0], [0, -1, 0], [0, 0, -1]])


@pytest.mark.parametrize("view_of", [orthographic_view, lambda s, dtype: perspective_view(s, 3.0, dtype)])
def test_it_agrees_with_a_lookup_in_numpy_pixel_by_pixel(rng, dtype, view_of):
    texture, view = random_map(rng), view_of(24, dtype=dtype)
    R_view_body = so3.random_rotations(6, generator=rng)
    picture = SphereRenderer(texture.to(dtype), view, outside=-1.0)(R_view_body.to(dtype))
    assert picture.dtype == dtype
    assert picture.shape == (6, 24, 24)
    atol = {torch.float64: 1e-12, torch.float32: 3e-5}[dtype]
    for got, R in zip(picture, R_view_body, strict=True):
        assert (got[~view.inside] == -1.0).all()
        expected = looked_up(texture, torch.stack([R.T @ n for n in view.normal_view.double()]))
        assert_close(got[view.inside].double(), torch.from_numpy(expected), atol=atol)
        # The transpose is another attitude, and seen.
        transposed = torch.from_numpy(looked_up(texture, view.normal_view.double() @ R.T))
        assert (got[view.inside].double() - transposed).abs().mean() > 0.1


def test_turning_the_body_about_the_line_of_sight_turns_the_picture(rng):
    view = orthographic_view(20, torch.float64)
    render = SphereRenderer(random_map(rng), view)
    R_view_body = so3.random_rotations((), generator=rng)
    # z points away from the camera, y down: a turn by +90 degrees takes right to down, clockwise for the view.
    turned = render(so3.exp(f64([0, 0, math.pi / 2])) @ R_view_body)
    assert_close(turned, render(R_view_body).rot90(-1), atol=1e-12)


def test_gradients_are_right_in_the_orientation_and_in_the_map(rng):
    view = orthographic_view(6, torch.float64)
    texture = random_map(rng, 4)
    render = SphereRenderer(texture, view)
    R_view_body = so3.random_rotations(2, generator=rng).requires_grad_()
    assert torch.autograd.gradcheck(render, (R_view_body, texture.clone().requires_grad_()))


def test_the_pictures_slope_is_the_turning_of_the_map(rng):
    # Grey = latitude: turning about the view's x axis by a small angle moves the paint along the meridian through the
    # disk's middle by that angle, whatever the interpolation.
    height = 180
    latitude = math.pi / 2 - math.pi * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    texture = latitude[:, None].expand(height, 2 * height)
    render = SphereRenderer(texture, orthographic_view(11, torch.float64))
    # Body x towards the camera, body z up.
    R_view_body = f64([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    delta = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    middle = render(so3.exp(delta) @ R_view_body)[5, 5]
    (gradient,) = torch.autograd.grad(middle, delta)
    # A turn about x right takes y down to z away: what faces the camera (-z) moves down (+y), what lay north comes in.
    assert_close(gradient, f64([1, 0, 0]), atol=1e-6)


@pytest.mark.parametrize("pole", [1.0, -1.0])
def test_gradients_are_finite_where_a_pixel_shows_a_pole(rng, dtype, pole):
    view = orthographic_view(7, dtype)
    R = (NORTH_TO_CAMERA * f64([1, pole, pole])).to(dtype).requires_grad_()
    picture = SphereRenderer(random_map(rng).to(dtype), view)(R)
    (gradient,) = torch.autograd.grad(picture.sum(), R)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() < 1e3


def test_gradients_are_finite_at_the_limb(rng, dtype):
    for view in (orthographic_view(41, dtype), perspective_view(41, 1.5, dtype)):
        R = so3.random_rotations((), generator=rng, dtype=dtype).requires_grad_()
        texture = random_map(rng, 8).to(dtype).requires_grad_()
        picture = SphereRenderer(texture.detach(), view)(R, texture)
        for gradient in torch.autograd.grad(picture.square().sum(), (R, texture)):
            assert torch.isfinite(gradient).all()


def test_a_batch_is_the_stack_of_its_singles(rng, dtype, tolerance, batch):
    render = SphereRenderer(random_map(rng, 8).to(dtype), orthographic_view(9, dtype))
    R_view_body = so3.random_rotations(batch, generator=rng, dtype=dtype)
    picture = render(R_view_body)
    assert picture.shape == (*batch, 9, 9)
    assert picture.dtype == dtype
    for R, expected in zip(R_view_body.reshape(-1, 3, 3), picture.reshape(-1, 9, 9), strict=True):
        assert_close(render(R), expected, atol=20 * tolerance)


def test_another_map_can_be_handed_in(rng):
    view = orthographic_view(12, torch.float64)
    first, second = random_map(rng), random_map(rng)
    R = so3.random_rotations(2, generator=rng)
    assert torch.equal(SphereRenderer(first, view)(R, second), SphereRenderer(second, view)(R))


def test_what_is_no_rotation_matrix_is_refused(rng):
    with pytest.raises(ShapeError, match=r"R_view_body: expected shape \(\.\.\., 3, 3\)"):
        SphereRenderer(random_map(rng), orthographic_view(8))(torch.zeros(3, 4))


@pytest.mark.parametrize(("kind", "seed"), [("blobs", 1), ("patches", 2), ("dots", 3)])
def test_the_table_differs_from_the_renderer_only_at_borders_of_paint(rng, kind, seed):
    texture, view = random_texture(kind, seed, 128), orthographic_view(60)
    R_view_body = so3.random_rotations(8, generator=rng, dtype=torch.float32)
    table = DirectionTable(texture).render(R_view_body, view.normal_view)
    assert table.dtype == torch.int8
    assert set(table.unique().tolist()) == {-1, 1}
    exact = SphereRenderer(texture, view).disk(R_view_body) >= 0.5
    differs = (table > 0) != exact
    assert 0 < differs.float().mean() < 0.03
    # The middle of a cell of 1/64 lies within sqrt(3)/128 rad = 0.78 degrees: both paints must be that near.
    direction = (view.normal_view @ R_view_body)[differs]
    near = direction[:, None] + 0.01 * torch.randn(len(direction), 60, 3, generator=rng)
    white = sample_texture(texture, near) >= 0.5
    assert (white.any(1) & ~white.all(1)).all()


def test_a_finer_table_differs_less(rng):
    texture, view = random_texture("blobs", 1, 128), orthographic_view(60)
    R_view_body = so3.random_rotations(10, generator=rng, dtype=torch.float32)
    exact = SphereRenderer(texture, view).disk(R_view_body) >= 0.5
    share = [
        float(((DirectionTable(texture, cells).render(R_view_body, view.normal_view) > 0) != exact).float().mean())
        for cells in (32, 64, 128)
    ]
    assert share[0] > 1.5 * share[1] > 2.25 * share[2]


def test_the_tables_answer_does_not_depend_on_the_others(rng):
    table, view = DirectionTable(random_texture("blobs", 1, 32), 32), orthographic_view(20)
    R_view_body = so3.random_rotations(70, generator=rng, dtype=torch.float32)  # more than two chunks
    together = table.render(R_view_body, view.normal_view)
    for k in (0, 31, 32, 69):
        assert torch.equal(table.render(R_view_body[k : k + 1], view.normal_view)[0], together[k])
    assert table.render(R_view_body[:0], view.normal_view).shape == (0, len(view.normal_view))


def test_axes_of_the_cube_stay_within_the_table():
    # Components of exactly 1, and a little above it, must not fall out of the last cell.
    table = DirectionTable(random_texture("blobs", 1, 32), 16)
    axes = torch.eye(3)
    assert table.render(axes[None] * (1 + 5e-7), torch.cat([axes, -axes])).abs().eq(1).all()


def test_a_cell_of_the_table_holds_the_paint_at_its_middle():
    # The equator is a border between cells: with the middles' paint the table of a half-white sphere is exact, and
    # that of its negative is its negative. With the corners' paint one of the two is off by a cell.
    north = torch.zeros(32, 64)
    north[:16] = 1.0
    view = orthographic_view(60)
    upright = f64([[0, 1, 0], [0, 0, -1], [-1, 0, 0]]).float()[None]
    up = torch.where(view.normal_view[:, 1] < 0, 1, -1).to(torch.int8)
    assert torch.equal(DirectionTable(north, 64).render(upright, view.normal_view)[0], up)
    assert torch.equal(DirectionTable(1 - north, 64).render(upright, view.normal_view)[0], -up)
