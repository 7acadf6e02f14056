import math

import pytest
import torch
from conftest import assert_close
from scipy.spatial.transform import Rotation

from sphereorient import so3

F64 = torch.float64


def test_a_rotation_is_its_own_nearest(rng, dtype, tolerance):
    R = so3.random_rotations(200, generator=rng, dtype=dtype)
    assert_close(so3.nearest_rotation(R), R, atol=tolerance)
    assert_close(so3.nearest_rotation(7 * R), R, atol=tolerance)


def test_any_matrix_gives_a_rotation_also_one_that_reflects(rng, dtype, tolerance):
    M = torch.randn(200, 3, 3, generator=rng, dtype=dtype)
    assert (torch.linalg.det(M) < 0).any()
    R = so3.nearest_rotation(M)
    assert_close(R @ R.mT, torch.eye(3, dtype=dtype).expand_as(R), atol=2 * tolerance)
    assert_close(torch.linalg.det(R), torch.ones(200, dtype=dtype), atol=2 * tolerance)


def test_no_other_rotation_is_nearer(rng):
    M = torch.randn(100, 3, 3, generator=rng, dtype=F64)
    R = so3.nearest_rotation(M)
    for size in (1e-3, 0.3, 3.0):
        other = so3.exp(size * torch.randn(50, 1, 3, generator=rng, dtype=F64)) @ R
        assert ((M - R).square().sum((-2, -1)) <= (M - other).square().sum((-2, -1)) + 1e-12).all()


def test_it_agrees_with_scipys_kabsch(rng):
    points, R_true = torch.randn(20, 3, generator=rng, dtype=F64), so3.random_rotations((), generator=rng)
    seen = points @ R_true.mT + 0.1 * torch.randn(20, 3, generator=rng, dtype=F64)
    expected = Rotation.align_vectors(seen.numpy(), points.numpy())[0].as_matrix()
    assert_close(so3.nearest_rotation(seen.mT @ points), torch.from_numpy(expected))


def test_gradients_agree_with_differences_also_at_a_rotation_where_the_svd_has_none(rng):
    M = torch.randn(6, 3, 3, generator=rng, dtype=F64)  # of either sign
    assert (torch.linalg.det(M) < 0).any()
    assert torch.autograd.gradcheck(so3.nearest_rotation, M.requires_grad_())
    R = torch.cat([torch.eye(3, dtype=F64)[None], so3.random_rotations(2, generator=rng)]).requires_grad_()
    assert torch.autograd.gradcheck(so3.nearest_rotation, R)
    U, _, Vh = torch.linalg.svd(R)
    assert not torch.autograd.grad((U @ Vh)[0, 0, 1], R)[0].isfinite().all()


@pytest.mark.parametrize(
    "diagonal", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, -1.0), (1.0, 1.0, 0.0), (2.0, 1.0, -1.0)]
)
def test_undecided_matrices_give_a_rotation_and_finite_gradients(dtype, tolerance, diagonal):
    M = torch.diag(torch.tensor(diagonal, dtype=dtype)).requires_grad_()
    R = so3.nearest_rotation(M)
    R.sum().backward()
    assert_close((R @ R.mT).detach(), torch.eye(3, dtype=dtype), atol=tolerance)
    assert torch.linalg.det(R) > 0
    assert M.grad.isfinite().all()


def test_unmeasured_values_stay_nan_and_change_no_others(rng):
    R = so3.random_rotations(3, generator=rng)
    M = R.clone()
    M[1, 0, 0], M[2, 2, 2] = math.nan, math.inf
    M.requires_grad_()
    found = so3.nearest_rotation(M)
    assert found[1:].isnan().all()
    assert_close(found[0].detach(), R[0])
    found[0].sum().backward()
    assert M.grad.isfinite().all()
