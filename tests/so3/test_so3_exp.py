import math

import pytest
import torch
from conftest import TOLERANCE, assert_close
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sphereorient import so3

F64 = torch.float64
SINGULAR = [0.0, 1e-9, 1e-4, 9.99e-4, 1.001e-3, math.pi - 1e-6, math.pi - 1e-9, math.pi]


def directions(rng, n=50):
    axis = torch.randn(n, 3, generator=rng, dtype=F64)
    axis = torch.cat([axis, torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)])
    return axis / axis.norm(dim=-1, keepdim=True)


def test_exp_agrees_with_scipy(rng, dtype, tolerance):
    rotvec = 3 * torch.randn(500, 3, generator=rng, dtype=dtype)
    expected = Rotation.from_rotvec(rotvec.double().numpy()).as_matrix()
    assert_close(so3.exp(rotvec), torch.from_numpy(expected).to(dtype), atol=tolerance)


def test_log_agrees_with_scipy(rng, dtype):
    R = so3.random_rotations(500, generator=rng, dtype=dtype)
    expected = Rotation.from_matrix(R.double().numpy()).as_rotvec()
    # beside the half turn the sign of the axis hangs on the last bits; none of these 500 is that close
    assert_close(so3.log(R).double(), torch.from_numpy(expected), atol=4 * TOLERANCE[dtype])


@pytest.mark.parametrize("turn", SINGULAR)
def test_exp_and_log_keep_all_digits_at_0_and_pi(rng, dtype, tolerance, turn):
    rotvec = (directions(rng) * turn).to(dtype)
    expected = torch.linalg.matrix_exp(so3.hat(rotvec.double()))
    assert_close(so3.exp(rotvec).double(), expected, atol=tolerance)
    back = so3.log(expected.to(dtype))
    assert back.norm(dim=-1).max() <= math.pi + tolerance
    assert_close(torch.linalg.matrix_exp(so3.hat(back.double())), expected, atol=tolerance)
    if turn < 3:  # at pi either sign of the axis is right
        assert_close(back, rotvec, atol=tolerance)
    if 0 < turn < 1:  # relative, not only absolute: a rotation of 1e-9 is not lost
        assert ((back - rotvec).norm(dim=-1) / turn).max() < tolerance


@settings(derandomize=True, deadline=None)
@given(st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3))
def test_log_undoes_exp_below_pi(v):
    rotvec = torch.tensor(v, dtype=F64)  # at most 1.8 sqrt(3) = 3.118 long
    assert_close(so3.log(so3.exp(rotvec)), rotvec, atol=1e-12)


def test_log_takes_the_shorter_way_round():
    rotvec = torch.tensor([0.0, 0.0, 4.0], dtype=F64)
    assert_close(so3.log(so3.exp(rotvec)), torch.tensor([0.0, 0.0, 4.0 - 2 * math.pi], dtype=F64), atol=1e-12)


def test_a_quarter_turn_about_z_takes_x_to_y():
    R = so3.exp(torch.tensor([0.0, 0.0, math.pi / 2], dtype=F64))
    x, y = torch.eye(3, dtype=F64)[:2]
    assert_close(R @ x, y, atol=1e-15)
    assert not torch.allclose(R.mT @ x, y)  # the other hand


def test_hat_is_the_cross_product_and_vee_its_inverse(rng, dtype):
    v, x = torch.randn(2, 20, 3, generator=rng, dtype=dtype)
    assert_close((so3.hat(v) @ x[..., None])[..., 0], torch.linalg.cross(v, x), atol=10 * TOLERANCE[dtype])
    assert torch.equal(so3.vee(so3.hat(v)), v)
    by_hand = torch.tensor([[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]])
    assert torch.equal(so3.hat(torch.tensor([1.0, 2.0, 3.0])), by_hand)


def test_vee_of_a_rotation_is_axis_times_sine(rng):
    axis = directions(rng)
    assert_close(so3.vee(so3.exp(axis * 2.5)), axis * math.sin(2.5))


def test_gradients_of_exp_and_log_agree_with_differences(rng):
    rotvec = torch.randn(4, 3, generator=rng, dtype=F64).requires_grad_()
    assert torch.autograd.gradcheck(so3.exp, rotvec)
    assert torch.autograd.gradcheck(so3.log, so3.exp(rotvec.detach()).requires_grad_())
    # the last rotates by 2.9 rad, where the quaternion's largest component is not w
    far = (directions(rng, 5) * 2.9).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: so3.log(so3.exp(v)), far)


@pytest.mark.parametrize("turn", SINGULAR)
def test_gradients_of_exp_and_log_are_finite_at_0_and_pi(rng, dtype, turn):
    rotvec = (directions(rng) * turn).to(dtype).requires_grad_()
    R = so3.exp(rotvec)
    (R * torch.randn(R.shape, generator=rng, dtype=dtype)).sum().backward()
    assert rotvec.grad.isfinite().all()
    leaf = R.detach().requires_grad_()
    so3.log(leaf).sum().backward()
    assert leaf.grad.isfinite().all()


def test_the_derivative_of_exp_at_0_is_hat():
    jacobian = torch.autograd.functional.jacobian(so3.exp, torch.zeros(3, dtype=F64))
    assert_close(jacobian.movedim(-1, 0), so3.hat(torch.eye(3, dtype=F64)))


def test_unmeasured_values_stay_nan_and_change_no_others():
    rotvec = torch.tensor([[0.1, 0.2, 0.3], [math.nan] * 3])
    R = so3.exp(rotvec)
    assert R[1].isnan().all()
    assert so3.log(R)[1].isnan().all()
    assert_close(so3.log(R)[0], rotvec[0], atol=1e-6)


@pytest.mark.skipif(so3.compiled(so3.SOURCE, so3._Rotations) is None, reason="needs compiled code: `make setup`")
def test_compiled_code_gives_what_torch_gives(rng, monkeypatch):
    turns = torch.tensor([0.0, 1e-300, 1e-160, 1e-78, 1e-12, 1e-4, 1.0, 3.0, math.pi - 1e-9, math.pi, 7.0], dtype=F64)
    rotvec = torch.cat([*(directions(rng) * turn for turn in turns), torch.full((1, 3), math.nan, dtype=F64)])
    rotvec = rotvec.reshape(-1, 3)
    R = torch.cat([so3.exp(rotvec), so3.random_rotations(500, generator=rng), -torch.ones(1, 3, 3, dtype=F64)])
    strided = R.mT.contiguous().mT
    found = so3.exp(rotvec), so3.log(R), so3.log(strided.reshape(1, -1, 3, 3))[0]
    monkeypatch.setattr(so3, "compiled", lambda *_: None)
    assert_close(found[0], so3.exp(rotvec), 1e-15)
    assert_close(found[1], so3.log(R), 1e-15)
    assert torch.equal(found[1].nan_to_num(9.0), found[2].nan_to_num(9.0))


def test_derivatives_work_in_all_ways_of_torch(rng):
    rotvec = torch.randn(4, 3, generator=rng, dtype=F64)
    by_hand = torch.stack([torch.autograd.functional.jacobian(so3.exp, one) for one in rotvec])
    assert float(by_hand.abs().amax()) > 0.1
    assert_close(torch.func.vmap(torch.func.jacfwd(so3.exp))(rotvec), by_hand)
    assert_close(torch.func.vmap(torch.func.jacrev(so3.exp))(rotvec), by_hand)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(rotvec, torch.ones_like(rotvec))
        along = torch.autograd.forward_ad.unpack_dual(so3.log(so3.exp(dual))).tangent
    inside = rotvec.norm(dim=-1) < 3
    assert_close(along[inside], torch.ones_like(rotvec)[inside], 1e-9)
