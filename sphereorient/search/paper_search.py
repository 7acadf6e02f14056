"""The paper's template search: a coarse bank at half size, groups, a fine grid about each at real size.

Before it, from grey disks to paint: -1 black, +1 white, 0 undecided (paper section III B).
"""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.search.candidates import Candidates, check_disks, distinct
from sphereorient.search.settings import OrientSettings
from sphereorient.sphere import DirectionTable, DiskView, orthographic_view, reduced_texture
from sphereorient.sphere.view import disk_offsets
from sphereorient.trajectory import Reason

# Disks in one product. Fixed, filled up with empty disks: the last bits of a product depend on its number of rows.
BATCH = 32
BINS = 32  # of the histograms; finer ones are empty in the small moving region


class PaperSearch:
    """Searches all of SO(3) for the views of a map that look like a disk (paper sections III B and C).
    The texture (H, W) is 0 black .. 1 white; size_px, the side of the disks, is rounded up to an even number.
    """

    def __init__(self, texture: Tensor, size_px: int, settings: OrientSettings) -> None:
        self._settings = settings
        self.size_px = size_px + size_px % 2
        self._table = DirectionTable(reduced_texture(texture, self.size_px))
        self._fine, self._fine_used = _counted(orthographic_view(self.size_px), settings.disk_share)
        self._coarse, self._coarse_used = _counted(orthographic_view(self.size_px // 2), settings.disk_share)
        self._grid = so3.lattman_grid(math.radians(settings.coarse_step_deg)).float()
        self._bank = self._table.render(self._grid, self._coarse.normal_view[self._coarse_used]).float()
        self._around = so3.local_grid(
            math.radians(settings.fine_step_deg), math.radians(settings.fine_radius_deg)
        ).float()

    def propose(self, disks: Tensor) -> Candidates:
        """Propose the best orientation of each group for disks (F, S, S) float32, whose outlines touch the borders.
        A disk that fits nearly everywhere has no proposal (`RUNAWAY`), nor one below `score_min` (`LOW_SCORE`).
        """
        parts: list[Candidates] = []
        for first in range(0, len(disks), BATCH):
            batch = disks[first : first + BATCH]
            filled = torch.cat([batch, batch.new_zeros(BATCH - len(batch), *batch.shape[1:])])
            paint = extract_paint(filled, self._fine.inside, self._settings)
            groups = self._groups(self._coarse_scores(paint))
            parts += [self._fine_search(paint[f], groups[f]) for f in range(len(batch))]
        return Candidates.joined(parts)

    def _coarse_scores(self, paint: Tensor) -> Tensor:
        """Return T of every coarse template, (F, K): 1/2 + sum of products / (2 pixels counted) (docs/errata.md A2)."""
        half = F.avg_pool2d(paint[:, None], 2)[:, 0]
        seen = half[:, self._coarse.inside][:, self._coarse_used]
        return 0.5 + seen @ self._bank.T / (2 * seen.shape[1])

    def _groups(self, score: Tensor) -> list[Tensor]:
        """Return the grid index of the best member of each group, best first, for each disk."""
        possible = score > score.amax(1, keepdim=True) - self._settings.score_margin
        flat = self._grid.flatten(1)
        near = 1 + 2 * math.cos(math.radians(self._settings.group_deg))  # trace of A^T B at that angle
        picks: list[list[Tensor]] = [[] for _ in range(len(score))]
        for _ in range(self._settings.groups_max + 1):
            best = score.masked_fill(~possible, -1).argmax(1)
            left = possible.any(1)
            if not left.any():
                break
            for f in torch.nonzero(left)[:, 0].tolist():
                picks[f].append(best[f])
            possible &= flat[best] @ flat.T < near
        return [torch.stack(pick) if pick else torch.zeros(0, dtype=torch.long) for pick in picks]

    def _fine_search(self, paint: Tensor, group: Tensor) -> Candidates:
        """Refine each group's best on the fine grid; return the proposals of one disk, best first."""
        if len(group) > self._settings.groups_max:
            return Candidates.none([Reason.RUNAWAY])
        seen = paint[self._fine.inside][self._fine_used]
        found = [self._climb(seen, self._grid[g]) for g in group]
        score = torch.stack([score for _, score in found]).double()
        order = score.argsort(descending=True, stable=True)
        order = order[score[order] >= self._settings.score_min]
        R = so3.nearest_rotation(torch.stack([R for R, _ in found]).double()[order])
        # Two groups may reach one rotation: keep the first of those within two fine steps.
        first = distinct(R, 2 * math.radians(self._settings.fine_step_deg))
        return Candidates.of_disk(R[first], score[order][first])

    def _climb(self, seen: Tensor, R_start: Tensor) -> tuple[Tensor, Tensor]:
        """Return the best of the fine grid about a rotation; where it is at the grid's edge, once more about it."""
        normal = self._fine.normal_view[self._fine_used]
        edge = math.radians(self._settings.fine_radius_deg - self._settings.fine_step_deg)
        R, score = R_start, seen.new_zeros(())
        for _ in range(2):
            R_view_body = self._around @ R
            scores = 0.5 + self._table.render(R_view_body, normal).float() @ seen / (2 * len(seen))
            best = int(scores.argmax())
            R, score = R_view_body[best], scores[best]
            if so3.geodesic_distance(R, R_view_body[0]) <= edge:
                break
        return R, score


def _counted(view: DiskView, disk_share: float) -> tuple[DiskView, Tensor]:
    """Return a view and which of its pixels are compared, (P,) bool: those within a share of the radius."""
    radius = disk_offsets(view.size_px).norm(dim=-1)
    return view, (radius <= disk_share)[view.inside]


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
    """Return the threshold between the classes of histograms (..., B) of 0 .. 1, and the difference of their means,
    (...).
    The threshold is the middle of a plateau; the difference is 0 where all values lie in one bin.
    Source: Otsu 1979, eq. (18): the greatest variance between the classes.
    """
    bins = histogram.shape[-1]
    at = (torch.arange(bins, dtype=histogram.dtype, device=histogram.device) + 0.5) / bins
    weight = histogram / histogram.sum(-1, keepdim=True).clamp_min(torch.finfo(histogram.dtype).tiny)
    below = weight.cumsum(-1)[..., :-1]
    sum_below = (weight * at).cumsum(-1)
    mean = sum_below[..., -1:]
    sum_below = sum_below[..., :-1]
    above = 1.0 - below
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
    Source: paper section III B.

    Raises:
        ShapeError: disks and mask differ in size.
    """
    check_disks(disks, *inside.shape)
    grey = stretch_contrast(disks, inside, settings.black_share, settings.white_share)
    one_hot = _one_hot(grey, inside)
    threshold, _ = otsu(one_hot.sum((-2, -1)))
    vote = torch.where(grey > threshold[:, None, None], 1.0, -1.0)
    for share in settings.regions:
        local = _moving_threshold(one_hot, threshold, share, settings.region_contrast_min)
        agree = vote * torch.where(grey > local, 1.0, -1.0)
        vote = torch.where(agree > 0, vote, torch.zeros_like(vote))
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
    histogram = F.avg_pool2d(one_hot, side, stride, padding=side // 2, count_include_pad=True)
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
