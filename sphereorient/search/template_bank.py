"""The paper's search: a coarse bank at half size, groups of candidate orientations, a fine grid at full size."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.errors import Reason
from sphereorient.search.candidates import BATCH, Candidates, Proposer, check_disks, distinct
from sphereorient.search.settings import OrientSettings
from sphereorient.sphere import DirectionTable, Sampling, SphereRenderer, orthographic_view
from sphereorient.sphere.texture import known_paint, reduced_texture
from sphereorient.sphere.texture_table import STEPS
from sphereorient.sphere.view import disk_offsets

BINS = 32  # of the histograms; finer ones are empty in the small moving region
# Disks searched at once; fixed, padded with empty disks, as the last bits of Otsu's sums depend on their number.
LOOKED_UP = 4096  # templates of the fine grid at once
SEMIFINALISTS = 8  # of the fine grid, the best eighth by every fourth pixel is compared with all pixels
LEAST_KNOWN = 0.25  # of the compared pixels: an orientation with less known paint is not proposed
FINALISTS = 4  # best of the fine grid by the table, among which the renderer chooses
REAL = Sampling(outside=0.5, supersampling=1)  # with the blur of usual optics; 0 outside, like the paint
HALF = Sampling(outside=0.5, blur_px=0.0, supersampling=1)  # sharp, as blurred templates allow more orientations


def stretch_contrast(disks: Tensor, inside: Tensor, black_share: float, white_share: float) -> Tensor:
    """Stretch and clip disks (..., S, S) so that given shares (the paper's b and w) of `inside` (S, S) are 0 and 1.
    The result is 0.5 outside the disk and in a uniform disk. If one grey level prevents both shares, it spans 0 .. 1.
    Source: paper section III B; docs/errata.md A2 for the cost of the forced shares.
    """
    values = disks[..., inside]
    ordered = values.sort(dim=-1).values
    count = ordered.shape[-1]
    low = ordered[..., min(int(black_share * count), count - 1), None]
    high = ordered[..., max(count - 1 - int(white_share * count), 0), None]
    # One grey level fills more than the unforced share (dots on saturated white): stretch the available range.
    plateau = high <= low
    low, high = torch.where(plateau, ordered[..., :1], low), torch.where(plateau, ordered[..., -1:], high)
    flat = high <= low
    stretched = ((values - low) / torch.where(flat, torch.ones_like(high), high - low)).clamp(0.0, 1.0)
    out = disks.new_full(disks.shape, 0.5)
    out[..., inside] = torch.where(flat, torch.full_like(stretched, 0.5), stretched)
    return out


def otsu(histogram: Tensor) -> tuple[Tensor, Tensor]:
    """Return the threshold (...) of histograms (..., B) of 0 .. 1, and the difference of the classes' means, (...).
    The threshold is the middle of a plateau; the difference is 0 if all values are in one bin.
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
    # Empty bins between the classes give a plateau of equal variance; its middle is the threshold.
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


class TemplateBank(Proposer):
    """Search all of SO(3) for the views of a texture map that resemble a disk in black and white.
    Source: paper sections III B and C; docs/errata.md A2 (T), E5 (grid), E7 (possible orientations).

    Args:
        texture: (H, 2 H), the texture map, 0 black .. 1 white; pixels with unknown paint (NaN) are not compared,
            and orientations with mostly unknown paint not proposed; an `nn.Parameter` gets gradients through `quality`.
        size_px: side of the disks, rounded up to an even number; the templates of the coarse grid have half of it.
        settings: of the search; None: the defaults.
        bank: of another search with the same arguments; None: computed now.
    `grid` (K, 3, 3) float32 are the rotations of the coarse grid, `bank` (K, P) their templates at half size.
    """

    grid: Tensor
    bank: Tensor
    known_share: Tensor  # (K,), share of the compared pixels with known paint

    def __init__(
        self,
        texture: Tensor | NDArray[np.generic],
        size_px: int = 80,
        settings: OrientSettings | None = None,
        bank: Tensor | None = None,
    ) -> None:
        super().__init__()
        texture, hidden = known_paint(texture)
        self._settings = settings = settings or OrientSettings()
        self.size_px = size = size_px + size_px % 2
        self.renderer = SphereRenderer(texture, size_px=size, sampling=REAL)
        self._view = orthographic_view(size)
        self._real, self._half = _compared(size, settings.disk_share), _compared(size // 2, settings.disk_share)
        self._sparse = self._real & (torch.arange(size) % 2 == 0) & (torch.arange(size)[:, None] % 2 == 0)
        self._table = None
        if settings.renderer == "table":
            self._table = DirectionTable(reduced_texture(self.renderer.texture.detach().float(), size))
        around = so3.local_grid(math.radians(settings.fine_step_deg), math.radians(settings.fine_radius_deg))
        self._around = around.float()
        self.register_buffer("grid", so3.lattman_grid(math.radians(settings.coarse_step_deg)).float(), persistent=False)
        if bank is None:
            half = SphereRenderer(self.renderer.texture, size_px=size // 2, sampling=HALF)
            bank = _templates(half, self._half, self.grid)
        self.register_buffer("bank", bank.float(), persistent=False)
        self._known: SphereRenderer | None = None
        if hidden is not None:  # templates are 0 at unknown paint
            self._known = SphereRenderer((~hidden).float(), size_px=size // 2, sampling=HALF)
            self.register_buffer("known_share", self._known_share(self.grid), persistent=False)

    def paint(self, disks: Tensor | NDArray[np.generic]) -> Tensor:
        """Return the paint (..., S, S) of grey disks: -1 black, +1 white, 0 undecided or outside."""
        grey = torch.as_tensor(disks).float()
        flat = grey.reshape(-1, *grey.shape[-2:])
        filled = F.pad(flat, (0, 0, 0, 0, 0, -len(flat) % BATCH))
        batches = torch.split(filled, BATCH) if len(flat) else ()
        parts = [extract_paint(some, self._view.inside, self._settings) for some in batches]
        return torch.cat([flat[:0], *parts])[: len(flat)].reshape(grey.shape)

    def quality(self, paint: Tensor, R_view_body: Tensor) -> Tensor:
        """Return T (...) of paint (..., S, S) at orientations (..., 3, 3): the share of correct pixels; differentiable.
        As the renderer makes the pictures, T has gradients by orientation, paint and the renderer's texture.
        Source: the paper's T = 1/2 + sum of products / (2 pixels compared), docs/errata.md A2.
        """
        template = 2 * self.renderer(R_view_body) - 1
        product = (paint * template)[..., self._real]
        T: Tensor = 0.5 + product.sum(-1) / (2 * product.shape[-1])
        return T if self._known is None else _of_known(T, self._known_share(R_view_body))

    def _known_share(self, R_view_body: Tensor) -> Tensor:
        """Return the share of compared pixels with known paint, (...), at orientations (..., 3, 3)."""
        assert self._known is not None  # only called with unknown paint
        share: Tensor = self._known(R_view_body)[..., self._half].mean(-1)
        return share

    def score(self, paint: Tensor) -> Tensor:
        """Return T (..., K) of paint (..., S, S) at all rotations of the coarse grid, at half size."""
        half = F.avg_pool2d(paint.reshape(-1, 1, *paint.shape[-2:]), 2)[:, 0, self._half]
        T: Tensor = 0.5 + half @ self.bank.T / (2 * STEPS * half.shape[-1])
        T = T if self._known is None else _of_known(T, self.known_share)
        return T.reshape(*paint.shape[:-2], len(self.bank))

    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose the best orientation of each group for disks (F, S, S) float32, whose outlines touch the borders.
        A disk that fits nearly everywhere (`RUNAWAY`) or below `least` (None: `score_min`; `LOW_SCORE`) has no
        proposal.

        Raises:
            ShapeError: the disks are of another size.
        """
        check_disks(disks, self.size_px, self.size_px)
        batches = torch.split(self.paint(disks), BATCH) if len(disks) else ()
        least = self._settings.score_min if least is None else least
        return Candidates.joined([self._proposals(paint, least) for paint in batches])

    def groups(self, T: Tensor) -> Tensor:
        """Return the group (F, K) int64 of each possible orientation by T (F, K), 0 about the best; -1: not possible.
        The best remaining orientation starts a group and takes all nearer than `group_deg`.
        """
        highest = T.max(-1, keepdim=True)
        margin = self._settings.score_margin * (
            1.0 if self._known is None else self.known_share[highest.indices].sqrt()
        )
        left = highest.values - margin < T
        group = torch.full_like(T, -1, dtype=torch.int64)
        flat, near = self.grid.flatten(1), 1 + 2 * math.cos(math.radians(self._settings.group_deg))
        for number in range(self._settings.groups_max + 1):  # one group more than allowed shows a runaway
            if not left.any():
                break
            best = T.masked_fill(~left, -1).argmax(-1)
            member = left & (flat[best] @ flat.T >= near)  # the product is the trace of A^T B
            group[member] = number
            left = left & ~member
        return group

    def _proposals(self, paint: Tensor, least: float) -> Candidates:
        """Return the candidates of some disks, best first."""
        frames, most = len(paint), self._settings.groups_max
        group = self.groups(self.score(paint))
        runaway = group.amax(-1) >= most
        frame, start = torch.nonzero((group >= 0) & ~runaway[:, None], as_tuple=True)
        of_group = frame * most + group[frame, start]
        R, match, origin = self._fine_search(paint, frame, self.grid[start])
        # The table chooses the best few of each group, the renderer the best of these.
        few = best_of_each(of_group[origin], match, FINALISTS)
        R, frame, of_group = R[few], frame[origin[few]], of_group[origin[few]]
        quality = self.quality(paint[frame], R).detach()
        best = best_of_each(of_group, quality, 1)
        T = torch.full((frames, most), -1.0)
        T.view(-1)[of_group[best]] = quality[best]
        views = torch.eye(3).expand(frames, most, 3, 3).clone()
        views.view(-1, 3, 3)[of_group[best]] = R[best]
        order = T.argsort(dim=-1, descending=True, stable=True)
        T, views = T.gather(-1, order), views.gather(1, order[..., None, None].expand_as(views))
        # Two groups may reach one rotation: keep the better of those within two fine steps.
        kept = (least <= T) & distinct(views, 2 * math.radians(self._settings.fine_step_deg))
        states = zip(runaway.tolist(), kept.any(-1).tolist(), strict=True)
        return Candidates(
            offset=F.pad(kept.sum(-1).cumsum(0), (1, 0)),
            R_view_body=so3.nearest_rotation(views[kept].double()),
            score=T[kept].double(),
            reason=tuple(Reason.RUNAWAY if lost else Reason.OK if any_ else Reason.LOW_SCORE for lost, any_ in states),
        )

    def _fine_search(self, paint: Tensor, frame: Tensor, starts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the best rotations (M, 3, 3) of the fine grid about each start, their matches (M,), and starts (M,).
        `paint` is (F, S, S), `frame` (Q,) and `starts` (Q, 3, 3) the possible orientations; a match is a whole number,
        M is `FINALISTS` Q.
        """
        count, around = min(FINALISTS, len(self._around)), len(self._around)
        steps = [(self._sparse, max(count, around // SEMIFINALISTS))] if self._table is not None else []
        R, match = [starts[:0]], [paint.new_zeros(0)]
        batch = max(1, LOOKED_UP // around)
        for of, at in zip(torch.split(frame, batch), torch.split(starts, batch), strict=True):
            near = self._around @ at[:, None]  # (q, A, 3, 3)
            for pixels, keep in [*steps, (self._real, count)]:
                template = self._rendered(near.flatten(0, 1), pixels).reshape(*near.shape[:2], int(pixels.sum()))
                best = _matches(template, paint[of][:, pixels]).topk(keep)
                near = near[torch.arange(len(near))[:, None], best.indices]
            R.append(near.flatten(0, 1))
            match.append(best.values.flatten())
        return torch.cat(R), torch.cat(match), torch.arange(len(starts)).repeat_interleave(count)

    def _rendered(self, R_view_body: Tensor, pixels: Tensor) -> Tensor:
        """Return templates (K, P) at the P pixels (S, S) bool of the full size, whole numbers, from a table int8."""
        if self._table is None:
            return _templates(self.renderer, pixels, R_view_body)
        return self._table.render(R_view_body, self._view.normal_view[pixels[self._view.inside]])


def _matches(template: Tensor, paint: Tensor) -> Tensor:
    """Return the sums of products (Q, A) of templates (Q, A, P) with their paint (Q, P), -1, 0 or 1."""
    if template.dtype is not torch.int8 or not template.is_cpu or not len(paint):
        return (template.float() @ paint[..., None])[..., 0]
    # In whole numbers, products with the paint of all starts take a third of the time.
    every = torch._int_mm(template.flatten(0, 1), paint.to(torch.int8).T.contiguous())
    return every.float().reshape(*template.shape[:2], len(paint)).diagonal(dim1=0, dim2=2).T


def _of_known(T: Tensor, share: Tensor) -> Tensor:
    """Return the T of all pixels that is as likely by chance as T of a share of them, (...): lower for few."""
    return torch.where(share < LEAST_KNOWN, 0.0, 0.5 + (T - 0.5) / share.clamp_min(LEAST_KNOWN).sqrt())


def best_of_each(group: Tensor, value: Tensor, count: int) -> Tensor:
    """Return the indices of the `count` largest values (M,) of each group (M,) int64, by group, largest first."""
    order = value.argsort(descending=True, stable=True)
    order = order[group[order].argsort(stable=True)]
    first = torch.searchsorted(group[order], group[order])
    return order[torch.arange(len(order)) - first < count]


def _compared(size_px: int, disk_share: float) -> Tensor:
    """Return the compared pixels, (S, S) bool: those within a share of the radius."""
    compared: Tensor = disk_offsets(size_px).norm(dim=-1) <= disk_share
    return compared


@torch.no_grad()
def _templates(renderer: SphereRenderer, compared: Tensor, R_view_body: Tensor) -> Tensor:
    """Return templates (K, P), -STEPS black .. STEPS white, of rotations (K, 3, 3)."""
    steps: Tensor = ((2 * renderer(R_view_body)[:, compared] - 1) * STEPS).round()
    return steps
