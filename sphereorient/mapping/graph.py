"""All relative rotations at once: attitudes that agree with most of them, wrong closures set aside."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from torch import Tensor

from sphereorient import so3
from sphereorient.mapping.pairs import Turns

ROUNDS = 20
ARRIVED_RAD = 1e-6


def solve_graph(R_lab_body: Tensor, turns: Turns, scale_rad: float) -> tuple[Tensor, Tensor]:
    """Fit attitudes to relative rotations; the first attitude stays.

    Args:
        R_lab_body: (N, 3, 3) float64, starts.
        turns: pairs; every instant is connected to the first one.
        scale_rad: deviation of a pair, in its typical direction, from which on it counts less.

    Returns:
        Attitudes (N, 3, 3), and what is left of each pair (E, 3), rad: delta in exp([delta]x) R_ji.

    Source: pose graph on SO(3) by Gauss-Newton; robust weights, Geman and McClure 1987, narrowed step by step as in
    graduated non-convexity (Yang et al. 2020).
    """
    R, i, j = R_lab_body.clone(), turns.first, turns.second
    typical = turns.information.diagonal(dim1=1, dim2=2).mean().clamp_min(1e-12)
    shape = turns.information / typical
    for k in range(ROUNDS):
        wide = scale_rad * max(1.0, 16.0 * 0.6**k)
        left = so3.log(turns.R_ji @ (R[j] @ R[i].mT).mT)
        weight = 1 / (1 + (left.norm(dim=-1) / wide).square()).square()
        step = _step(R, i, j, left, shape * weight[:, None, None])
        R = so3.exp(step) @ R
        if wide == scale_rad and float(step.norm(dim=-1).max()) < ARRIVED_RAD:
            break
    R = so3.nearest_rotation(R @ (R[0].mT @ R_lab_body[0]))
    return R, so3.log(turns.R_ji @ (R[j] @ R[i].mT).mT)


def _step(R: Tensor, i: Tensor, j: Tensor, left: Tensor, weight: Tensor) -> Tensor:
    """Solve left = delta_j - R_ji delta_i for all pairs, (N, 3)."""
    count = len(R)
    carry = R[j] @ R[i].mT
    blocks = {
        (0, 0): carry.mT @ weight @ carry,
        (0, 1): -carry.mT @ weight,
        (1, 0): -weight @ carry,
        (1, 1): weight,
    }
    ends = (i, j)
    rows, columns, values = [], [], []
    for (a, b), block in blocks.items():
        at = torch.arange(3)
        rows.append((3 * ends[a][:, None, None] + at[:, None]).expand(-1, 3, 3).reshape(-1))
        columns.append((3 * ends[b][:, None, None] + at).expand(-1, 3, 3).reshape(-1))
        values.append(block.reshape(-1))
    pulled = (weight @ left[..., None])[..., 0]
    right = torch.zeros(count, 3, dtype=R.dtype)
    right.index_add_(0, j, pulled)
    right.index_add_(0, i, -(carry.mT @ pulled[..., None])[..., 0])
    # The first one is held, and who is connected to nothing stays where it is.
    diagonal = np.full(3 * count, 1e-9)
    diagonal[:3] = 1e9
    every = np.arange(3 * count)
    matrix = coo_matrix(
        (
            np.concatenate([torch.cat(values).numpy(), diagonal]),
            (np.concatenate([torch.cat(rows).numpy(), every]), np.concatenate([torch.cat(columns).numpy(), every])),
        ),
        shape=(3 * count, 3 * count),
    ).tocsc()
    return torch.from_numpy(spsolve(matrix, right.reshape(-1).numpy()).reshape(count, 3))
