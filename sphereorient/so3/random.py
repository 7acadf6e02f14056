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
    """Return rotations (*shape, 3, 3) drawn uniformly from SO(3), from the same numbers in every dtype.
    Source: a quaternion of four normal numbers has a uniform direction (Marsaglia 1972).
    """
    leading = (shape,) if isinstance(shape, int) else tuple(shape)
    origin = generator.device if generator is not None else None
    quat_wxyz = torch.randn(*leading, 4, generator=generator, dtype=torch.float64, device=origin)
    return quaternion_to_rotation_matrix(quat_wxyz).to(dtype=dtype, device=device)
