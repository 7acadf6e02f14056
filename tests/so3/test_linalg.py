import torch
from torch.testing import assert_close

from sphereorient.so3 import cross_first_axis, inverse_damped, solve_damped


def test_a_well_conditioned_system_is_solved_and_inverted() -> None:
    rng = torch.Generator().manual_seed(0)
    half = torch.randn(5, 6, 6, generator=rng, dtype=torch.float64)
    matrix, right = half @ half.mT + torch.eye(6), torch.randn(5, 6, generator=rng, dtype=torch.float64)
    assert_close(solve_damped(matrix, right), torch.linalg.solve(matrix, right), rtol=1e-6, atol=1e-8)
    assert_close(inverse_damped(matrix), torch.linalg.inv(matrix), rtol=1e-6, atol=1e-8)


def test_a_direction_without_information_gets_no_step() -> None:
    matrix = torch.diag(torch.tensor([2.0, 0.0], dtype=torch.float64))
    assert_close(
        solve_damped(matrix, torch.tensor([4.0, 0.0], dtype=torch.float64)).tolist(), [2.0, 0.0], rtol=1e-8, atol=0
    )
    assert_close(solve_damped(matrix, torch.tensor([3.0, 0.0], dtype=torch.float64), ridge=0.5)[0].item(), 1.0)
    assert_close(inverse_damped(matrix)[1, 1].item(), 1e12)


def test_the_cross_product_is_taken_along_axis_1() -> None:
    rng = torch.Generator().manual_seed(1)
    a, b = torch.randn(2, 4, 3, 5, generator=rng, dtype=torch.float64)
    assert_close(cross_first_axis(a, b), torch.linalg.cross(a, b, dim=1))
