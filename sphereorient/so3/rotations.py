"""Rotations: exponential map and its inverse, angles, projection onto SO(3), mean, random draws."""

from collections.abc import Sequence

import torch
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    quaternion_to_rotation_matrix,
    rotation_matrix_to_axis_angle,
)
from torch import Tensor

from sphereorient.errors import check_tail

MEAN_STEPS = 12


def exp(rotvec: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), rad, of any length, by Rodrigues' formula."""
    check_tail("rotvec", rotvec, 3)
    return axis_angle_to_rotation_matrix(rotvec)


def log(R: Tensor) -> Tensor:
    """Return the shortest rotation vectors (..., 3), rad, of rotations (..., 3, 3), not checked.
    At exactly pi the choice between the two vectors is always the same, and the gradient is finite.
    Source: textbook; through the quaternion's largest component, so it keeps all digits at 0 and at pi.
    """
    check_tail("R", R, 3, 3)
    return rotation_matrix_to_axis_angle(R)


def hat(v: Tensor) -> Tensor:
    """Return the antisymmetric matrix (..., 3, 3) whose product with a vector x is the cross product v × x."""
    check_tail("v", v, 3)
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def vee(M: Tensor) -> Tensor:
    """Return the vector (..., 3) of a matrix' antisymmetric part; of a rotation it is axis times sine of the angle."""
    check_tail("M", M, 3, 3)
    twice = M - M.mT
    return torch.stack([twice[..., 2, 1], twice[..., 0, 2], twice[..., 1, 0]], -1) / 2


def angle(R: Tensor) -> Tensor:
    """Return the angle (...), rad, 0 .. pi, of rotations (..., 3, 3), accurate also near 0 and pi.
    The gradient at exactly 0 and pi, which does not exist, is set to 0.
    Source: docs/errata.md A3; acos((Tr - 1)/2), the paper's, loses half the digits near 0 and pi.
    """
    check_tail("R", R, 3, 3)
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    # vector_norm has gradient 0 at 0, which is the branch at 0 and pi; atan2 itself is smooth at both.
    return torch.atan2(torch.linalg.vector_norm(vee(R), dim=-1), cosine)


def geodesic_distance(A: Tensor, B: Tensor) -> Tensor:
    """Return the angle (...), rad, 0 .. pi, of A^T B for rotations (..., 3, 3); exactly 0 for equal inputs.
    Gradient as `angle`.
    Source: the paper's d(A, B), worked out by docs/errata.md A3; the cosine from Tr((A-B)(A-B)^T) = 4 (1 - cos d).
    """
    check_tail("A", A, 3, 3)
    check_tail("B", B, 3, 3)
    D = B - A
    # A^T A is symmetric, so A^T B and A^T (B - A) have the same vee: with rows a, d it is half the sum of d × a.
    # The difference keeps its digits where A and B are close; the product A^T B would not.
    sine = torch.linalg.vector_norm(torch.linalg.cross(D, A.expand_as(D)).sum(-2), dim=-1) / 2
    return torch.atan2(sine, 1 - D.square().sum((-2, -1)) / 4)


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
    for _ in range(MEAN_STEPS):
        mean = mean @ exp((share * log(mean[..., None, :, :].mT @ R)).sum(-2))
    return mean


def random_rotations(
    shape: int | Sequence[int],
    *,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Return rotations (*shape, 3, 3) drawn uniformly from SO(3), from the same numbers in every dtype.
    Source: a quaternion of four normal numbers has a uniform direction (Marsaglia 1972).
    """
    leading = (shape,) if isinstance(shape, int) else tuple(shape)
    origin = generator.device if generator is not None else None
    quat_wxyz = torch.randn(*leading, 4, generator=generator, dtype=torch.float64, device=origin)
    return quaternion_to_rotation_matrix(quat_wxyz).to(dtype=dtype, device=device)
