"""The texture map as unknowns of a linear system: splines, smoothness penalty, solution, sharpening."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from torch import Tensor

from sphereorient.sphere.texture import map_directions, spline_weights, texel_coordinates, texture_coordinates
from sphereorient.sphere.texture_table import CHUNK, SIDE, SQUARE_25, TextureTable, octahedral_directions, tangents

POLE = 1e-3  # least cosine of a latitude: at the pole itself longitude is undefined
READS = 16  # texels per look-up
WIDER = 4.0  # times the map's blur: scale at which edges are counted
SLOPES, ROUGH_SIDE = 64, 128  # cells per axis: of the directions in which their slope is averaged, of the table
FEWEST_EDGES = 0.01  # rad/sr
Array = NDArray[Any]


def _spline_slope(place: Tensor) -> Tensor:
    t = place - place.floor()
    s = 1 - t
    return torch.stack([-s * s, t * (3 * t - 4), s * (4 - 3 * s), t * t], dim=-1) / 2


def texel_weights(direction_body: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Return indices (..., 16) int64 in the flat map (H, 2 H), H >= 4, and B-spline weights (..., 16), sum 1."""
    width = 2 * height
    (column, along), (row, across) = (spline_weights(at) for at in texel_coordinates(direction_body, height))
    columns, rows = column[..., None] + torch.arange(4), row[..., None] + torch.arange(4)
    beyond = (rows < 0) | (rows >= height)  # beyond a pole the meridian continues on the other side
    rows = torch.where(rows < 0, -1 - rows, torch.where(rows >= height, 2 * height - 1 - rows, rows))
    columns = (columns[..., None, :] + torch.where(beyond, height, 0)[..., None]) % width
    place = rows[..., None] * width + columns
    return place.flatten(-2), (across[..., None] * along[..., None, :]).flatten(-2)


class SplineTable(TextureTable):
    """A texture map (H, 2 H) with the blur `blur_rad`, sampled by its spline exactly; records the texels read."""

    def __init__(self, texture: Tensor, blur_rad: float) -> None:
        super().__init__(torch.zeros(1, 4), blur_rad)
        self.texture = texture
        self.reads: list[tuple[Tensor, Tensor]] = []  # per look-up: texels and weights, (L, P, 16)

    def sample(self, direction_body: Tensor) -> tuple[Tensor, Tensor]:
        """Return value and slope; see `TextureTable.sample`."""
        height = len(self.texture)
        direction = direction_body.movedim(1, -1)
        place, weight = texel_weights(direction, height)
        self.reads.append((place, weight))
        found = self.texture.to(direction.dtype).reshape(-1)[place].reshape(*place.shape[:-1], 4, 4)
        longitude, latitude = texture_coordinates(direction)
        column, row = texel_coordinates(direction, height)
        (_, along), (_, across) = spline_weights(column), spline_weights(row)
        by_column = ((found * _spline_slope(column)[..., None, :]).sum(-1) * across).sum(-1)
        by_row = ((found * along[..., None, :]).sum(-1) * _spline_slope(row)).sum(-1)
        level = latitude.cos().clamp_min(POLE)
        east = torch.stack([-longitude.sin(), longitude.cos(), torch.zeros_like(level)], dim=1)
        south = -latitude.sin()
        north = torch.stack([south * longitude.cos(), south * longitude.sin(), latitude.cos()], dim=1)
        slope = (height / math.pi) * ((by_column / level)[:, None] * east - by_row[:, None] * north)
        return (found.flatten(-2) * weight).sum(-1), slope


def look_up(texture: Tensor, direction_body: Tensor) -> Tensor:
    """Return the map's values (...) in directions (..., 3)."""
    place, weight = texel_weights(direction_body, len(texture))
    return (texture.reshape(-1)[place] * weight.to(texture.dtype)).sum(-1)


def map_table(texture: Tensor, blur_rad: float, side: int = SIDE) -> TextureTable:
    """Return the table of a map (H, 2 H) that already has the blur `blur_rad`, rad."""
    parts = []
    for some in torch.split(octahedral_directions(side).float(), CHUNK):
        value, slope = SplineTable(texture, blur_rad).sample(some.T[None])
        level = value - (slope * some.T).sum(1)  # of the tangent plane, where directions are 0
        parts.append(torch.cat([level, slope[0]]).T.contiguous())
    return TextureTable(torch.cat(parts), blur_rad)


def stiffness(height: int) -> csr_matrix:
    """Return L, m^T L m being the integral of the map's squared slope over the sphere (finite volumes)."""
    width = 2 * height
    step = math.pi / height
    number = np.arange(height * width).reshape(height, width)
    latitude = math.pi / 2 - step * (np.arange(height) + 0.5)
    along = np.repeat((1 / np.cos(latitude))[:, None], width, 1)  # (length dlat) / (distance dlon cos lat)
    between = np.cos(0.5 * (latitude[1:] + latitude[:-1]))  # (length dlon cos lat) / (distance dlat)
    upwards = number[:-1], number[1:], np.repeat(between[:, None], width, 1)
    pairs = zip((number, np.roll(number, -1, 1), along), upwards, strict=True)
    a, b, w = (np.concatenate([part.ravel() for part in both]) for both in pairs)
    rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
    return coo_matrix((np.concatenate([w, w, -w, -w]), (rows, columns)), shape=(number.size, number.size)).tocsr()


class NormalMatrix:
    """J^T J of a weighted Jacobian (S, T), not formed: that would take longer than the solution."""

    def __init__(self, jacobian: csr_matrix) -> None:
        self._jacobian = jacobian
        self._back = jacobian.T.tocsr()  # reading its rows in order halves the time

    def __matmul__(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = self._jacobian @ values.astype(self._jacobian.dtype)
        return np.asarray(self._back @ seen, np.float64)

    def diagonal(self) -> NDArray[np.float64]:
        """Return the weights of the texels, (T,)."""
        return texel_sums(self._jacobian)


def texel_sums(jacobian: csr_matrix) -> NDArray[np.float64]:
    """Return the diagonal of J^T J, (T,): the information on each texel; no sample reads a texel twice."""
    squares = jacobian.data.astype(np.float64) ** 2
    return np.asarray(np.bincount(jacobian.indices, squares, minlength=jacobian.shape[1]), np.float64)


def map_sums(
    direction_body: Tensor, value: Tensor, weight: Tensor, height: int
) -> tuple[csr_matrix, NDArray[np.float64]]:
    """Return a map's normal equations (T, T), (T,) from samples: directions (S, 3), values and weights (S,)."""
    root = weight.double().clamp_min(0).sqrt()
    reads = _reading(direction_body.double(), root[:, None], height)
    return (reads.T @ reads).tocsr(), np.asarray(reads.T @ (root * value.double()).numpy())


def _reading(direction_body: Tensor, factor: Tensor | float, height: int) -> csr_matrix:
    """Return the matrix (M, T) from a map's coefficients to its values in directions (M, 3), times a factor (M, 1)."""
    place, weight = texel_weights(direction_body, height)
    start = np.arange(0, place.numel() + 1, READS)
    entries = (weight * factor).reshape(-1).numpy(), place.reshape(-1).numpy(), start
    return csr_matrix(entries, shape=(len(place), 2 * height * height))


def solve_map(
    normal: csr_matrix | NormalMatrix, right: NDArray[np.float64], height: int, smooth: float, iterations: int = 60
) -> Tensor:
    """Solve normal equations (T, T), (T,) for the map (H, 2 H) float64; `smooth` weighs its squared slope."""
    ties = smooth * stiffness(height)
    diagonal = normal.diagonal() + ties.diagonal()
    diagonal[diagonal <= 0] = 1.0
    x = conjugate_gradients(lambda p: normal @ p + ties @ p, lambda left: left / diagonal, right, 1e-12, iterations)
    return torch.from_numpy(x.reshape(height, 2 * height))


def dot(a: Array, b: Array) -> float:
    """Return the dot product of (T,) and (T,) in float64, without BLAS, which would wait for busy cores."""
    return float(np.einsum("i,i", a, b, dtype=np.float64))


def conjugate_gradients(
    apply: Callable[[Array], Array],
    precondition: Callable[[Array], Array],
    right: Array,
    least: float,
    iterations: int,
) -> Array:
    """Solve apply(x) = right (T,) for x until the weighted square of the residual is `least` of the first one."""
    x, left = np.zeros_like(right), right
    p = z = precondition(left)
    rz = first = dot(left, z)
    for _ in range(iterations):
        if rz <= least * first:
            break
        q = apply(p)
        alpha = rz / dot(p, q)
        x, left = x + alpha * p, left - alpha * q
        z = precondition(left)
        rz, before = dot(left, z), rz
        p = z + rz / before * p
    return x


def blur_matrix(direction_body: Tensor, blur_rad: float, height: int) -> csr_matrix:
    """Return the matrix (M, T) from a map's coefficients to its blurred values in directions (M, 3) float64."""
    right, up = tangents(direction_body)
    total = csr_matrix((len(direction_body), 2 * height * height))
    for a, b, share in SQUARE_25:
        total = total + _reading(direction_body + blur_rad * (a * right + b * up), share, height)
    return total


def paint_tie(texture: Tensor, blur_rad: float) -> float:
    """Return the weight of the integral of the paint's squared slope against chi^2, from a map of known blur.
    Paint with edges of length e per sr has the power 2 e / k^3; e is measured in a further blurred map with little
    noise. The weight is optimal for detail of the size of the blur (Wiener 1949).
    """
    wide = WIDER * blur_rad
    direction = octahedral_directions(SLOPES).float().T[None]
    power = map_table(texture, blur_rad, ROUGH_SIDE).blurred(wide).sample(direction)[1].square().sum(1).mean()
    edges = 2 * math.sqrt(math.pi) * wide * float(power)
    return 1 / (2 * max(edges, FEWEST_EDGES) * blur_rad)


def coefficients_blur_rad(blur_rad: float, height: int) -> float:
    """Return the blur of the coefficients of a map of known blur: the spline adds a third of a squared texel."""
    return math.sqrt(max(blur_rad**2 - (math.pi / height) ** 2 / 3, (0.1 * blur_rad) ** 2))


def sharpened(normal: NormalMatrix, right: Array, blur_rad: float, tie: float, expected: Tensor) -> Tensor:
    """Return the paint (H, 2 H) float64 that, blurred, solves the normal equations (T, T), (T,) of the blurred map;
    `tie` weighs the squared slope of its difference from an expected map (H, 2 H). Source: Tikhonov 1963.
    """
    height = len(expected)
    blur = blur_matrix(map_directions(height).reshape(-1, 3), coefficients_blur_rad(blur_rad, height), height)
    back, known, ties = blur.T.tocsr(), expected.double().numpy().ravel(), tie * stiffness(height)
    diagonal = blur.multiply(blur).T @ normal.diagonal() + ties.diagonal()

    def apply(p: Array) -> Array:
        pulled: Array = back @ (normal @ (blur @ p)) + ties @ p
        return pulled

    left = back @ (right - normal @ (blur @ known))
    change = conjugate_gradients(apply, lambda p: p / diagonal, left, 1e-12, 200)
    return torch.from_numpy((known + change).reshape(height, 2 * height))
