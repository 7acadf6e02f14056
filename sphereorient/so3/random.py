"""Random rotations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor


def random_rotations(
    shape: int | Sequence[int],
    *,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Return rotations drawn uniformly from SO(3).

    Args:
        shape: their number, or leading shape; () gives one.
        generator: source of the numbers; the same state gives the same rotations in every dtype.
        dtype: of the result.
        device: of the result.

    Returns:
        (*shape, 3, 3), the rotations.

    Source: a quaternion of four normal numbers points anywhere on its sphere alike (Marsaglia 1972).
    """
    leading = (shape,) if isinstance(shape, int) else tuple(shape)
    origin = generator.device if generator is not None else None
    quat_wxyz = torch.randn(*leading, 4, generator=generator, dtype=torch.float64, device=origin)
    return quaternion_to_rotation_matrix(quat_wxyz).to(dtype=dtype, device=device)
