"""The fit with derivatives: against finite differences of the fit run again, and against fits solved by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from conftest import assert_close
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import PinholeCamera, Rays
from sphereorient.errors import SettingsError, ShapeError
from sphereorient.pose.implicit import ImplicitPose, full_curvature, gauss_newton_curvature, implicit_pose, moved
from sphereorient.pose.soft_picture import PaintedBall, expected_grey, lambert, smooth_positive, soft_normals
from sphereorient.sphere import sample_texture, sphere_normals
from sphereorient.sphere.spline_texture import sample_spline
from sphereorient.synth import random_texture
from sphereorient.synth.scene import LAMPS, expose, make_scene
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.textures import map_directions


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


@pytest.fixture
def points(rng) -> Tensor:
    """Points fixed to a body, (B, M, 3): a fit whose answer is known in closed form (Kabsch)."""
    return torch.randn(3, 8, 3, generator=rng, dtype=torch.float64)


def fitted_points(body: Tensor, seen: Tensor, **options: object) -> ImplicitPose:
    """Fit poses that take points of the body (B, M, 3) to where they are seen (B, M, 3), lab, mm."""

    def residual(R_lab_body: Tensor, position_lab_mm: Tensor) -> Tensor:
        return (body @ R_lab_body.mT + position_lab_mm[:, None] - seen).flatten(1)

    start = so3.exp(f64([0.3, -0.2, 0.4])).expand(len(body), 3, 3)
    return implicit_pose(residual, start, torch.zeros(len(body), 3, dtype=body.dtype), **options)  # type: ignore[arg-type]


def kabsch(body: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Poses by the closed form, differentiable by itself."""
    a, b = body.mean(1, keepdim=True), seen.mean(1, keepdim=True)
    R = so3.nearest_rotation((seen - b).mT @ (body - a))
    return R, (b - a @ R.mT)[:, 0]


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_values_and_gradients_are_those_of_the_closed_form(points, rng, noise):
    seen = points @ so3.exp(f64([0.5, 0.1, 0.2])).mT + f64([1.0, -2.0, 3.0])
    seen = (seen + noise * torch.randn(seen.shape, generator=rng, dtype=torch.float64)).requires_grad_()
    body = points.clone().requires_grad_()
    got, (R, X) = fitted_points(body, seen), kabsch(body, seen)
    assert got.arrived.all()
    assert_close(got.R_lab_body.detach(), R.detach(), 1e-11)
    assert_close(got.position_lab_mm.detach(), X.detach(), 1e-11)
    weight = torch.randn(3, 3, 3, generator=rng, dtype=torch.float64)
    for mine, oracle in (((got.R_lab_body * weight).sum(), (R * weight).sum()), (got.position_lab_mm.sum(), X.sum())):
        expected = torch.autograd.grad(oracle, (body, seen), retain_graph=True)
        for one, other in zip(torch.autograd.grad(mine, (body, seen), retain_graph=True), expected, strict=True):
            assert_close(one, other, 1e-9)


def test_gauss_newton_is_exact_without_residuals_and_biased_with_them(points, rng):
    exact = points @ so3.exp(f64([0.5, 0.1, 0.2])).mT
    off = torch.randn(exact.shape, generator=rng, dtype=torch.float64)
    weight = torch.randn(3, 3, 3, generator=rng, dtype=torch.float64)
    wrong = []
    for noise in (0.0, 0.05, 0.5):
        seen = (exact + noise * off).requires_grad_()
        full, short = (
            torch.autograd.grad((fitted_points(points, seen, curvature=kind).R_lab_body * weight).sum(), seen)[0]
            for kind in (full_curvature, gauss_newton_curvature)
        )
        wrong.append(float((short - full).norm() / full.norm()))
    assert wrong[0] < 1e-6
    assert 1e-3 < wrong[1] < 0.1
    assert wrong[2] > 3 * wrong[1]


def test_gradcheck(points, rng):
    seen = points[:1, :3] @ so3.exp(f64([0.5, 0.1, 0.2])).mT
    seen = (seen + 0.2 * torch.randn(seen.shape, generator=rng, dtype=torch.float64)).requires_grad_()

    def chain(seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        fit = fitted_points(points[:1, :3], seen, iterations=15)
        return fit.R_lab_body, fit.position_lab_mm, fit.cost

    assert torch.autograd.gradcheck(chain, (seen,), eps=1e-5, atol=1e-7, rtol=1e-5)


def nodes(tensor: Tensor) -> int:
    """Operations in a tensor's graph."""
    found, todo = set(), [tensor.grad_fn]
    while todo:
        node = todo.pop()
        if node is not None and node not in found:
            found.add(node)
            todo += [parent for parent, _ in node.next_functions]
    return len(found)


def test_neither_graph_nor_gradient_depends_on_the_number_of_iterations(points, rng):
    seen = points @ so3.exp(f64([0.5, 0.1, 0.2])).mT
    seen = (seen + 0.1 * torch.randn(seen.shape, generator=rng, dtype=torch.float64)).requires_grad_()
    few, many = (fitted_points(points, seen, iterations=count) for count in (10, 40))
    assert nodes(few.R_lab_body) == nodes(many.R_lab_body) > 0
    for one, other in ((few.R_lab_body, many.R_lab_body), (few.position_lab_mm, many.position_lab_mm)):
        weight = torch.randn(one.shape, generator=rng, dtype=torch.float64)
        gradients = [torch.autograd.grad((pose * weight).sum(), seen, retain_graph=True)[0] for pose in (one, other)]
        assert_close(*gradients, 1e-9)


def test_nothing_carries_a_gradient_where_nothing_asks_for_one(points):
    assert not fitted_points(points, points).R_lab_body.requires_grad


def test_frames_without_anything_are_nan_and_their_gradients_0(points):
    body, seen = points.clone(), points.clone()
    seen[1] = 0.0  # what is there does not matter
    seen.requires_grad_()
    use = torch.tensor([True, False, True])
    got, whole = fitted_points(body, seen, use=use), fitted_points(body, seen)
    assert got.R_lab_body[1].isnan().all()
    assert got.position_lab_mm[1].isnan().all()
    assert got.arrived.tolist() == [True, False, True]
    (gradient,) = torch.autograd.grad(got.R_lab_body[use].sum() + got.cost.sum(), seen)
    assert_close(gradient[1], torch.zeros_like(gradient[1]))
    assert_close(got.R_lab_body[use], whole.R_lab_body[use])  # the others do not notice
    nobody = fitted_points(body, seen, use=torch.zeros(3, dtype=torch.bool))
    assert_close(torch.autograd.grad(nobody.cost.sum(), seen)[0], torch.zeros_like(seen))


def test_starts_that_are_nan_are_not_used():
    body = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    scale = f64(1.0).requires_grad_()
    start = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    start[0] = torch.nan
    got = implicit_pose(lambda R, X: (scale * body @ R.mT + X[:, None] - body).flatten(1), start, f64([[0.0] * 3] * 2))
    assert got.arrived.tolist() == [False, True]
    assert torch.autograd.grad(got.cost.sum() + got.position_lab_mm[1].sum(), scale)[0].isfinite()


def test_what_nothing_determines_stays_and_has_no_gradient(points):
    # One point: a turn about it, and turns against moves, leave the residual as it is.
    seen = (points[:, :1] + 0.1).requires_grad_()
    got = fitted_points(torch.zeros_like(points[:, :1]), seen)
    assert_close(got.position_lab_mm, seen.detach()[:, 0], 1e-9)
    assert_close(got.R_lab_body, so3.exp(f64([0.3, -0.2, 0.4])).expand(3, 3, 3), 1e-12)
    (gradient,) = torch.autograd.grad(got.R_lab_body.sum() + got.position_lab_mm.sum(), seen)
    assert_close(gradient, torch.ones_like(gradient), 1e-6)


def test_a_fit_that_has_not_arrived_says_so_and_gives_no_gradient(points):
    seen = (points @ so3.exp(f64([2.0, 1.0, -1.0])).mT).requires_grad_()
    got = fitted_points(points, seen, iterations=1)
    assert not got.arrived.any()
    assert_close(torch.autograd.grad(got.R_lab_body.sum(), seen)[0], torch.zeros_like(seen))


def test_a_batch_is_the_stack_of_its_singles_and_may_be_empty(points, rng):
    seen = points + 0.1 * torch.randn(points.shape, generator=rng, dtype=torch.float64)
    whole = fitted_points(points, seen)
    for k in range(3):
        assert_close(fitted_points(points[k : k + 1], seen[k : k + 1]).R_lab_body[0], whole.R_lab_body[k], 1e-12)
    assert fitted_points(points[:0], seen[:0]).R_lab_body.shape == (0, 3, 3)


def test_single_precision_stays_single(points):
    got = implicit_pose(
        lambda R, X: (points.float() @ R.mT + X[:, None] - points.float()).flatten(1),
        so3.exp(torch.tensor([[0.1, 0.2, -0.1]] * 3)),
        torch.zeros(3, 3),
    )
    assert got.R_lab_body.dtype == got.cost.dtype == torch.float32
    assert_close(got.R_lab_body, torch.eye(3).expand(3, 3, 3), 1e-5)


def test_small_errors_multiply_from_the_left_in_lab_components():
    R, delta = so3.exp(f64([0.7, 0.2, -0.4]))[None], f64([[1e-3, -2e-3, 5e-4, 0.1, 0.2, 0.3]])
    turned, place = moved(R, f64([[1.0, 2.0, 3.0]]), delta)
    assert_close(turned, so3.exp(delta[:, :3]) @ R, 1e-9)  # the third order: (2.3e-3)^3 / 12
    assert_close(place, f64([[1.1, 2.2, 3.3]]))
    assert (turned - R @ so3.exp(delta[:, :3])).abs().max() > 1e-4
    large = moved(R, f64([[0.0] * 3]), f64([[0.3, 0.9, -0.5, 0.0, 0.0, 0.0]]))[0]
    assert_close(large @ large.mT, torch.eye(3, dtype=torch.float64)[None])


def test_what_does_not_belong_together_is_refused(points):
    view, zero = torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3)
    with pytest.raises(ShapeError, match="residual"):
        implicit_pose(lambda R, X: X.sum(), view, zero)
    with pytest.raises(ShapeError, match="R_start_lab_body"):
        implicit_pose(lambda R, X: X, view[:1], zero)
    with pytest.raises(ShapeError, match="batch"):
        implicit_pose(lambda R, X: X, view, zero[None])
    with pytest.raises(ShapeError, match="use"):
        implicit_pose(lambda R, X: X, view, zero, use=torch.ones(3, dtype=torch.bool))
    with pytest.raises(SettingsError, match="iterations"):
        implicit_pose(lambda R, X: X, view, zero, iterations=0)


# --- the picture model


def a_ball(texture: Tensor, edge_mm: float = 0.4) -> PaintedBall:
    lamps = f64([[-0.4, -0.5, 0.3], [0.3, -0.2, 0.2]])
    return PaintedBall(
        texture=texture,
        radius_mm=9.0,
        edge_mm=edge_mm,
        ambient=f64(0.5),
        lamps_lab=lamps,
        black=f64(20.0),
        white=f64(170.0),
        behind=f64(15.0),
    )


def sight(side: int = 25) -> tuple[PinholeCamera, Rays]:
    camera = PinholeCamera(
        image_size=(side, side),
        R_cam_lab=f64([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        T_cam_lab_mm=f64([0, 0, 300.0]),
        centre_px=f64([0.5 * (side - 1)] * 2),
        f_px=f64(side / 25 * 350.0),
    )
    v, u = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    return camera, camera.rays(torch.stack([u, v], dim=-1).reshape(-1, 2).double())


def test_inside_the_ball_the_picture_is_the_renderers(rng):
    # A map linear in the latitude is reproduced by the spline and by the bilinear look-up alike.
    texture = torch.linspace(1, 0, 16, dtype=torch.float64)[:, None].expand(16, 32)
    _, rays = sight()
    R, place = so3.random_rotations(4, generator=rng).double(), f64([[0.5, 3.0, -0.4]])
    normal, hit = sphere_normals(rays.origin_lab_mm, rays.direction_lab, place[:, None], 9.0)
    inner = hit & ((normal * rays.direction_lab).sum(-1) < -0.6)
    body = normal @ R
    flat = (body[..., 2].abs() < 0.9) & inner  # beyond, the map is continued over the pole
    light = 0.5 + lambert(normal, a_ball(texture).lamps_lab)
    expected = (20.0 + 150.0 * sample_texture(texture, body)) * light
    got = expected_grey(rays, place, R, a_ball(texture))
    assert int(flat.sum()) > 300
    assert_close(got[flat], expected[flat], 0.1)  # grey levels; the rim's rounding reaches in by so much


def test_the_picture_is_the_synthetic_movies_one():
    settings = SynthSettings(diameter_px=60.0, image_size=(75, 75), blur_px=0.8)
    texture = random_texture("blobs", 3, 48)
    camera = replace(sight(75)[0], f_px=f64(1000.0))
    v, u = torch.meshgrid(torch.arange(75), torch.arange(75), indexing="ij")
    rays = camera.rays(torch.stack([u, v], dim=-1).reshape(-1, 2).double())
    R, place = so3.exp(f64([0.4, -0.8, 0.5])), f64([0.5, 3.0, -0.4])
    lamps = f64(LAMPS)
    unit = lamps[:, :3] / lamps[:, :3].norm(dim=-1, keepdim=True)
    ball = replace(a_ball(texture.double(), 0.25), lamps_lab=unit * lamps[:, 3:] * (0.5 / 0.75))
    got = expected_grey(rays, place, R, ball).reshape(75, 75)
    expected, cover = expose(make_scene(texture, settings), camera, place[None], R[None])
    miss = got - torch.from_numpy(expected)
    full = torch.from_numpy(cover) > 0.99
    assert miss.square().mean().sqrt() < 4.0  # of 150 grey levels from black to white
    assert miss[full].mean().abs() < 0.5
    # East for west, or a turn by the inverse, is another picture.
    for other in (
        expected_grey(rays, place, R.mT, ball),
        expected_grey(rays, place, R, replace(ball, texture=ball.texture.flip(1))),
    ):
        assert (other.reshape(75, 75) - torch.from_numpy(expected)).square().mean().sqrt() > 20.0


def test_coverage_is_the_gaussian_share_of_a_straight_edge():
    _, rays = sight()
    place = f64([0.0, 0.0, 0.0])
    _, coverage = soft_normals(rays, place, 9.0, 0.4)
    off = torch.linalg.cross(place - rays.origin_lab_mm, rays.direction_lab).norm(dim=-1)  # of the line of sight
    near = (off - 9.0).abs() < 1.0
    assert int(near.sum()) > 40
    assert_close(coverage[near], torch.special.ndtr((9.0 - off) / 0.4)[near], 0.02)
    assert coverage[off < 7].min() > 0.999
    assert coverage[off > 11].max() < 0.001


def test_the_picture_is_smooth_to_the_second_order_limb_included(rng):
    texture = torch.rand(4, 8, generator=rng, dtype=torch.float64)
    _, rays = sight(7)
    R = so3.exp(f64([0.4, -0.8, 0.5]))

    def picture(delta: Tensor, texture: Tensor) -> Tensor:
        turned, place = moved(R, f64([0.3, 0.1, -0.2]), delta)
        return expected_grey(rays, place, turned, a_ball(texture, 0.8))

    still = torch.zeros(6, dtype=torch.float64).requires_grad_()
    texture.requires_grad_()
    assert torch.autograd.gradcheck(picture, (still, texture), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda delta: picture(delta, texture.detach())[::5], (still,), rtol=1e-2)


def test_any_leading_shape_and_both_types(rng, dtype):
    texture = torch.rand(4, 8, generator=rng, dtype=torch.float64)
    _, rays = sight(5)
    R, place = (
        so3.random_rotations((2, 3), generator=rng).double(),
        torch.randn(2, 3, 3, generator=rng, dtype=torch.float64),
    )
    whole = expected_grey(rays, place, R, a_ball(texture))
    assert whole.shape == (2, 3, 25)
    assert_close(expected_grey(rays, place[1, 2], R[1, 2], a_ball(texture)), whole[1, 2])
    looked = sample_spline(texture.to(dtype), place.to(dtype))
    assert looked.dtype == dtype
    assert_close(looked.double(), sample_spline(texture, place), {torch.float32: 1e-5, torch.float64: 0.0}[dtype])
    with pytest.raises(ShapeError, match="position_lab_mm"):
        expected_grey(rays, place[..., :2], R, a_ball(texture))


def test_a_positive_part_has_a_round_corner_and_is_never_0(dtype):
    x = torch.tensor([-1e4, -1.0, 0.0, 1.0, 1e4], dtype=dtype)
    got = smooth_positive(x, 0.02)
    assert (got > 0).all()
    assert_close(
        got, torch.tensor([0.0, 1e-4, 0.01, 1.0001, 1e4], dtype=dtype), 2e-8 if dtype == torch.float64 else 1e-3
    )


# --- the spline's map


def test_a_lone_texel_is_the_cubic_b_spline():
    texture = torch.zeros(8, 16, dtype=torch.float64)
    texture[3, 5] = 1.0
    middle = map_directions(8)
    assert_close(sample_spline(texture, middle[3, 5]), f64(4 / 9))  # 2/3 along the row, 2/3 along the column
    assert_close(sample_spline(texture, middle[3, 6]), f64(2 / 3 * 1 / 6))
    assert_close(sample_spline(texture, middle[4, 6]), f64(1 / 36))
    assert_close(sample_spline(texture, middle[3, 7]), f64(0.0))


def test_the_spline_agrees_with_the_bilinear_map_where_it_is_smooth(rng):
    directions = torch.randn(2000, 3, generator=rng, dtype=torch.float64)
    body = map_directions(256)
    texture = 0.5 + 0.3 * body[..., 0] - 0.2 * body[..., 1] * body[..., 2]
    assert_close(sample_spline(texture, directions), sample_texture(texture, directions), 2e-4)


def test_date_line_and_poles_are_no_edges(rng):
    texture = torch.rand(8, 16, generator=rng, dtype=torch.float64)
    for latitude in (-80, -20, 0, 50, 85):
        lat, lon = math.radians(latitude), math.pi
        sides = f64([[math.cos(lat) * math.cos(lon), s * 1e-9, math.sin(lat)] for s in (1, -1)])
        first, second = sample_spline(texture, sides)
        assert_close(first, second, 1e-7)
    over = f64([[1e-9, 1e-9, 1.0], [-1e-9, -1e-9, 1.0]])  # along one meridian over the pole
    assert_close(*sample_spline(texture, over), 1e-7)
    with pytest.raises(ShapeError, match="texture"):
        sample_spline(texture[:, :8], over)
