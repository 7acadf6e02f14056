"""Small linear algebra: damped solutions, and a cross product along axis 1."""

import torch
from torch import Tensor


def solve_damped(matrix: Tensor, right: Tensor, ridge: float = 1e-9) -> Tensor:
    """Solve symmetric positive semidefinite systems (..., n, n), (..., n); `ridge` is a share of each diagonal element.
    A direction without information gets no step.
    """
    solution: Tensor = torch.linalg.solve_ex(_damped(matrix, ridge), right[..., None]).result
    return solution[..., 0]


def inverse_damped(matrix: Tensor) -> Tensor:
    """Invert symmetric positive semidefinite matrices (..., n, n), damped as in `solve_damped`."""
    inverse: Tensor = torch.linalg.inv_ex(_damped(matrix, 1e-9)).inverse
    return inverse


def cross_first_axis(a: Tensor, b: Tensor) -> Tensor:
    """Return a x b of (L, 3, ...), along axis 1; `torch.linalg.cross` is several times slower along a middle axis."""
    (ax, ay, az), (bx, by, bz) = a.unbind(1), b.unbind(1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=1)


def _damped(matrix: Tensor, ridge: float) -> Tensor:
    size = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    return matrix + torch.diag_embed(ridge * size + 1e-12)
