"""The paper's angles: theta = (theta_x, theta_y, theta_z), R = Rx(theta_x) Ry(theta_y) Rz(theta_z)."""

import math

import torch
from torch import Tensor

from sphereorient.errors import check_tail


def from_tait_bryan(theta: Tensor) -> Tensor:
    """Return the rotation (..., 3, 3) of angles theta (..., 3), rad: Rx Ry Rz, the paper's R_lab_body.
    Source: the paper's R(theta): rotations about the fixed z, then y, then x; or about the body's x, then its new y,
    then its new z (docs/errata.md E9).
    """
    check_tail("theta", theta, 3)
    (sx, sy, sz), (cx, cy, cz) = theta.sin().unbind(-1), theta.cos().unbind(-1)
    rows = [
        *(cy * cz, -cy * sz, sy),
        *(cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy),
        *(sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy),
    ]
    return torch.stack(rows, -1).reshape(*theta.shape[:-1], 3, 3)


def to_tait_bryan(R: Tensor) -> Tensor:
    """Return the Tait-Bryan angles (..., 3), rad, of rotations (..., 3, 3), with theta_y in -pi/2 .. pi/2; NaN for NaN.
    At cos(theta_y) = 0 (below four roundings) only theta_x ± theta_z is defined: theta_z and its gradient are 0.
    Source: docs/errata.md E1, with other elements for theta_y and theta_x, equal for a rotation: asin loses half the
    digits near theta_y = ± pi/2, and -R23, R33 lose all.
    """
    check_tail("R", R, 3, 3)
    cos_y = torch.linalg.vector_norm(R[..., 0, :2], dim=-1)
    defined = ~(cos_y <= 4 * torch.finfo(R.dtype).eps)  # of no rotation, NaN, all three angles are NaN
    zero, one = torch.zeros_like(cos_y), torch.ones_like(cos_y)
    theta_z = torch.atan2(torch.where(defined, -R[..., 0, 1], zero), torch.where(defined, R[..., 0, 0], one))
    # R Rz^T = Rx Ry, whose second column (0, cos theta_x, sin theta_x) does not shrink with cos theta_y.
    column = R[..., 1:, 0] * theta_z.sin()[..., None] + R[..., 1:, 1] * theta_z.cos()[..., None]
    theta_x = torch.atan2(column[..., 1], column[..., 0])
    return torch.stack([theta_x, torch.atan2(R[..., 0, 2], cos_y), theta_z], -1)


def second_triplet(theta: Tensor) -> Tensor:
    """Return the other angles (..., 3), rad, not wrapped, of the rotation of theta (..., 3), rad.
    They are theta_x + pi, ± pi - theta_y with the sign of theta_y, theta_z + pi.
    Source: the paper's second triplet with sign(0) = 1, docs/errata.md E2.
    """
    check_tail("theta", theta, 3)
    x, y, z = theta.unbind(-1)
    half_turn = torch.where(y < 0, torch.full_like(y, -math.pi), torch.full_like(y, math.pi))
    return torch.stack([x + math.pi, half_turn - y, z + math.pi], -1)


def rate_matrix_lab(theta: Tensor) -> Tensor:
    """Return H (..., 3, 3) with H dtheta/dt = omega_lab, of the angles of R_lab_body; its determinant is cos(theta_y).
    Source: the paper's H, which it assigns to the body (docs/errata.md E3).
    """
    check_tail("theta", theta, 3)
    x, y, _ = theta.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    sx, cx, sy, cy = x.sin(), x.cos(), y.sin(), y.cos()
    return torch.stack([one, zero, sy, zero, cx, -sx * cy, zero, sx, cx * cy], -1).reshape(*theta.shape[:-1], 3, 3)


def rate_matrix_body(theta: Tensor) -> Tensor:
    """Return R^T `rate_matrix_lab` (..., 3, 3), from dtheta/dt to omega_body (docs/errata.md E3)."""
    check_tail("theta", theta, 3)
    _, y, z = theta.unbind(-1)
    zero, one = torch.zeros_like(y), torch.ones_like(y)
    sy, cy, sz, cz = y.sin(), y.cos(), z.sin(), z.cos()
    return torch.stack([cy * cz, sz, zero, -cy * sz, cz, zero, sy, zero, one], -1).reshape(*theta.shape[:-1], 3, 3)
