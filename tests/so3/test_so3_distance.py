import math

import pytest
import torch
from conftest import assert_close
from scipy.spatial.transform import Rotation

from sphereorient import so3

F64 = torch.float64
TINY = [1e-6, 1e-5, 1e-4, 1e-3]
FULL = [0.0, *TINY, 0.1, 1.0, 2.0, 3.0, math.pi - 1e-3, math.pi - 1e-6, math.pi]
SINGULAR = [0.0, 1e-9, math.pi - 1e-6, math.pi]


def printed_angle(R):
    """acos((Tr - 1)/2) of the paper."""
    return ((R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()


def turns(rng, phi, n=200):
    axis = torch.randn(n, 3, generator=rng, dtype=F64)
    return so3.exp(axis / axis.norm(dim=-1, keepdim=True) * phi)


@pytest.mark.parametrize("phi", FULL)
def test_angle_and_distance_are_right_from_0_to_pi(rng, dtype, phi):
    A, turn = so3.random_rotations(200, generator=rng), turns(rng, phi)
    expected = torch.full((200,), phi, dtype=F64)
    atol = 1e-6 if dtype == torch.float32 else 2e-15
    assert_close(so3.angle(turn.to(dtype)).double(), expected, atol=atol)
    assert_close(so3.geodesic_distance(A.to(dtype), (A @ turn).to(dtype)).double(), expected, atol=atol)


@pytest.mark.parametrize("phi", TINY)
def test_the_printed_arccos_loses_small_angles_in_float32(rng, phi):
    R = turns(rng, phi).float()
    assert (so3.angle(R) - phi).abs().max() < 1e-6 * phi  # all digits
    A = so3.random_rotations(200, generator=rng)
    B = (A @ R.double()).float()
    assert (so3.geodesic_distance(A.float(), B) - phi).abs().max() < 4e-7  # left by the rounding of A and B
    assert (printed_angle(A.float().mT @ B) - phi).abs().max() > 0.1 * phi


def test_distance_agrees_with_scipy(rng):
    A, B = so3.random_rotations((2, 300), generator=rng)
    expected = (Rotation.from_matrix(A.numpy()).inv() * Rotation.from_matrix(B.numpy())).magnitude()
    assert_close(so3.geodesic_distance(A, B), torch.from_numpy(expected), atol=1e-14)
    assert_close(so3.geodesic_distance(A, B), printed_angle(A.mT @ B), atol=1e-7)  # the paper's, where it is good


def test_the_trace_identity_of_the_paper_holds(rng):
    A, B = so3.random_rotations((2, 300), generator=rng)
    trace = ((A - B) @ (A - B).mT).diagonal(dim1=-2, dim2=-1).sum(-1)
    assert_close(trace, 4 * (1 - so3.geodesic_distance(A, B).cos()))


def test_distance_is_a_metric_that_does_not_depend_on_the_frames(rng, dtype):
    A, B, C, Q = so3.random_rotations((4, 300), generator=rng, dtype=dtype)
    d, atol = so3.geodesic_distance, 2e-6 if dtype == torch.float32 else 1e-14
    assert_close(d(Q @ A, Q @ B), d(A, B), atol=atol)
    assert_close(d(A @ Q, B @ Q), d(A, B), atol=atol)
    assert_close(d(B, A), d(A, B), atol=atol)
    assert_close(so3.angle(A.mT @ B), d(A, B), atol=atol)
    assert (d(A, C) <= d(A, B) + d(B, C) + atol).all()
    assert torch.equal(d(A, A), torch.zeros(300, dtype=dtype))


def test_distances_of_all_pairs_come_by_broadcasting(rng):
    A, B = so3.random_rotations(4, generator=rng), so3.random_rotations(5, generator=rng)
    pairs = so3.geodesic_distance(A[:, None], B[None])
    assert pairs.shape == (4, 5)
    assert torch.equal(pairs[2, 3], so3.geodesic_distance(A[2], B[3]))


def test_gradients_agree_with_differences(rng):
    A, B = so3.random_rotations((2, 5), generator=rng).requires_grad_().unbind()
    assert torch.autograd.gradcheck(so3.angle, A)
    assert torch.autograd.gradcheck(so3.geodesic_distance, (A, B))


@pytest.mark.parametrize("phi", SINGULAR)
def test_gradients_are_finite_at_0_and_pi(rng, dtype, phi):
    A = so3.random_rotations(200, generator=rng, dtype=dtype)
    R = turns(rng, phi).to(dtype).requires_grad_()
    (so3.angle(R) + so3.geodesic_distance(A, A @ R)).sum().backward()
    assert R.grad.isfinite().all()


def test_the_gradient_is_0_exactly_at_0_and_pi(dtype):
    R = torch.stack([torch.eye(3, dtype=dtype), torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=dtype))])
    slope = torch.autograd.functional.jacobian(lambda R: so3.geodesic_distance(R, R.detach()).sum(), R)
    assert torch.equal(slope, torch.zeros_like(R))
    # along a motion: the trace moves only to second order, so what is left is the sine's part, which is 0
    along = [lambda v: so3.angle(so3.exp(v) @ R[0]), lambda v: so3.angle(so3.exp(v) @ R[1])]
    for motion in along:
        slope = torch.autograd.functional.jacobian(motion, torch.zeros(3, dtype=dtype))
        assert torch.equal(slope, torch.zeros(3, dtype=dtype))
    printed = torch.autograd.functional.jacobian(printed_angle, R[0])
    assert not printed.isfinite().all()


@pytest.mark.parametrize("phi", [1e-9, 1e-3, 1.0, 3.0, math.pi - 1e-6])
def test_turning_on_about_the_axis_raises_the_angle_one_to_one(phi):
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=F64)
    slope = torch.autograd.functional.jacobian(lambda t: so3.angle(so3.exp(axis * t)), torch.tensor(phi, dtype=F64))
    assert abs(float(slope) - 1) < 1e-8
