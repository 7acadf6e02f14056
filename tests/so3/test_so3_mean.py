import math

import pytest
import torch
from conftest import TOLERANCE, assert_close
from scipy.spatial.transform import Rotation, Slerp

from sphereorient import so3

F64 = torch.float64


def cluster(rng, spread, shape=(100, 5), dtype=F64):
    """Rotations by at most `spread` from one each."""
    axis = torch.randn(*shape, 3, generator=rng, dtype=F64)
    v = axis / axis.norm(dim=-1, keepdim=True) * spread * torch.rand(*shape, 1, generator=rng, dtype=F64)
    return (so3.random_rotations((*shape[:-1], 1), generator=rng) @ so3.exp(v)).to(dtype)


@pytest.mark.parametrize("spread", [0.01, 0.5, 1.5])
def test_the_weighted_rotation_vectors_from_the_mean_cancel(rng, spread):
    R, weights = cluster(rng, spread), torch.rand(100, 5, generator=rng, dtype=F64)
    mean = so3.weighted_mean(R, weights)
    pull = (weights[..., None] * so3.log(mean[:, None].mT @ R)).sum(-2)
    assert_close(pull, torch.zeros(100, 3, dtype=F64), atol=1e-10)
    # the chordal mean, where it starts, is another rotation
    chordal = so3.nearest_rotation((weights[..., None, None] * R).sum(-3))
    assert so3.geodesic_distance(chordal, mean).max() > 1e-3 * spread**3


def test_it_has_the_smallest_weighted_sum_of_squared_angles(rng):
    R, weights = cluster(rng, 1.2), torch.rand(100, 5, generator=rng, dtype=F64)

    def cost(mean):
        return (weights * so3.geodesic_distance(mean[:, None], R).square()).sum(-1)

    mean = so3.weighted_mean(R, weights)
    for size in (1e-3, 0.1, 1.0):
        other = so3.exp(size * torch.randn(100, 3, generator=rng, dtype=F64)) @ mean
        assert (cost(mean) < cost(other)).all()


@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.02, 1.0, 3.0, math.pi - 1e-6])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.49, 0.5, 0.8, 1.0])
def test_two_rotations_give_the_point_of_their_geodesic(rng, dtype, turn, share):
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=F64)
    A = so3.random_rotations((), generator=rng)
    pair = torch.stack([A, A @ so3.exp(axis * turn)]).to(dtype)
    mean = so3.weighted_mean(pair, torch.tensor([1 - share, share], dtype=dtype))
    atol = 4 * TOLERANCE[dtype] / max(math.pi - turn, 1e-6 if dtype == F64 else 1)
    if dtype == F64 or turn < 3.1:  # float32 does not hold pi - 1e-6, so nor which way is shorter
        assert_close(mean, (A @ so3.exp(axis * turn * share)).to(dtype), atol=atol)


def test_two_rotations_agree_with_scipys_slerp(rng):
    pair = so3.random_rotations(2, generator=rng)
    share = torch.linspace(0, 1, 11, dtype=F64)
    expected = Slerp([0, 1], Rotation.from_matrix(pair.numpy()))(share.numpy()).as_matrix()
    assert_close(so3.weighted_mean(pair, torch.stack([1 - share, share], -1)), torch.from_numpy(expected), atol=1e-11)


def test_many_rotations_agree_with_scipys_chordal_mean_when_they_are_close(rng):
    R = cluster(rng, 1e-3, (50,))
    weights = torch.rand(50, generator=rng, dtype=F64)
    expected = Rotation.from_matrix(R.numpy()).mean(weights.numpy()).as_matrix()
    assert_close(so3.weighted_mean(R, weights), torch.from_numpy(expected), atol=1e-9)  # they differ by the cube


def test_the_mean_goes_with_the_frames_and_not_with_the_scale_of_weights_or_the_order(rng):
    R, weights = cluster(rng, 1.0), torch.rand(100, 5, generator=rng, dtype=F64)
    A, B = so3.random_rotations((2, 1), generator=rng)
    mean = so3.weighted_mean(R, weights)
    assert_close(so3.weighted_mean(A @ R @ B, weights), A @ mean @ B, atol=1e-11)
    assert_close(so3.weighted_mean(R, 1e4 * weights), mean, atol=1e-11)
    assert_close(so3.weighted_mean(R.flip(1), weights.flip(1)), mean, atol=1e-11)


def test_one_rotation_and_equal_rotations_are_their_own_mean(rng, dtype, tolerance):
    R = so3.random_rotations((10, 1), generator=rng, dtype=dtype)
    assert_close(so3.weighted_mean(R, torch.full((1,), 0.3, dtype=dtype)), R[:, 0], atol=tolerance)
    assert_close(so3.weighted_mean(R.expand(-1, 4, -1, -1), torch.ones(4, dtype=dtype)), R[:, 0], atol=tolerance)


def test_opposite_rotations_give_a_rotation_on_one_of_the_two_half_circles():
    pair = torch.stack([torch.eye(3, dtype=F64), torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=F64))])
    for weights in ([0.5, 0.5], [0.7, 0.3], [0.3, 0.7]):
        mean = so3.weighted_mean(pair, torch.tensor(weights, dtype=F64))
        expected = math.pi * torch.tensor([weights[1], weights[0]], dtype=F64)
        assert_close(so3.geodesic_distance(mean, pair), expected)
        assert torch.equal(mean, so3.weighted_mean(pair, torch.tensor(weights, dtype=F64)))


def test_a_rotation_without_weight_does_not_count_even_where_it_is_nan(rng):
    R = cluster(rng, 1.0, (3,))
    holed = torch.cat([R[:2], torch.full((1, 3, 3), math.nan, dtype=F64)])
    weights = torch.tensor([0.4, 0.6, 0.0], dtype=F64)
    expected = so3.weighted_mean(R[:2], weights[:2])
    assert_close(so3.weighted_mean(R, weights), expected)
    assert_close(so3.weighted_mean(holed, weights), expected)
    assert so3.weighted_mean(holed, torch.ones(3)).isnan().all()
    assert so3.weighted_mean(R, torch.zeros(3)).isnan().all()


@pytest.mark.slow
def test_gradients_agree_with_differences(rng):
    rotvec = (0.8 * torch.randn(2, 3, 3, generator=rng, dtype=F64)).requires_grad_()
    weights = (0.1 + torch.rand(2, 3, generator=rng, dtype=F64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda v, w: so3.weighted_mean(so3.exp(v), w), (rotvec, weights))


@pytest.mark.parametrize("turn", [0.0, 1e-9, math.pi - 1e-6, math.pi])
def test_gradients_are_finite_for_equal_and_for_opposite_rotations(dtype, turn):
    v = torch.tensor([[0.1, 0.0, 0.0], [0.1 + turn, 0.0, 0.0]], dtype=dtype).requires_grad_()
    weights = torch.tensor([0.4, 0.6], dtype=dtype).requires_grad_()
    so3.weighted_mean(so3.exp(v), weights).sum().backward()
    assert v.grad.isfinite().all()
    assert weights.grad.isfinite().all()
