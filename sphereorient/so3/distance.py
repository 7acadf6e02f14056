import torch
from torch import Tensor

from sphereorient.errors import check_tail
from sphereorient.so3.exp import vee


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
