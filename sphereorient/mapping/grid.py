"""The unknown map as a linear system: every pixel reads a few texels, every texel is read by many pixels."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from torch import Tensor

from sphereorient.sphere.texture import texture_coordinates
from sphereorient.sphere.texture_table import CHUNK, SIDE, TextureTable, octahedral_directions

STEP_RAD = 0.002  # over which a table's slopes are taken
POLE = 1e-3  # least cosine of a latitude: at the pole itself longitude means nothing
READS = 16  # texels that a look-up reads


def texel_weights(direction_body: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Return which texels a look-up reads: a cubic B-spline whose coefficients are the texels, as `sample_spline`.

    Args:
        direction_body: (..., 3) unit.
        height: H of the map (H, 2 H), at least 4.

    Returns:
        Places (..., 16) int64 in the flattened map, and weights (..., 16), sum 1.
    """
    width = 2 * height
    longitude, latitude = texture_coordinates(direction_body)
    columns, along = _spline((longitude + math.pi) * (width / (2 * math.pi)) - 0.5)
    rows, across = _spline((math.pi / 2 - latitude) * (height / math.pi) - 0.5)
    beyond = (rows < 0) | (rows >= height)  # over a pole the meridian goes on at the other side
    rows = torch.where(rows < 0, -1 - rows, torch.where(rows >= height, 2 * height - 1 - rows, rows))
    columns = (columns[..., None, :] + torch.where(beyond, height, 0)[..., None]) % width
    place = rows[..., None] * width + columns
    return place.flatten(-2), (across[..., None] * along[..., None, :]).flatten(-2)


def _spline(place: Tensor) -> tuple[Tensor, Tensor]:
    """Return the four texels about places (...) in texels, (..., 4) int64, and their weights.

    Source: Unser 1999, Splines, a perfect fit, eq. 3.
    """
    below = place.floor()
    t = place - below
    s = 1 - t
    weights = [s**3, 4 - 3 * t * t * (1 + s), 4 - 3 * s * s * (1 + t), t**3]
    return below.long()[..., None] + torch.arange(-1, 3), torch.stack(weights, dim=-1) / 6


def _spline_slope(place: Tensor) -> Tensor:
    """Return the derivative of the weights by the place, (..., 4)."""
    t = place - place.floor()
    s = 1 - t
    slopes = [-s * s, t * (3 * t - 4), s * (4 - 3 * s), t * t]
    return torch.stack(slopes, dim=-1) / 2


class SplinePaint(TextureTable):
    """A map looked up by its spline, exactly, and which texels that read: what a least squares of the map asks for.

    Args:
        texture: (H, 2 H), blurred as the pictures are.
        blur_rad: standard deviation of the blur that is in it, rad.
    """

    def __init__(self, texture: Tensor, blur_rad: float) -> None:
        super().__init__(torch.zeros(1, 4), blur_rad)
        self.texture = texture
        self.reads: list[tuple[Tensor, Tensor]] = []  # of each look: texels and weights, (L, P, 16)

    def sample(self, direction_body: Tensor) -> tuple[Tensor, Tensor]:
        """Look up the paint and its slope; see `TextureTable.sample`."""
        height = len(self.texture)
        direction = direction_body.movedim(1, -1)
        place, weight = texel_weights(direction, height)
        self.reads.append((place, weight))
        found = self.texture.to(direction.dtype).reshape(-1)[place].reshape(*place.shape[:-1], 4, 4)
        longitude, latitude = texture_coordinates(direction)
        column = (longitude + math.pi) * (height / math.pi) - 0.5
        row = (math.pi / 2 - latitude) * (height / math.pi) - 0.5
        (_, along), (_, across) = _spline(column), _spline(row)
        by_column = ((found * _spline_slope(column)[..., None, :]).sum(-1) * across).sum(-1)
        by_row = ((found * along[..., None, :]).sum(-1) * _spline_slope(row)).sum(-1)
        level = latitude.cos().clamp_min(POLE)
        east = torch.stack([-longitude.sin(), longitude.cos(), torch.zeros_like(level)], dim=1)
        north = torch.stack(
            [-latitude.sin() * longitude.cos(), -latitude.sin() * longitude.sin(), latitude.cos()], dim=1
        )
        slope = (height / math.pi) * ((by_column / level)[:, None] * east - by_row[:, None] * north)
        return (found.flatten(-2) * weight).sum(-1), slope


def look_up(texture: Tensor, direction_body: Tensor) -> Tensor:
    """Return the map's values (...) in directions (..., 3)."""
    place, weight = texel_weights(direction_body, len(texture))
    return (texture.reshape(-1)[place] * weight.to(texture.dtype)).sum(-1)


def map_table(texture: Tensor, blur_rad: float) -> TextureTable:
    """Return the table of a map that is blurred already, value and slope those of its spline.

    Args:
        texture: (H, 2 H).
        blur_rad: standard deviation of the blur that is in it, rad.
    """
    centre = octahedral_directions(SIDE)
    parts = []
    for some in torch.split(centre, CHUNK):
        helper = torch.where(some[:, 2:].abs() < 0.9, some.new_tensor([0.0, 0, 1]), some.new_tensor([1.0, 0, 0]))
        right = torch.nn.functional.normalize(torch.linalg.cross(helper, some), dim=-1)
        slope = torch.zeros_like(some)
        for axis in (right, torch.linalg.cross(some, right)):
            there, back = (look_up(texture.double(), some + sign * STEP_RAD * axis) for sign in (1, -1))
            slope += ((there - back) / (2 * STEP_RAD))[:, None] * axis
        value = look_up(texture.double(), some) - (slope * some).sum(-1)
        parts.append(torch.cat([value[:, None], slope], dim=1).float())
    return TextureTable(torch.cat(parts), blur_rad)


def texel_areas(height: int) -> Tensor:
    """Return the solid angle of every texel, (H, 2 H) float64, sr; their sum is 4 pi."""
    edge = math.pi / 2 - math.pi * torch.arange(height + 1, dtype=torch.float64) / height
    band = (edge[:-1].sin() - edge[1:].sin()) * (math.pi / height)
    return band[:, None].expand(height, 2 * height)


def stiffness(height: int) -> csr_matrix:
    """Return L with m^T L m = the integral of the map's squared slope over the sphere: what ties neighbours.

    Source: finite volumes; the edge between two texels counts with its length over their distance.
    """
    width = 2 * height
    step = math.pi / height
    number = np.arange(height * width).reshape(height, width)
    latitude = math.pi / 2 - step * (np.arange(height) + 0.5)
    along = np.repeat((1 / np.cos(latitude))[:, None], width, 1)  # (length dlat) / (distance dlon cos lat)
    between = np.cos(0.5 * (latitude[1:] + latitude[:-1]))  # (length dlon cos lat) / (distance dlat)
    pairs = [
        (number, np.roll(number, -1, 1), along),
        (number[:-1], number[1:], np.repeat(between[:, None], width, 1)),
    ]
    a, b, w = (np.concatenate([np.ravel(pair[k]) for pair in pairs]) for k in range(3))
    rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
    return coo_matrix((np.concatenate([w, w, -w, -w]), (rows, columns)), shape=(number.size, number.size)).tocsr()


class Gram:
    """The normal matrix of many look-ups, never written out: to multiply it out takes longer than to solve with it.

    Args:
        reads: (S, T), what each sample reads of the map, times the root of its weight.
    """

    def __init__(self, reads: csr_matrix) -> None:
        self._reads = reads

    def __matmul__(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return its product with values (T,)."""
        seen = self._reads @ values.astype(self._reads.dtype)
        return np.asarray(self._reads.T @ seen, np.float64)

    def diagonal(self) -> NDArray[np.float64]:
        """Return the weights of the texels, (T,)."""
        return np.asarray(self._reads.power(2).sum(0), np.float64).ravel()


def map_sums(
    direction_body: Tensor, value: Tensor, weight: Tensor, height: int
) -> tuple[csr_matrix, NDArray[np.float64]]:
    """Sum up what samples of the paint tell of the map: its normal equations, (T, T) and (T,).

    Args:
        direction_body: (S, 3) unit.
        value: (S,), paint seen there.
        weight: (S,), one over its variance.
        height: H of the map.
    """
    place, share = texel_weights(direction_body.double(), height)
    texels = 2 * height * height
    root = weight.double().clamp_min(0).sqrt()
    entries = (share * root[:, None]).reshape(-1).numpy()
    start = np.arange(0, len(entries) + 1, READS)
    reads = csr_matrix((entries, place.reshape(-1).numpy(), start), shape=(len(value), texels))
    return (reads.T @ reads).tocsr(), np.asarray(reads.T @ (root * value.double()).numpy())


def solve_map(
    normal: csr_matrix | Gram, right: NDArray[np.float64], height: int, smooth: float, iterations: int = 60
) -> Tensor:
    """Solve for the map, (H, 2 H) float64: weighted least squares with neighbours tied.

    Args:
        normal: (T, T), of all pixels, or what stands for it.
        right: (T,).
        height: H.
        smooth: weight of the integral of the squared slope, in the unit of the pixels' weights.
        iterations: of the conjugate gradients, at most.
    """
    ties = smooth * stiffness(height)
    diagonal = normal.diagonal() + ties.diagonal()
    diagonal[diagonal <= 0] = 1.0
    x = np.zeros_like(right)
    left = right.copy()
    z = left / diagonal
    p, rz = z.copy(), float(left @ z)
    stop = 1e-12 * rz
    for _ in range(iterations):
        if rz <= stop:
            break
        q = normal @ p + ties @ p
        alpha = rz / float(p @ q)
        x += alpha * p
        left -= alpha * q
        z = left / diagonal
        rz, before = float(left @ z), rz
        p = z + rz / before * p
    return torch.from_numpy(x.reshape(height, 2 * height))
