"""Angular velocity: lab and body kept apart, the paper's printed frames beside the corrected ones."""

import math

import pytest
import torch
from conftest import assert_close
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError, ShapeError
from sphereorient.motion import omega_from_orientations, to_body
from sphereorient.motion.measure import omega_stencil, usable_separations
from sphereorient.motion.stencil import apply, gaussian_derivative

DT = 1 / 600
A = torch.tensor([3.0, -5.0, 9.0], dtype=torch.float64)  # rad/s
B = torch.tensor([-8.0, 4.0, 6.0], dtype=torch.float64)


def tumbling(frames: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return R(t) = exp(A t) exp(B t) with its exact omega_lab = A + exp(A t) B and alpha_lab = A x exp(A t) B."""
    t = DT * torch.arange(frames, dtype=torch.float64)[:, None]
    turned = (so3.exp(A * t) @ B[:, None])[..., 0]
    return so3.exp(A * t) @ so3.exp(B * t), A + turned, torch.linalg.cross(A.expand_as(turned), turned)


def spinning(omega_lab: list[float], R_start: Tensor, frames: int = 9) -> Tensor:
    t = DT * torch.arange(frames, dtype=torch.float64)[:, None]
    return so3.exp(torch.tensor(omega_lab, dtype=torch.float64) * t) @ R_start


def quarter_turn(axis: list[float]) -> Tensor:
    return so3.exp(torch.tensor(axis, dtype=torch.float64) * (math.pi / 2))


# convention


def test_omega_lab_of_a_rotation_about_lab_z_is_along_lab_z_at_any_orientation() -> None:
    R = spinning([0.0, 0.0, 12.0], quarter_turn([1.0, 0.0, 0.0]))  # body y along lab z
    omega_lab, _ = omega_from_orientations(R, DT, [1, 2])
    assert_close(omega_lab[4], torch.tensor([0.0, 0.0, 12.0], dtype=torch.float64), atol=1e-9)
    assert_close(to_body(R, omega_lab)[4], torch.tensor([0.0, 12.0, 0.0], dtype=torch.float64), atol=1e-9)
    wrong = (R[4] @ omega_lab[4, :, None])[:, 0]
    assert (wrong - torch.tensor([0.0, 12.0, 0.0], dtype=torch.float64)).norm() > 1


def test_e4_the_increment_is_written_in_lab_components() -> None:
    """Printed: R_{k+m} R_k^T is the change with respect to the particle. That is R_k^T R_{k+m}; n_lab = R_k n_body."""
    R, _, _ = tumbling(20)
    increment_lab, increment_body = so3.log(R[13] @ R[10].mT), so3.log(R[10].mT @ R[13])
    assert_close((R[10] @ increment_body[:, None])[:, 0], increment_lab, atol=1e-12)
    assert_close(increment_lab.norm(), increment_body.norm(), atol=1e-12)
    # the body-fixed change must not depend on the choice of the lab; the printed one does
    R_other_lab = quarter_turn([0.0, 1.0, 0.0])
    assert_close(so3.log((R_other_lab @ R[10]).mT @ R_other_lab @ R[13]), increment_body, atol=1e-12)
    printed = so3.log(R_other_lab @ R[13] @ (R_other_lab @ R[10]).mT)
    assert (printed - increment_lab).norm() > 0.5 * increment_lab.norm()


def test_e6_omega_from_the_increment_is_the_labs_and_needs_no_further_turning() -> None:
    """Printed: T gives omega_body and omega_lab = R omega_body. Corrected: T gives omega_lab, omega_body = R^T it."""
    R, omega_true, _ = tumbling(60)
    omega_lab, _ = omega_from_orientations(R, DT, [1])
    inside = slice(1, -1)
    printed_lab = (R @ omega_lab[..., None])[..., 0]
    assert (omega_lab - omega_true)[inside].norm(dim=-1).max() < 0.01
    assert (printed_lab - omega_true)[inside].norm(dim=-1).max() > 5
    body_true = so3.log(R[:-2].mT @ R[2:]) / (2 * DT)  # the change in body components, near its middle
    assert (to_body(R, omega_lab)[inside] - body_true).norm(dim=-1).max() < 0.5
    assert (omega_lab[inside] - body_true).norm(dim=-1).max() > 5


def test_e6_the_derivative_of_the_printed_lab_row_is_not_the_turned_alpha() -> None:
    R, omega_true, alpha_true = tumbling(60)
    inside = slice(10, -10)
    derived = gaussian_derivative((R @ omega_true[..., None])[..., 0], DT, 1.0, 1)[inside]
    assert (derived - (R @ alpha_true[..., None])[..., 0][inside]).norm(dim=-1).max() > 50
    body = gaussian_derivative(to_body(R, omega_true), DT, 1.0, 1)[inside]
    assert (body - to_body(R, alpha_true)[inside]).norm(dim=-1).max() < 1


# oracle


def test_omega_of_a_tumbling_body_agrees_with_its_formula_to_second_order_in_the_separation() -> None:
    R, omega_true, _ = tumbling(80)
    errors = []
    for m in (2, 4):
        omega, _ = omega_from_orientations(R, DT, [m])
        errors.append(float((omega - omega_true)[10:-10].norm(dim=-1).max()))
    assert errors[0] < 0.01
    assert errors[1] / errors[0] == pytest.approx(4.0, rel=0.05)


def test_a_growing_spin_about_one_axis_has_exact_omega_and_alpha() -> None:
    t = DT * torch.arange(30, dtype=torch.float64)[:, None]
    axis = torch.tensor([[2.0, -1.0, 2.0]], dtype=torch.float64) / 3
    R = so3.exp(axis * (0.5 * 400.0 * t**2 - 7.0 * t)) @ quarter_turn([0.6, 0.0, 0.8])
    omega, _ = omega_from_orientations(R, DT, [1, 2, 3])
    assert_close(omega[5:-5], (axis * (400.0 * t - 7.0))[5:-5], atol=1e-8)
    alpha = gaussian_derivative(omega, DT, 1.0, 1)
    assert_close(alpha[8:-8], (axis * 400.0).expand(14, 3), atol=1e-6)


def test_weights_m_squared_beat_equal_weights_and_single_separations(rng: torch.Generator) -> None:
    sigma, separations = 0.01, [1, 2, 3, 4]
    R = so3.exp(sigma * torch.randn(20_000, 3, generator=rng, dtype=torch.float64))
    spread = {}
    for m in (*((m,) for m in separations), tuple(separations)):
        omega, _ = omega_from_orientations(R, 1.0, m)
        spread[m] = float(omega[10:-10].std())
    expected = sigma / math.sqrt(2 * sum(m**2 for m in separations))
    assert spread[1, 2, 3, 4] == pytest.approx(expected, rel=0.02)
    assert spread[1, 2, 3, 4] < min(spread[m,] for m in separations)


def test_the_stencil_of_omega_is_its_linear_response(rng: torch.Generator) -> None:
    delta = 1e-5 * torch.randn(20, 3, generator=rng, dtype=torch.float64)
    there = torch.ones(20, dtype=torch.bool)
    there[8] = False
    delta[~there] = torch.nan
    separations = [1, 2, 4]
    R = torch.where(there[:, None, None], so3.exp(delta), torch.nan)
    omega, _ = omega_from_orientations(R, 1.0, separations, min_separations=2)
    weights = omega_stencil(usable_separations(there, separations, None), separations, 2, torch.float64)
    assert_close(apply(weights, delta), omega, atol=1e-9)


def test_the_standard_error_from_the_scatter_is_right_on_average(rng: torch.Generator) -> None:
    R = so3.exp(0.01 * torch.randn(20_000, 3, generator=rng, dtype=torch.float64))
    omega, error = omega_from_orientations(R, 1.0, [1, 2, 3, 4, 5])
    inside = slice(10, -10)
    assert float(error[inside].square().mean().sqrt()) == pytest.approx(float(omega[inside].std()), rel=0.03)


# property


def test_omega_lab_turns_with_the_lab_and_ignores_the_choice_of_body_axes() -> None:
    R, _, _ = tumbling(20)
    R_new_lab = R_body_new = quarter_turn([0.6, 0.8, 0.0])
    omega, _ = omega_from_orientations(R, DT, [1, 2])
    assert_close(omega_from_orientations(R @ R_body_new, DT, [1, 2])[0], omega, atol=1e-8)
    turned = (R_new_lab @ omega[..., None])[..., 0]
    assert_close(omega_from_orientations(R_new_lab @ R, DT, [1, 2])[0], turned, atol=1e-8)


def test_a_lost_frame_costs_its_neighbours_one_separation_only() -> None:
    R = spinning([1.0, 2.0, 3.0], torch.eye(3, dtype=torch.float64), frames=15)
    R[7] = torch.nan
    expected = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    omega, _ = omega_from_orientations(R, DT, [1, 2, 3], min_separations=2)
    assert omega.isnan().any(-1).nonzero().flatten().tolist() == [0, 1, 13, 14]
    assert_close(omega[2:13], expected.expand(11, 3), atol=1e-9)
    strict, _ = omega_from_orientations(R, DT, [1, 2, 3], min_separations=3)
    assert strict.isnan().any(-1).nonzero().flatten().tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14]


def test_a_jump_between_segments_is_no_turn() -> None:
    view = torch.eye(3, dtype=torch.float64)
    R = torch.cat([spinning([0.0, 0, 5], view, 6), spinning([0.0, 0, 5], quarter_turn([1.0, 0, 0]), 6)])
    omega, _ = omega_from_orientations(R, DT, [1, 2], segment=torch.tensor([0] * 6 + [1] * 6))
    assert omega.isnan().any(-1).nonzero().flatten().tolist() == [0, 5, 6, 11]
    seen = omega[omega.isfinite().all(-1)]
    assert_close(seen, torch.tensor([0.0, 0, 5], dtype=torch.float64).expand_as(seen), atol=1e-9)
    assert omega_from_orientations(R, DT, [1, 2])[0][5].norm() > 100
    outside, _ = omega_from_orientations(R, DT, [1], segment=torch.full((12,), -1))
    assert outside.isnan().all()


def test_a_batch_is_the_stack_of_its_singles(batch: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> None:
    R = so3.exp(0.1 * torch.randn(*batch, 9, 3, generator=rng, dtype=torch.float64)).to(dtype)
    omega, error = omega_from_orientations(R, 1.0, [1, 2])
    assert omega.shape == error.shape == (*batch, 9, 3)
    assert omega.dtype == error.dtype == dtype
    for one, R_one in zip(omega.reshape(-1, 9, 3), R.reshape(-1, 9, 3, 3), strict=True):
        assert_close(one, omega_from_orientations(R_one, 1.0, [1, 2])[0], atol=1e-6)


def test_gradients_are_finite_at_rest_and_beside_missing_frames() -> None:
    R = torch.eye(3, dtype=torch.float64).repeat(9, 1, 1)
    R[4] = torch.nan
    R.requires_grad_()
    omega, error = omega_from_orientations(R, DT, [1, 2])
    (omega[omega.isfinite()].sum() + error[error.isfinite()].sum()).backward()
    assert R.grad is not None
    assert R.grad.isfinite().all()
    assert R.grad.abs().max() > 0


@pytest.mark.parametrize("separations", [[], [0, 1], [1, 1]])
def test_impossible_separations_are_refused(separations: list[int]) -> None:
    with pytest.raises(SettingsError, match="separations: expected different numbers"):
        omega_from_orientations(torch.eye(3).repeat(5, 1, 1), DT, separations)


def test_a_single_rotation_is_refused() -> None:
    with pytest.raises(ShapeError, match="all frames at once"):
        omega_from_orientations(torch.eye(3), DT, [1])
    with pytest.raises(ShapeError, match="R_lab_body"):
        omega_from_orientations(torch.zeros(5, 3), DT, [1])
