"""The paper's path cost; rotations over frames without candidates."""

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.trellis import taken, visited_before
from sphereorient.errors import check_tail

PAIRS_AT_ONCE = 1 << 16  # candidate pairs whose 3 x 3 products are held at once, 5 MB


def edge_costs(R_lab_body: Tensor, score: Tensor, time_s: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the paper's cost d(A, B) (2 - T_A - T_B) / dt, rad/s, from each candidate (row) to each of the next step.
    Shapes: R_lab_body (..., N, C, 3, 3), score T (..., N, C), increasing time_s (..., N), result (..., N - 1, C, C).
    With a mask (..., N, C), each edge comes from the last step before it with candidates.
    Source: the paper's assembly of III; a standstill costs nothing (docs/errata.md A6).

    Raises:
        ShapeError: the inputs differ in steps or candidates.
    """
    check_tail("R_lab_body", R_lab_body, 3, 3)
    check_tail("score", score, *R_lab_body.shape[-4:-2])
    check_tail("time_s", time_s, *score.shape[-2:-1])
    mask = torch.ones_like(score, dtype=torch.bool) if mask is None else mask
    last, time_s = visited_before(mask)[..., 1:], time_s.expand(score.shape[:-1])
    dt = time_s[..., 1:] - taken(time_s, last, 0)  # in this order: single precision cannot separate late times
    turn = turns_over_gaps(R_lab_body, mask)
    doubt = 2 - taken(score, last, 1)[..., :, None] - score[..., 1:, None, :]
    return turn * doubt / dt.to(turn)[..., None, None]


def turns_over_gaps(R_lab_body: Tensor, mask: Tensor) -> Tensor:
    """Return the angles (..., N - 1, C, C), rad, between candidates (..., N, C, 3, 3) and those of the next step.
    Each comes from the last step before it with candidates in the mask (..., N, C).
    """
    last, width = visited_before(mask)[..., 1:], mask.shape[-1]
    before, after = (R.flatten(0, -4) for R in (taken(R_lab_body, last, 3), R_lab_body[..., 1:, :, :, :]))
    chunk = max(1, PAIRS_AT_ONCE // max(width, 1) ** 2)
    parts = [
        so3.geodesic_distance(a[:, :, None], b[:, None])
        for a, b in zip(torch.split(before, chunk), torch.split(after, chunk), strict=True)
    ]
    return torch.cat(parts).reshape(*last.shape, width, width)
