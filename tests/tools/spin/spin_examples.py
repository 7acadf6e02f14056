"""Photographs of a ball with dots, drawn from the definitions, without the package's renderers."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3

ORANGE = (190.0, 100.0, 45.0)
SCENE = 18.0


def dot_directions(count: int = 16, seed: int = 5) -> Tensor:
    """Directions (D, 3) float64 at least 25 degrees apart."""
    rng = torch.Generator().manual_seed(seed)
    found: list[Tensor] = []
    while len(found) < count:
        one = torch.nn.functional.normalize(torch.randn(3, generator=rng, dtype=torch.float64), dim=0)
        if all(float(one @ other) < 0.906 for other in found):
            found.append(one)
    return torch.stack(found)


def photograph(
    R_view_body: Tensor,
    direction_body: Tensor,
    radius_deg: float = 7.0,
    *,
    ball: tuple[float, float, float] = (33.0, 32.0, 29.0),
    side: int = 66,
    seed: int = 0,
    finer: int = 4,
) -> NDArray[np.uint8]:
    """An orange ball with dark dots under light from above left, (S, S, 3), seen from far away."""
    at = (np.arange(side * finer) + 0.5) / finer - 0.5
    right, down = np.meshgrid((at - ball[0]) / ball[2], (at - ball[1]) / ball[2])
    inside = right**2 + down**2 < 1
    near = -np.sqrt(np.clip(1 - right**2 - down**2, 0, 1))  # z points away from the camera
    normal = np.stack([right, down, near], -1)
    seen = (R_view_body.double() @ direction_body.double().T).T.numpy()  # dots in the view frame
    dotted = (normal @ seen.T).max(-1) > np.cos(np.radians(radius_deg))
    light = 0.75 + 0.25 * (normal @ np.array([-0.5, -0.5, -0.7]))
    paint = np.where(dotted, 0.25, 1.0) * light
    fine = np.where(inside[..., None], paint[..., None] * np.array(ORANGE), SCENE)
    grey = fine.reshape(side, finer, side, finer, 3).mean((1, 3))
    noise = np.random.default_rng(seed).normal(0, 3, grey.shape)
    return np.clip(grey + noise, 0, 255).round().astype(np.uint8)


def spinning(omega: Tensor, R0: Tensor, time_s: Tensor) -> Tensor:
    """Attitudes (F, 3, 3) of an even spin."""
    return so3.exp(omega * time_s[:, None]) @ R0
