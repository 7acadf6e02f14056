import math

import torch
from conftest import assert_close
from scipy.stats import kstest

from sphereorient import so3

N = 20_000


def haar(phi):
    """Share of all rotations by less than phi."""
    return (phi - torch.sin(torch.as_tensor(phi)).numpy()) / math.pi


def test_they_are_rotations(rng, dtype, tolerance):
    R = so3.random_rotations(100, generator=rng, dtype=dtype)
    assert_close(R @ R.mT, torch.eye(3, dtype=dtype).expand_as(R), atol=tolerance)
    assert_close(torch.linalg.det(R), torch.ones(100, dtype=dtype), atol=tolerance)


def test_they_are_uniform_seen_from_any_rotation(rng):
    R = so3.random_rotations(N, generator=rng)
    for centre in (torch.eye(3, dtype=torch.float64), so3.random_rotations((), generator=rng)):
        assert kstest(so3.geodesic_distance(centre, R).numpy(), haar).pvalue > 1e-3
    assert (R.mean(0).abs() < 5 / math.sqrt(3 * N)).all()
    assert ((R.square().mean(0) - 1 / 3).abs() < 5 * 0.3 / math.sqrt(N)).all()


def test_uniform_angles_are_not_uniform_rotations(rng):
    span = torch.tensor([2 * math.pi, math.pi, 2 * math.pi], dtype=torch.float64)
    R = so3.from_tait_bryan((torch.rand(N, 3, generator=rng, dtype=torch.float64) - 0.5) * span)
    assert kstest(so3.angle(R).numpy(), haar).pvalue < 1e-6


def test_a_seed_gives_the_same_rotations_in_every_dtype_and_shape():
    def draw(shape, dtype=torch.float64):
        return so3.random_rotations(shape, generator=torch.Generator().manual_seed(5), dtype=dtype)

    assert torch.equal(draw(6), draw(6))
    assert torch.equal(draw((2, 1, 3)), draw(6).reshape(2, 1, 3, 3, 3))
    assert_close(draw(6, torch.float32).double(), draw(6), atol=1e-7)
    assert draw(()).shape == (3, 3)
    assert draw(0).shape == draw((0,)).shape == (0, 3, 3)
