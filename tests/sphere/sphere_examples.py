import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# The camera of docs/conventions.md's check: it looks along lab +y, lab z is up, so x right is lab x, y down is lab -z.
R_CAM_LAB_ALONG_Y = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def body_direction(longitude_deg: float, latitude_deg: float) -> Tensor:
    """docs/conventions.md, texture map, written out."""
    lon, lat = math.radians(longitude_deg), math.radians(latitude_deg)
    return f64([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])


def random_map(rng: torch.Generator, height: int = 16) -> Tensor:
    """Noise: no two texels alike, so that a look-up one texel off fails."""
    return torch.rand(height, 2 * height, generator=rng, dtype=torch.float64)


def looked_up(texture: Tensor, direction: Tensor) -> NDArray[np.float64]:
    """The oracle: bilinear look-up of directions (..., 3) in numpy float64, without padding the map."""
    grey = texture.double().numpy()
    height, width = grey.shape
    x, y, z = np.moveaxis(direction.double().numpy(), -1, 0)
    column = (np.arctan2(y, x) + np.pi) / (2 * np.pi) * width - 0.5
    row = (np.pi / 2 - np.arctan2(z, np.hypot(x, y))) / np.pi * height - 0.5
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    a, b = column - left, row - top

    def texel(row: NDArray[np.int_], column: NDArray[np.int_]) -> NDArray[np.float64]:
        beyond = (row < 0) | (row >= height)  # over the pole: the same row on the opposite meridian
        column = np.where(beyond, column + width // 2, column) % width
        row = np.clip(row, 0, height - 1)
        return grey[row, column]

    upper = (1 - a) * texel(top, left) + a * texel(top, left + 1)
    lower = (1 - a) * texel(top + 1, left) + a * texel(top + 1, left + 1)
    return (1 - b) * upper + b * lower


def map_with_three_dots(height: int = 256) -> Tensor:
    """Black, with a white dot at the map's centre, one of grey 0.7 in the north, one of grey 0.4 in the east."""
    latitude = math.pi / 2 - math.pi * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    longitude = math.pi * (torch.arange(2 * height, dtype=torch.float64) + 0.5) / height - math.pi
    lat, lon = torch.meshgrid(latitude, longitude, indexing="ij")
    direction = torch.stack([lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()], dim=-1)
    texture = torch.zeros(height, 2 * height, dtype=torch.float64)
    for grey, place in ((1.0, (0, 0)), (0.7, (0, 50)), (0.4, (50, 0))):
        texture[direction @ body_direction(*place) > math.cos(math.radians(10))] = grey
    return texture


def template_score(picture: Tensor, template: Tensor, inside: Tensor) -> float:
    """The paper's T of docs/errata.md A2: the share of the disk's pixels whose paint agrees."""
    return float(((picture[inside] > 0.5) == (template[inside] > 0.5)).double().mean())
