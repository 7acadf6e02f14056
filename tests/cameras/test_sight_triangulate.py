"""From two rays to a point."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from camera_examples import f64, tsai, turned
from conftest import assert_close

from sphereorient.cameras import Rays, nearest_point, triangulate
from sphereorient.errors import ShapeError

A = tsai(R_cam_lab=turned((0.1, 0.2, 0.3)))
B = tsai(-3e-4, R_cam_lab=turned((1.5, 0.1, -0.2)), T_cam_lab_mm=f64((1.0, 2.0, 490.0)))


def points(rng: torch.Generator, *shape: int) -> torch.Tensor:
    return (torch.rand(*shape, 3, generator=rng, dtype=torch.float64) - 0.5) * 100


def seen(x_lab_mm: torch.Tensor) -> tuple[Rays, Rays]:
    return A.rays(A.project(x_lab_mm)), B.rays(B.project(x_lab_mm))


@pytest.mark.parametrize("apart_mm", [0.0, 0.4])
def test_a_known_gap_is_found_and_the_point_is_its_middle(rng, apart_mm):
    x_lab_mm = points(rng, 100)
    rays_a, rays_b = seen(x_lab_mm)
    normal = torch.linalg.cross(rays_a.direction_lab, rays_b.direction_lab)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    aside = Rays(origin_lab_mm=rays_b.origin_lab_mm + apart_mm * normal, direction_lab=rays_b.direction_lab)
    point, gap = triangulate(rays_a, aside)
    assert_close(gap, torch.full((100,), apart_mm, dtype=torch.float64), atol=1e-9)
    assert_close(point, x_lab_mm + apart_mm / 2 * normal, atol=1e-9)


def test_two_axes_by_hand():
    along_x = Rays(origin_lab_mm=f64((-5.0, 0.0, 1.0)), direction_lab=f64((1.0, 0.0, 0.0)))
    along_y = Rays(origin_lab_mm=f64((2.0, -7.0, 4.0)), direction_lab=f64((0.0, 1.0, 0.0)))
    point, gap = triangulate(along_x, along_y)
    assert_close(point, f64((2.0, 0.0, 2.5)))
    assert_close(gap, f64(3.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_parallel_rays_give_nan_without_poisoning_gradients(sign, dtype):
    direction = torch.tensor([0.6, 0.0, 0.8], dtype=dtype)
    directions = torch.stack([sign * direction, torch.tensor([0.0, 1.0, 0.0], dtype=dtype)]).requires_grad_()
    rays_a = Rays(origin_lab_mm=torch.zeros(3, dtype=dtype), direction_lab=direction)
    rays_b = Rays(origin_lab_mm=torch.tensor([0.0, 1.0, 2.0], dtype=dtype), direction_lab=directions)
    point, gap = triangulate(rays_a, rays_b)
    assert torch.isnan(point).all(-1).tolist() == torch.isnan(gap).tolist() == [True, False]
    (gradient,) = torch.autograd.grad(torch.nan_to_num(point).sum() + torch.nan_to_num(gap).sum(), directions)
    assert torch.isfinite(gradient).all()


def test_gradients_are_right(rng):
    x_lab_mm = points(rng, 4)
    rays_a, rays_b = seen(x_lab_mm)
    start = (rays_a.direction_lab.requires_grad_(), (rays_b.origin_lab_mm + 0.3).detach().requires_grad_())

    def run(direction: torch.Tensor, origin: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return triangulate(
            Rays(origin_lab_mm=rays_a.origin_lab_mm, direction_lab=direction),
            Rays(origin_lab_mm=origin, direction_lab=rays_b.direction_lab),
        )

    assert torch.autograd.gradcheck(run, start)


def test_the_gradient_at_a_gap_of_zero_is_finite():
    direction = f64((0.0, 1.0, 0.0)).requires_grad_()
    along_x = Rays(origin_lab_mm=f64((-5.0, 0.0, 1.0)), direction_lab=f64((1.0, 0.0, 0.0)))
    _, gap = triangulate(along_x, Rays(origin_lab_mm=f64((2.0, -7.0, 1.0)), direction_lab=direction))
    (gradient,) = torch.autograd.grad(gap, direction)
    assert gap.item() == 0
    assert torch.isfinite(gradient).all()


def test_a_batch_is_the_stack_of_its_singles(rng, dtype, batch):
    x_lab_mm = points(rng, *batch).to(dtype)
    rays_a, rays_b = seen(x_lab_mm)
    point, gap = triangulate(rays_a, rays_b)
    assert point.shape == (*batch, 3)
    assert gap.shape == batch
    assert point.dtype == gap.dtype == dtype
    parts = [rays.reshape(-1, 3) for ray in (rays_a, rays_b) for rays in (ray.origin_lab_mm, ray.direction_lab)]
    for oa, da, ob, db, expected in zip(*parts, point.reshape(-1, 3), strict=True):
        single, _ = triangulate(Rays(origin_lab_mm=oa, direction_lab=da), Rays(origin_lab_mm=ob, direction_lab=db))
        assert_close(single, expected, atol=2e-3 if dtype == torch.float32 else 1e-10)


def test_one_ray_meets_many(rng):
    x_lab_mm = points(rng, 6)
    _, rays_b = seen(x_lab_mm)
    one = A.rays(A.project(x_lab_mm[0]))
    point, gap = triangulate(one, rays_b)
    assert point.shape == (6, 3)
    assert_close(point[0], x_lab_mm[0], atol=1e-9)
    assert gap[1:].min() > 1e-3


def test_another_shape_is_refused():
    bad = Rays(origin_lab_mm=torch.zeros(4, 2), direction_lab=torch.zeros(4, 2))
    with pytest.raises(ShapeError, match="rays_a"):
        triangulate(bad, bad)


C = tsai(R_cam_lab=turned((0.7, -0.9, 0.4)))


def aside(rays: Rays, rng: torch.Generator) -> Rays:
    """Rays that pass their points at a distance."""
    off = 0.3 * torch.randn(rays.origin_lab_mm.shape, generator=rng, dtype=torch.float64)
    return Rays(origin_lab_mm=rays.origin_lab_mm + off, direction_lab=rays.direction_lab)


def test_the_point_of_three_rays_has_the_least_squares_of_distances(rng):
    x_lab_mm = points(rng, 5)
    rays = [aside(one, rng) for one in (*seen(x_lab_mm), C.rays(C.project(x_lab_mm)))]
    point, gap = nearest_point(rays)
    for k in range(5):
        # Oracle: lstsq of each ray's two components across it.
        across = [np.linalg.svd(ray.direction_lab[k].numpy()[None])[2][1:] for ray in rays]
        sides = [rows @ ray.origin_lab_mm[k].numpy() for rows, ray in zip(across, rays, strict=True)]
        expected = np.linalg.lstsq(np.concatenate(across), np.concatenate(sides), rcond=None)[0]
        np.testing.assert_allclose(point[k].numpy(), expected, atol=1e-8)
    assert_close(gap, torch.stack([triangulate(rays[k], rays[m])[1] for k, m in ((0, 1), (0, 2), (1, 2))]).amax(0))


def test_a_ray_that_is_missing_takes_no_part_and_one_alone_gives_no_point(rng):
    x_lab_mm = points(rng, 3)
    a, b = (aside(one, rng) for one in seen(x_lab_mm))
    pixels = C.project(x_lab_mm)
    pixels[0] = torch.nan
    c = C.rays(pixels)
    b.direction_lab[2], a.direction_lab[2] = torch.nan, torch.nan
    point, gap = nearest_point([a, b, c])
    two = triangulate(a, b)
    assert_close(point[0], two[0][0], atol=1e-9)
    assert_close(gap[0], two[1][0])
    assert torch.isfinite(point[1]).all()
    assert point[2].isnan().all()
    assert gap[2].isnan()


def test_parallel_rays_meet_nowhere():
    along = [Rays(origin_lab_mm=f64((0.0, float(k), 0.0)), direction_lab=f64((1.0, 0.0, 0.0))) for k in range(3)]
    assert nearest_point(along)[0].isnan().all()
