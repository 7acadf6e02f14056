"""Disks for the tests of the grey search: as of a camera, with the errors of a real outline."""

import math
from functools import cache

import torch
from orient_examples import KINDS, texture_of
from torch import Tensor

from sphereorient.search import GreySearch, GreySearchSettings, crop_disk
from sphereorient.sphere import orthographic_view, reduced_texture

SIZE = GreySearchSettings().size_px
REAL, MARGIN = 80, 8  # diameter of the ball and room about it in the camera's picture, px
BLACK, WHITE = 20.0, 170.0

__all__ = ["KINDS", "SIZE", "camera_disks", "grey_search_of", "light_from"]


@cache
def grey_search_of(kind: str) -> GreySearch:
    return GreySearch(texture_of(kind), GreySearchSettings())


def camera_disks(
    kind: str, R_view_body: Tensor, light: Tensor | None = None, noise: float = 0.05, off_px: float = 0.5, seed: int = 3
) -> Tensor:
    """(F, SIZE, SIZE): disks of 80 px, noisy, cut out with a wrong centre and up to 1 % off in radius."""
    rng = torch.Generator().manual_seed(seed)
    view = orthographic_view(REAL)
    paint = view.paint(reduced_texture(texture_of(kind), REAL), R_view_body.float())
    grey = BLACK + (WHITE - BLACK) * paint
    if light is not None:
        grey = grey * (view.normal_view @ light).clamp_min(0.05)
    pictures = torch.nn.functional.pad(view.picture(grey, outside=15.0), (MARGIN,) * 4, value=15.0)
    pictures = pictures + noise * (WHITE - BLACK) * torch.randn(pictures.shape, generator=rng)
    middle = MARGIN + (REAL - 1) / 2
    disks = []
    for picture in pictures:
        angle, wrong = torch.rand(2, generator=rng).tolist()
        u, v = middle + off_px * math.cos(2 * math.pi * angle), middle + off_px * math.sin(2 * math.pi * angle)
        radius = REAL / 2 * (1 + 0.02 * off_px * (2 * wrong - 1))
        disks.append(torch.from_numpy(crop_disk(picture.numpy(), u, v, radius, SIZE)))
    return torch.stack(disks)


def light_from(x: float, y: float, z: float) -> Tensor:
    """One lamp, in the view frame; negative z is before the ball."""
    return torch.nn.functional.normalize(torch.tensor([x, y, z]), dim=0)
