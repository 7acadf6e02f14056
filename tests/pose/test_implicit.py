"""The fit with derivatives: against finite differences of the fit run again, and against fits solved by hand."""

import pytest
import torch
from conftest import assert_close
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError, ShapeError
from sphereorient.pose.implicit import ImplicitPose, implicit_pose, moved_by


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


def test_frames_without_anything_are_nan_and_their_gradients_0(points):
    body, seen = points.clone(), points.clone()
    seen[1] = 0.0  # values there do not matter
    seen.requires_grad_()
    use = torch.tensor([True, False, True])
    got, whole = fitted_points(body, seen, use=use), fitted_points(body, seen)
    assert got.R_lab_body[1].isnan().all()
    assert got.position_lab_mm[1].isnan().all()
    assert got.arrived.tolist() == [True, False, True]
    (gradient,) = torch.autograd.grad(got.R_lab_body[use].sum() + got.cost.sum(), seen)
    assert_close(gradient[1], torch.zeros_like(gradient[1]))
    assert_close(got.R_lab_body[use], whole.R_lab_body[use])  # the others do not change
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


def test_an_undetermined_direction_stays_and_has_no_gradient(points):
    # One point: a rotation about it, and rotations against moves, leave the residual as it is.
    seen = (points[:, :1] + 0.1).requires_grad_()
    got = fitted_points(torch.zeros_like(points[:, :1]), seen)
    assert_close(got.position_lab_mm, seen.detach()[:, 0], 1e-9)
    assert_close(got.R_lab_body, so3.exp(f64([0.3, -0.2, 0.4])).expand(3, 3, 3), 1e-12)
    (gradient,) = torch.autograd.grad(got.R_lab_body.sum() + got.position_lab_mm.sum(), seen)
    assert_close(gradient, torch.ones_like(gradient), 1e-6)


def test_a_fit_that_has_not_converged_is_marked_and_gives_no_gradient(points):
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
    turned, place = moved_by(R, f64([[1.0, 2.0, 3.0]]), delta)
    assert_close(turned, so3.exp(delta[:, :3]) @ R, 1e-9)  # the third order: (2.3e-3)^3 / 12
    assert_close(place, f64([[1.1, 2.2, 3.3]]))
    assert (turned - R @ so3.exp(delta[:, :3])).abs().max() > 1e-4
    large = moved_by(R, f64([[0.0] * 3]), f64([[0.3, 0.9, -0.5, 0.0, 0.0, 0.0]]))[0]
    assert_close(large @ large.mT, torch.eye(3, dtype=torch.float64)[None])


def test_inconsistent_arguments_are_refused(points):
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
