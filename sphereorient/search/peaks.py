"""Peaks of many scores over SO(3), found without sorting them."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def compact_groups(R: Tensor, size: int) -> Tensor:
    """Divide rotations into groups of neighbours, all of one size.

    Args:
        R: (K, 3, 3).
        size: of a group.

    Returns:
        (G, size) int64, indices of rotations; where `size` does not divide K, some rotations come twice.

    Source: halving along the matrix component that varies most (Bentley 1975); the components' distance grows with the
    angle, so neighbours in them are neighbours on SO(3).
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
    """Find the best member of each of the best groups.

    Args:
        scores: (F, M, G), those of the M members of G groups.
        count: of groups.

    Returns:
        (F, count) int64, or of all groups where there are fewer: places in the flattened members and groups, best
        first.
    """
    groups = scores.shape[2]
    group = scores.amax(1).topk(min(count, groups), dim=1).indices
    members = scores.gather(2, group[:, None].expand(-1, scores.shape[1], -1))
    return members.argmax(1) * groups + group


def distinct(R: Tensor, apart_rad: float) -> Tensor:
    """Suppress non-maxima: a rotation is suppressed by any better neighbour, even a suppressed one.

    Args:
        R: (..., M, 3, 3), best first.
        apart_rad: distance below which rotations are neighbours, rad.

    Returns:
        (..., M) bool, which are peaks; the first always is.
    """
    flat = R.flatten(-2)
    return ~torch.tril(flat @ flat.mT > 1 + 2 * math.cos(apart_rad), -1).any(-1)  # the product is the trace of A^T B
