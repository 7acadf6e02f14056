"""What pixels and optics make of a finely sampled picture: exact weights, one matrix for rows and columns alike."""

from __future__ import annotations

import torch
from torch import Tensor


def fine_places(size_px: int, supersampling: int) -> Tensor:
    """Return the middles of the fine samples along one axis of a picture, (size supersampling,) float64, px.

    Whole numbers are pixel centres: the first pixel spans -0.5 .. 0.5.
    """
    return (torch.arange(size_px * supersampling, dtype=torch.float64) + 0.5) / supersampling - 0.5


def aperture_matrix(size_px: int, supersampling: int, sigma_px: float) -> Tensor:
    """Return the weights of the fine samples in each pixel, (S, S supersampling) float64; picture = A fine A^T.

    Args:
        size_px: S, side of the picture, px.
        supersampling: fine samples per pixel and axis.
        sigma_px: standard deviation of the optics' Gaussian, px; 0 leaves the pixel's own square.

    Returns:
        Rows that sum to 1, but for those near the border, whose aperture reaches beyond the picture.

    Source: a box of one pixel convolved with a Gaussian is the difference of two normal distribution functions.
    """
    at = fine_places(size_px, supersampling)
    offset = at - torch.arange(size_px, dtype=torch.float64)[:, None]
    if sigma_px > 0:
        ndtr = torch.special.ndtr
        weight = ndtr((offset + 0.5) / sigma_px) - ndtr((offset - 0.5) / sigma_px)
    else:
        weight = (offset.abs() < 0.5).double()
    rows: Tensor = weight / supersampling
    return rows
