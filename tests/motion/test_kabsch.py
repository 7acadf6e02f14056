"""Rotations between sets of points, against scipy; what markers can and cannot show (docs/errata.md E8)."""

import pytest
import torch
from conftest import assert_close
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.motion import kabsch, omega_from_markers, omega_from_orientations, to_body

DT = 1 / 600


def moving_markers(rng: torch.Generator, frames: int = 12) -> tuple[Tensor, Tensor]:
    """Return orientations (N, 3, 3) of a tumbling, moving body and its markers in the lab (N, 5, 3)."""
    t = DT * torch.arange(frames, dtype=torch.float64)[:, None]
    spin = so3.exp(torch.tensor([3.0, -5.0, 9.0], dtype=torch.float64) * t)
    R = spin @ so3.exp(torch.tensor([2.0, 1.0, -0.5], dtype=torch.float64))
    body = 9 * torch.randn(5, 3, generator=rng, dtype=torch.float64)
    return R, body @ R.mT + 500.0 * t[:, None] * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)


def test_kabsch_agrees_with_scipy(rng: torch.Generator) -> None:
    a, b = torch.randn(2, 20, 6, 3, generator=rng, dtype=torch.float64)
    weights = torch.rand(20, 6, generator=rng, dtype=torch.float64)
    got = kabsch(a, b, weights)
    for k in range(20):
        w = weights[k, :, None] / weights[k].sum()
        a_k, b_k = a[k] - (w * a[k]).sum(0), b[k] - (w * b[k]).sum(0)
        expected, _ = Rotation.align_vectors(b_k.numpy(), a_k.numpy(), weights=weights[k].numpy())
        assert_close(got[k], torch.from_numpy(expected.as_matrix()), atol=1e-9)


def test_kabsch_carries_the_first_set_onto_the_second() -> None:
    a = torch.tensor([[1.0, 0, 0], [0, 2, 0], [0, 0, 3], [1, 1, 1]])
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert_close(kabsch(a, a @ quarter.mT + 5.0), quarter, atol=1e-5)
    assert (kabsch(a @ quarter.mT + 5.0, a) - quarter).norm() > 1


def test_points_in_a_plane_and_mirror_images_give_a_proper_rotation(rng: torch.Generator) -> None:
    flat = torch.randn(6, 3, generator=rng, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    R_true = so3.exp(torch.tensor([0.3, -2.0, 0.9], dtype=torch.float64))
    assert_close(kabsch(flat, flat @ R_true.mT), R_true, atol=1e-9)
    solid = torch.randn(6, 3, generator=rng, dtype=torch.float64)
    R = kabsch(solid, solid * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert_close(torch.linalg.det(R), torch.tensor(1.0, dtype=torch.float64), atol=1e-12)
    assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64), atol=1e-12)


def test_kabsch_of_a_batch_is_the_stack_of_its_singles(
    batch: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator
) -> None:
    a, b = torch.randn(2, *batch, 5, 3, generator=rng, dtype=dtype)
    got = kabsch(a, b)
    assert got.shape == (*batch, 3, 3)
    assert got.dtype == dtype
    for one, a_one, b_one in zip(got.reshape(-1, 3, 3), a.reshape(-1, 5, 3), b.reshape(-1, 5, 3), strict=True):
        assert_close(one, kabsch(a_one, b_one), atol=1e-5)


def test_sets_of_unequal_size_are_refused() -> None:
    with pytest.raises(ShapeError, match="points_b"):
        kabsch(torch.zeros(4, 3), torch.zeros(5, 3))


def test_e8_kabsch_gives_the_increment_in_the_lab_so_the_body_components_stay_unknown(rng: torch.Generator) -> None:
    """Printed: markers give omega in the particle frame. Corrected: R_kabsch is T = R_b R_a^T, so omega_lab."""
    R, markers = moving_markers(rng)
    assert_close(kabsch(markers[3], markers[5]), R[5] @ R[3].mT, atol=1e-9)
    omega, _ = omega_from_markers(markers, DT, [1, 2])
    assert_close(omega, omega_from_orientations(R, DT, [1, 2])[0], atol=1e-6)
    omega_true = torch.tensor([3.0, -5.0, 9.0], dtype=torch.float64)
    assert_close(omega[5], omega_true, atol=1e-6)
    printed = to_body(R[5], omega_true)  # the wrong reading: in particle components
    assert (omega[5] - printed).norm() > 5
    # two bodies with the same markers but other body axes look alike: omega_body is unknown
    assert (to_body(R[5] @ R[2], omega[5]) - printed).norm() > 1


def test_markers_that_are_not_seen_are_left_out_and_fewer_than_three_give_nothing(rng: torch.Generator) -> None:
    _, markers = moving_markers(rng)
    full, _ = omega_from_markers(markers, DT, [1])
    markers[4, 0] = torch.nan
    markers[6, 1] = torch.nan
    assert_close(omega_from_markers(markers, DT, [1])[0], full, atol=1e-6)
    markers[4, 2] = torch.nan
    omega, _ = omega_from_markers(markers, DT, [1])
    assert omega.isnan().any(-1).nonzero().flatten().tolist() == [0, 5, 11]
