"""The map looked up smoothly: two continuous derivatives, which implicit differentiation of a fit asks for."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.sphere.texture import texture_coordinates

AROUND = 2  # texels beyond the map's edges that a spline reaches


def sample_spline(texture: Tensor, direction_body: Tensor) -> Tensor:
    """Look up the paint at body directions by a cubic B-spline whose coefficients are the texels.

    `sample_texture` has kinks at the texels' middles, where a fit's gradient jumps, and torch has no forward derivative
    of its look-up. This is smooth everywhere but at the very poles; the price is a blur of 0.58 texels (sqrt(1/3),
    standard deviation along rows and columns) where bilinear blurs by 0.41.

    Args:
        texture: (H, W), W = 2 H, H at least 2, dtype and device of the directions; differentiable.
        direction_body: (..., 3), body frame, any length but zero; differentiable, twice.

    Returns:
        (...), the map's grey at each direction.

    Raises:
        ShapeError: a map that is not (H, 2 H), or directions that do not end in 3.

    Source: docs/conventions.md (texture map); Unser 1999, Splines, a perfect fit, eq. 3.
    """
    check_tail("direction_body", direction_body, 3)
    if texture.ndim != 2 or texture.shape[1] != 2 * texture.shape[0] or len(texture) < AROUND:
        expected = f"(H, 2 H), H at least {AROUND}"
        raise ShapeError(refusal("texture", expected=expected, got=str(tuple(texture.shape)), do="pass one map"))
    height, width = texture.shape
    longitude, latitude = texture_coordinates(direction_body)
    column = (longitude + math.pi) * (width / (2 * math.pi)) - 0.5
    row = (math.pi / 2 - latitude) * (height / math.pi) - 0.5
    closed = _closed(texture)
    first_column, columns = _spline_weights(column)
    first_row, rows = _spline_weights(row)
    # The rounding of a longitude of pi may step one column over the edge.
    first_column = first_column.clamp(-AROUND, width + AROUND - 4) + AROUND
    first_row = first_row.clamp(-AROUND, height + AROUND - 4) + AROUND
    steps = torch.arange(4, device=texture.device)
    at = (first_row[..., None, None] + steps[:, None]) * closed.shape[1] + first_column[..., None, None] + steps
    texels = closed.reshape(-1)[at]  # (..., 4, 4)
    return ((texels * columns[..., None, :]).sum(-1) * rows).sum(-1)


def _closed(texture: Tensor) -> Tensor:
    """Continue the map beyond its edges: over a pole along the meridian at the other side, over the date line."""
    beyond = texture.roll(texture.shape[1] // 2, 1)
    tall = torch.cat([beyond[:AROUND].flip(0), texture, beyond[-AROUND:].flip(0)])
    return torch.cat([tall[:, -AROUND:], tall, tall[:, :AROUND]], dim=1)


def _spline_weights(place: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first of the four texels about places (...) in texels, int64, and their weights (..., 4), sum 1."""
    below = place.detach().floor()
    t = place - below
    s = 1.0 - t
    weights = [s**3, 4.0 - 3.0 * t * t * (1.0 + s), 4.0 - 3.0 * s * s * (1.0 + t), t**3]
    return below.long() - 1, torch.stack(weights, dim=-1) / 6.0
