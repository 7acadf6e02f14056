"""How well a grid of rotations covers: the oracle of both grids' tests."""

import torch
from torch import Tensor


def nearest_distance(grid: Tensor, R: Tensor, chunk: int = 1000) -> Tensor:
    """(N,), rad, from each rotation to the grid's nearest: the largest trace(A^T B) = vec(A) . vec(B)."""
    flat = grid.flatten(1)
    trace = torch.cat([(part @ flat.T).amax(1) for part in R.flatten(1).split(chunk)])
    # acos serves here: distances are several degrees, and its error of 1e-8 is nothing to them
    return ((trace - 1) / 2).clamp(-1, 1).acos()
