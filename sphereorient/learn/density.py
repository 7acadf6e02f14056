import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.search.candidates import distinct

SEARCHED = 48  # likeliest grid points among which modes are searched
APART_DEG = 25.0  # nearer modes are suppressed by a better one
AROUND_DEG = 22.0  # grid points whose mean is the mode


@dataclass(frozen=True, kw_only=True, eq=False)
class Modes:
    """K candidates for each of F disks, likeliest first; made by `find_modes`."""

    R_view_body: Tensor  # (F, K, 3, 3) float32
    probability: Tensor  # (F, K), sum over the grid points around the mode; 0: no further mode


def find_modes(logits: Tensor, grid: Tensor, count: int, temperature: float = 1.0) -> Modes:
    """Find the `count` (K) likeliest modes of log densities (F, G), each up to a constant, on rotations (G, 3, 3).

    The temperature divides the logits for probabilities and order only; orientations are means of the density as
    learnt.
    """
    flat = grid.flatten(1)
    probability = logits.softmax(-1)
    point = logits.topk(min(SEARCHED, logits.shape[1]), dim=1).indices
    mode = distinct(grid[point], math.radians(APART_DEG))
    order = (~mode).int().argsort(dim=1, stable=True)[:, :count]
    chosen, exists = point.gather(1, order), mode.gather(1, order)
    near = flat[chosen] @ flat.T  # (F, K, G), trace of the relative rotation
    near = near.masked_fill(~exists[..., None], -2.0)
    own = (near == near.amax(1, keepdim=True)) & (near > 1 + 2 * math.cos(math.radians(AROUND_DEG)))
    share = own * probability[:, None]
    weight = (own * (logits / temperature).softmax(-1)[:, None]).sum(-1)
    mean = (share @ flat).reshape(*weight.shape, 3, 3) / share.sum(-1).clamp_min(1e-30)[..., None, None]
    view = torch.eye(3, dtype=grid.dtype, device=grid.device)
    R = so3.nearest_rotation(torch.where(exists[..., None, None], mean, view))
    weight = torch.where(exists, weight, 0.0)
    best = weight.argsort(dim=1, descending=True, stable=True)
    return Modes(R_view_body=R.gather(1, best[..., None, None].expand_as(R)), probability=weight.gather(1, best))


def smoothed_target(R: Tensor, grid: Tensor, spread_rad: float) -> Tensor:
    """Return true orientations (F, 3, 3) as Gaussian densities on the grid, (F, G), each with sum 1."""
    trace = R.flatten(1) @ grid.flatten(1).T
    # 3 - trace is the square of small angles.
    return ((trace - 3) / (2 * spread_rad**2)).softmax(-1)


def first_right(modes: Modes, R: Tensor, within_deg: float) -> Tensor:
    """Return the rank, (F,), 0 the likeliest, of the first mode near the true orientation (F, 3, 3); K: none."""
    trace = (modes.R_view_body * R[:, None]).sum((-2, -1))
    right = (trace > 1 + 2 * math.cos(math.radians(within_deg))) & (modes.probability > 0)
    count = right.shape[1]
    rank: Tensor = torch.where(right, torch.arange(count, device=R.device), count).amin(1)
    return rank
