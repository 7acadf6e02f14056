"""From grey disks to paint: -1 black, +1 white, 0 undecided (paper section III B)."""

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient.search.candidates import check_disks
from sphereorient.search.settings import OrientSettings

BINS = 32  # of the histograms; finer ones are empty in the small moving region


def stretch_contrast(disks: Tensor, inside: Tensor, black_share: float, white_share: float) -> Tensor:
    """Stretch and clip disks (..., S, S) so that given shares (the paper's b and w) of `inside` (S, S) are 0 and 1.
    The result is 0.5 outside the disk and in a disk of one grey. Where one grey prevents both shares, it spans 0 .. 1.
    Source: paper section III B; docs/errata.md A2 for what the forced shares cost.
    """
    values = disks[..., inside]
    ordered = values.sort(dim=-1).values
    count = ordered.shape[-1]
    low = ordered[..., min(int(black_share * count), count - 1), None]
    high = ordered[..., max(count - 1 - int(white_share * count), 0), None]
    # More than all but the forced shares of one grey (dots on saturated white): stretch over what there is.
    plateau = high <= low
    low, high = torch.where(plateau, ordered[..., :1], low), torch.where(plateau, ordered[..., -1:], high)
    flat = high <= low
    stretched = ((values - low) / torch.where(flat, torch.ones_like(high), high - low)).clamp(0.0, 1.0)
    out = disks.new_full(disks.shape, 0.5)
    out[..., inside] = torch.where(flat, torch.full_like(stretched, 0.5), stretched)
    return out


def otsu(histogram: Tensor) -> tuple[Tensor, Tensor]:
    """Return the threshold (...) of histograms (..., B) of 0 .. 1, and the difference of the classes' means, (...).
    The threshold is the middle of a plateau; the difference is 0 where all values lie in one bin.
    Source: Otsu 1979, eq. (18): the greatest variance between the classes.
    """
    bins = histogram.shape[-1]
    at = (torch.arange(bins, dtype=histogram.dtype, device=histogram.device) + 0.5) / bins
    weight = histogram / histogram.sum(-1, keepdim=True).clamp_min(torch.finfo(histogram.dtype).tiny)
    below = weight.cumsum(-1)[..., :-1]
    sums = (weight * at).cumsum(-1)
    sum_below, mean, above = sums[..., :-1], sums[..., -1:], 1.0 - below
    mixed = (below > 1e-6) & (above > 1e-6)
    safe_below, safe_above = torch.where(mixed, below, 1.0), torch.where(mixed, above, 1.0)
    step = torch.where(mixed, (mean - sum_below) / safe_above - sum_below / safe_below, 0.0)
    between = below * above * step.square()
    best = between.amax(-1, keepdim=True)
    # Empty bins between the classes make a plateau of equal variance; its middle is the fair threshold.
    edge = torch.arange(1, bins, dtype=histogram.dtype, device=histogram.device) / bins
    plateau = (between >= best * (1 - 1e-4)).to(histogram.dtype)
    threshold = (plateau * edge).sum(-1) / plateau.sum(-1)
    contrast = step.gather(-1, between.argmax(-1, keepdim=True))[..., 0]
    return threshold, contrast


def extract_paint(disks: Tensor, inside: Tensor, settings: OrientSettings) -> Tensor:
    """Return the paint of grey disks (F, S, S) float32 in the mask (S, S): -1 black, +1 white, 0 undecided or outside.
    Otsu's thresholds of the whole disk and of two moving square regions must agree.
    Raises ShapeError (disks and mask differ in size).
    Source: paper section III B.
    """
    check_disks(disks, *inside.shape)
    grey = stretch_contrast(disks, inside, settings.black_share, settings.white_share)
    one_hot = _one_hot(grey, inside)
    threshold, _ = otsu(one_hot.sum((-2, -1)))
    vote = torch.where(grey > threshold[:, None, None], 1.0, -1.0)
    for share in settings.regions:
        local = _moving_threshold(one_hot, threshold, share, settings.region_contrast_min)
        vote = torch.where(vote * torch.where(grey > local, 1.0, -1.0) > 0, vote, 0.0)
    return vote * inside


def _one_hot(grey: Tensor, inside: Tensor) -> Tensor:
    """Return the membership of each pixel in the histogram's bins, (F, B, S, S); 0 outside the disk."""
    bin_of = (grey * BINS).long().clamp(0, BINS - 1)
    member = grey.new_zeros(grey.shape[0], BINS, *grey.shape[1:])
    return member.scatter_(1, bin_of[:, None], 1.0) * inside


def _moving_threshold(one_hot: Tensor, fallback: Tensor, share: float, contrast_min: float) -> Tensor:
    """Return Otsu's threshold of a square region about each pixel, (F, S, S), interpolated from a lattice."""
    size = one_hot.shape[-1]
    side = max(3, round(share * size) | 1)
    stride = max(1, side // 4)
    # One axis after the other; sums of ones are exact.
    columns = F.avg_pool2d(one_hot, (side, 1), (stride, 1), padding=(side // 2, 0), divisor_override=1)
    histogram = F.avg_pool2d(columns, (1, side), (1, stride), padding=(0, side // 2), divisor_override=1)
    threshold, contrast = otsu(histogram.movedim(1, -1))
    threshold = torch.where(contrast > contrast_min, threshold, fallback[:, None, None])
    # Node i of the lattice lies at pixel i * stride; the nodes span 0 .. (n - 1) * stride.
    nodes = threshold.shape[-1]
    at = (torch.arange(size, dtype=threshold.dtype, device=threshold.device) / stride).clamp(0, nodes - 1)
    low = at.floor().long().clamp(max=max(nodes - 2, 0))
    share_up = (at - low).to(threshold.dtype)
    high = (low + 1).clamp(max=nodes - 1)
    rows = threshold[:, low] * (1 - share_up)[:, None] + threshold[:, high] * share_up[:, None]
    return rows[..., low] * (1 - share_up) + rows[..., high] * share_up
