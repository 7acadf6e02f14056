"""Corrected and printed forms side by side: docs/errata.md E1, E2, E3, E9."""

import math

import pytest
import torch
from conftest import TOLERANCE, assert_close
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sphereorient import so3

F64 = torch.float64
HALF = math.pi / 2


def triplets(rng, n=300, dtype=F64):
    span = torch.tensor([2 * math.pi, math.pi, 2 * math.pi], dtype=dtype)
    return (torch.rand(n, 3, generator=rng, dtype=dtype) - 0.5) * span


def about(axis, turn):
    """The rotation about a coordinate axis, written out."""
    c, s = math.cos(turn), math.sin(turn)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    return torch.tensor(rows.get(axis, [[c, -s, 0], [s, c, 0], [0, 0, 1]]), dtype=F64)


def printed_extraction(R):
    return torch.stack(
        [torch.atan2(-R[..., 0, 1], R[..., 0, 0]), R[..., 0, 2].asin(), torch.atan2(-R[..., 1, 2], R[..., 2, 2])], -1
    )


def printed_second_triplet(theta):
    x, y, z = theta.unbind(-1)
    return torch.stack([x + math.pi, y.sign() * math.pi - y, z + math.pi], -1)


def test_the_matrix_is_Rx_Ry_Rz_as_the_paper_prints_it():
    x, y, z = theta = (0.3, -0.7, 2.1)
    expected = about("x", x) @ about("y", y) @ about("z", z)
    assert_close(so3.from_tait_bryan(torch.tensor(theta, dtype=F64)), expected, atol=1e-15)


def test_the_matrix_agrees_with_scipy(rng, dtype, tolerance):
    theta = triplets(rng, dtype=dtype)
    expected = Rotation.from_euler("XYZ", theta.double().numpy()).as_matrix()
    assert_close(so3.from_tait_bryan(theta).double(), torch.from_numpy(expected), atol=tolerance)


def test_E9_the_order_in_words_is_fixed_z_then_fixed_y_then_fixed_x(rng):
    theta = triplets(rng)
    R, zyx = so3.from_tait_bryan(theta), theta.flip(-1).numpy()
    assert_close(R, torch.from_numpy(Rotation.from_euler("zyx", zyx).as_matrix()))  # small letters: fixed axes
    # as printed: first z, then the intermediate y, last the new x; capitals: the body's own axes
    words = torch.from_numpy(Rotation.from_euler("ZYX", zyx).as_matrix())
    assert so3.geodesic_distance(R, words).median() > 0.5
    x, y, z = theta[0].tolist()
    assert_close(words[0], about("z", z) @ about("y", y) @ about("x", x))


def test_E9_by_hand_quarter_turns_about_z_and_x_take_body_x_to_lab_z():
    R = so3.from_tait_bryan(torch.tensor([HALF, 0.0, HALF], dtype=F64))
    # about the fixed z: x goes to y; then about the fixed x: y goes to z
    assert_close(R[:, 0], torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    words = about("z", HALF) @ about("x", HALF)
    assert_close(words[:, 0], torch.tensor([0.0, 1.0, 0.0], dtype=F64))


def test_E1_extraction_gives_the_angles_back_and_the_printed_one_exchanges_two(rng, dtype):
    theta = triplets(rng, dtype=dtype)
    theta = theta[(theta[:, 1].abs() < 1.4)]
    R = so3.from_tait_bryan(theta)
    assert_close(so3.to_tait_bryan(R), theta, atol=20 * TOLERANCE[dtype])  # 1/cos(1.4) = 6 roundings
    printed = printed_extraction(R)
    assert (printed - theta).abs().amax(-1).median() > 0.5
    assert_close(printed.flip(-1), theta, atol=40 * TOLERANCE[dtype])
    assert so3.geodesic_distance(so3.from_tait_bryan(printed), R).median() > 0.5


def test_E1_extraction_is_the_corrected_formula(rng):
    R = so3.random_rotations(300, generator=rng)
    assert_close(so3.to_tait_bryan(R), printed_extraction(R).flip(-1), atol=1e-11)


@pytest.mark.parametrize("y", [HALF, -HALF])
def test_E1_at_the_singularity_theta_z_is_0_and_the_rotation_is_kept(dtype, tolerance, y):
    R = so3.from_tait_bryan(torch.tensor([0.4, y, 0.9], dtype=dtype))
    x = 0.4 + math.copysign(0.9, y)  # only the sum, or at -pi/2 the difference, is defined
    found = so3.to_tait_bryan(R)
    assert_close(found, torch.tensor([x, y, 0.0], dtype=dtype), atol=tolerance)
    assert found[2] == 0
    s, c = math.sin(x), math.cos(x)
    if y > 0:
        exact = torch.tensor([[0, 0, 1], [s, c, 0], [-c, s, 0]], dtype=dtype)
        assert_close(so3.to_tait_bryan(exact), torch.tensor([x, y, 0.0], dtype=dtype), atol=tolerance)


@pytest.mark.parametrize("gap", [0.0, 1e-17, 1e-15, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3])
def test_E1_extraction_keeps_the_rotation_however_near_the_singularity(rng, dtype, gap):
    theta = triplets(rng, dtype=dtype)
    theta[:, 1] = (HALF - gap) * theta[:, 1].sign()
    R = so3.from_tait_bryan(theta)
    found = so3.to_tait_bryan(R)
    assert_close(so3.from_tait_bryan(found), R, atol=2 * TOLERANCE[dtype])
    leaf = R.clone().requires_grad_()
    so3.to_tait_bryan(leaf).sum().backward()
    assert leaf.grad.isfinite().all()


@settings(derandomize=True, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_any_angles_survive_as_a_rotation(v):
    R = so3.from_tait_bryan(torch.tensor(v, dtype=F64))
    found = so3.to_tait_bryan(R)
    assert found[1].abs() <= HALF
    assert_close(so3.from_tait_bryan(found), R, atol=1e-14)


def test_E2_the_second_triplet_is_the_same_rotation(rng, dtype, tolerance):
    theta = triplets(rng, dtype=dtype)
    second = so3.second_triplet(theta)
    assert_close(so3.from_tait_bryan(second), so3.from_tait_bryan(theta), atol=2 * tolerance)
    assert (second[:, 1].abs() >= HALF).all()
    twice = so3.second_triplet(second) - theta
    assert_close(twice, torch.tensor([2 * math.pi, 0.0, 2 * math.pi], dtype=dtype).expand_as(twice), atol=5 * tolerance)


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_E2_the_second_triplet_holds_at_theta_y_0_where_the_printed_one_fails(zero):
    theta = torch.tensor([0.4, zero, -1.1], dtype=F64)
    R = so3.from_tait_bryan(theta)
    assert_close(so3.second_triplet(theta), torch.tensor([0.4 + math.pi, math.pi, math.pi - 1.1], dtype=F64))
    assert so3.geodesic_distance(so3.from_tait_bryan(so3.second_triplet(theta)), R) < 1e-14
    assert so3.geodesic_distance(so3.from_tait_bryan(printed_second_triplet(theta)), R) > 1
    elsewhere = torch.tensor([0.4, -0.3, -1.1], dtype=F64)
    assert_close(printed_second_triplet(elsewhere), so3.second_triplet(elsewhere))


def test_E3_H_gives_omega_in_the_lab_and_its_twin_in_the_body(rng):
    theta, rate = triplets(rng), torch.randn(300, 3, generator=rng, dtype=F64)
    h = 1e-6
    R = so3.from_tait_bryan(theta)
    dR_dt = (so3.from_tait_bryan(theta + h * rate) - so3.from_tait_bryan(theta - h * rate)) / (2 * h)
    omega_lab, omega_body = so3.vee(dR_dt @ R.mT), so3.vee(R.mT @ dR_dt)
    H = so3.rate_matrix_lab(theta)
    assert_close((H @ rate[..., None])[..., 0], omega_lab, atol=1e-8)
    assert_close((so3.rate_matrix_body(theta) @ rate[..., None])[..., 0], omega_body, atol=1e-8)
    printed_body = (H @ rate[..., None])[..., 0]  # the paper takes H dtheta/dt for the body's
    assert (printed_body - omega_body).norm(dim=-1).median() > 0.5


def test_E3_both_rate_matrices_differ_by_R_and_have_determinant_cos_theta_y(rng, dtype, tolerance):
    theta = triplets(rng, dtype=dtype)
    H_lab, H_body = so3.rate_matrix_lab(theta), so3.rate_matrix_body(theta)
    assert_close(so3.from_tait_bryan(theta) @ H_body, H_lab, atol=tolerance)
    for H in (H_lab, H_body):
        assert_close(torch.linalg.det(H), theta[:, 1].cos(), atol=tolerance)


def test_E3_a_turn_about_theta_z_is_about_the_bodys_z():
    theta = torch.tensor([0.4, 0.6, -1.1], dtype=F64)
    assert_close(so3.rate_matrix_body(theta)[:, 2], torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    assert_close(so3.rate_matrix_lab(theta)[:, 0], torch.tensor([1.0, 0.0, 0.0], dtype=F64))


@pytest.mark.parametrize(
    "function", [so3.from_tait_bryan, so3.second_triplet, so3.rate_matrix_lab, so3.rate_matrix_body]
)
def test_gradients_of_the_angles_agree_with_differences(rng, function):
    assert torch.autograd.gradcheck(function, triplets(rng, 4).requires_grad_())


def test_gradient_of_the_extraction_agrees_with_differences(rng):
    theta = triplets(rng, 4).requires_grad_()
    assert torch.autograd.gradcheck(so3.to_tait_bryan, so3.from_tait_bryan(theta).detach().requires_grad_())
    assert torch.autograd.gradcheck(lambda t: so3.to_tait_bryan(so3.from_tait_bryan(t)), theta)


def test_no_rotation_has_no_angles(dtype):
    R = torch.eye(3, dtype=dtype).repeat(2, 1, 1)
    R[1] = torch.nan
    theta = so3.to_tait_bryan(R)
    assert torch.isfinite(theta[0]).all()
    assert torch.isnan(theta[1]).all()
