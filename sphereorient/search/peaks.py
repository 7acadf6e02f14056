"""Peaks of many scores over SO(3), found without sorting them."""

import math

import torch
from torch import Tensor


def compact_groups(R: Tensor, size: int) -> Tensor:
    """Divide rotations (K, 3, 3) into groups of neighbours, (G, size) int64; some come twice unless size divides K.
    Source: halving along the matrix component that varies most (Bentley 1975).
    """
    flat = R.flatten(1)
    groups = math.ceil(len(R) / size)
    index = torch.arange(groups * size) % len(R)

    def halved(members: Tensor) -> list[Tensor]:
        if len(members) <= size:
            return [members]
        at = flat[members]
        order = members[at[:, int(at.var(0).argmax())].argsort(stable=True)]
        middle = len(members) // size // 2 * size
        return [*halved(order[:middle]), *halved(order[middle:])]

    return torch.stack(halved(index))


def best_of_groups(scores: Tensor, count: int) -> Tensor:
    """Return the best members of the `count` best groups, (F, count) int64, best first, from scores (F, M, G).
    Indices are into the flattened members and groups; all groups where there are fewer.
    """
    groups = scores.shape[2]
    group = scores.amax(1).topk(min(count, groups), dim=1).indices
    members = scores.gather(2, group[:, None].expand(-1, scores.shape[1], -1))
    return members.argmax(1) * groups + group


def distinct(R: Tensor, apart_rad: float) -> Tensor:
    """Return which rotations (..., M, 3, 3), best first, are peaks, (..., M) bool; the first always is.
    Non-maximum suppression: any better neighbour within apart_rad suppresses, even a suppressed one.
    """
    flat = R.flatten(-2)
    return ~torch.tril(flat @ flat.mT > 1 + 2 * math.cos(apart_rad), -1).any(-1)  # the product is the trace of A^T B
