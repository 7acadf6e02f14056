"""The mean of rotations."""

from __future__ import annotations

import torch
from torch import Tensor

from sphereorient.errors import check_tail
from sphereorient.so3.exp import exp, log
from sphereorient.so3.project import nearest_rotation

STEPS = 12


def weighted_mean(R: Tensor, weights: Tensor) -> Tensor:
    """Return the rotation with the smallest weighted sum of squared angles to given ones (Karcher mean).

    Two rotations give the point of the geodesic between them that divides it by the weights. The steps are a fixed
    number, from the chordal mean (the rotation nearest to the weighted sum).

    Args:
        R: (..., K, 3, 3), rotations, not checked.
        weights: (..., K), not negative, of any sum above 0; leading axes broadcast against those of R. A rotation that
            is NaN does not count where its weight is 0.

    Returns:
        (..., 3, 3), frames of R; NaN where all weights are 0. Where the rotations are so far apart that several means
        are equally good (two of them by pi) the result is one of them, always the same.

    Source: Hartley et al. 2013, Rotation averaging, algorithm 1.
    """
    check_tail("R", R, *weights.shape[-1:], 3, 3)
    weights = weights.to(R)
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    missing = (share == 0)[..., None] & R.isnan()
    R = torch.where(missing, torch.eye(3, dtype=R.dtype, device=R.device), R)
    mean = nearest_rotation((share[..., None] * R).sum(-3))
    for _ in range(STEPS):
        mean = mean @ exp((share * log(mean[..., None, :, :].mT @ R)).sum(-2))
    return mean
