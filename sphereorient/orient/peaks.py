"""The best distinct rotations of a long list of scores, found without sorting it."""

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
    index = torch.cat([torch.arange(len(R)), torch.arange(groups * size - len(R))])

    def halved(members: Tensor) -> list[Tensor]:
        if len(members) <= size:
            return [members]
        at = flat[members]
        order = members[at[:, int(at.var(0).argmax())].argsort(stable=True)]
        middle = len(members) // size // 2 * size
        return [*halved(order[:middle]), *halved(order[middle:])]

    return torch.stack(halved(index))


def distinct_peaks(scores: Tensor, R: Tensor, apart_rad: float, count: int) -> tuple[Tensor, Tensor]:
    """Find rotations that no better one is near to, among the best of each group.

    Args:
        scores: (F, M, G), those of the M members of G groups.
        R: (M, G, 3, 3), their rotations.
        apart_rad: a rotation nearer than this to a better one is no peak of its own.
        count: how many groups are looked at, the best ones.

    Returns:
        Places (F, count) int64 in the flattened members and groups, best first, and which of them are peaks, bool.
    """
    groups = scores.shape[2]
    group = scores.amax(1).topk(min(count, groups), dim=1).indices
    members = scores.gather(2, group[:, None].expand(-1, scores.shape[1], -1))
    place = members.argmax(1) * groups + group
    flat = R.reshape(-1, 9)[place]
    near = flat @ flat.mT > 1 + 2 * math.cos(apart_rad)  # trace of A^T B
    return place, ~torch.tril(near, -1).any(-1)
