import torch
from torch import Tensor

from sphereorient.errors import check_tail


def nearest_rotation(M: Tensor) -> Tensor:
    """Return the rotation nearest to any matrix M (..., 3, 3), by the sum of squared differences; NaN if not finite.
    Where several are equally near (rank below 2, or a reflection with equal smallest singular values) it is one of
    them, with gradient 0 in the undetermined directions. First derivatives only.
    Source: Kabsch 1976, the paper's R_kabsch; derivative of the polar factor, textbook.
    """
    check_tail("M", M, 3, 3)
    finite = M.isfinite().all(-1).all(-1)[..., None, None]
    view = torch.eye(3, dtype=M.dtype, device=M.device)
    M = torch.where(finite, M, view)
    U, S, Vh = torch.linalg.svd(M.detach())
    sign = torch.linalg.det(U @ Vh).sign()[..., None]
    signs = torch.cat([torch.ones_like(S[..., :2]), sign], -1)
    S, Vh = S * signs, signs[..., None] * Vh
    R = U @ Vh
    # U and V have no derivative where singular values are equal, as they are for every rotation; their product has,
    # with only sums of singular values in the denominator: dR = U X V^T, X = antisymmetric part of U^T dM V / sums.
    sums = S[..., :, None] + S[..., None, :]
    decided = sums > 8 * torch.finfo(M.dtype).eps * S[..., :1, None]
    turned = U.mT @ M @ Vh.mT
    X = torch.where(decided, (turned - turned.mT) / torch.where(decided, sums, torch.ones_like(sums)), 0)
    step = U @ X @ Vh
    return torch.where(finite, R + (step - step.detach()), torch.full_like(R, torch.nan))
