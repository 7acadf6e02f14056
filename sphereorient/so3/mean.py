import torch
from torch import Tensor

from sphereorient.errors import check_tail
from sphereorient.so3.exp import exp, log
from sphereorient.so3.project import nearest_rotation

STEPS = 12


def weighted_mean(R: Tensor, weights: Tensor) -> Tensor:
    """Return the rotation (..., 3, 3) with the smallest weighted sum of squared angles to R (..., K, 3, 3).
    Weights (..., K) are not negative, of any sum; NaN rotations of weight 0 do not count; NaN where all weights are 0.
    Where several means are equally good, the choice is always the same.
    Source: Karcher mean; Hartley et al. 2013, Rotation averaging, algorithm 1.
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
