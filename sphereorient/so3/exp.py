import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from torch import Tensor

from sphereorient.errors import check_tail


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
