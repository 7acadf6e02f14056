"""The grey search: normalised views over all rotations, distinct peaks, a coarse-to-fine fit from each."""

import math
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.search.candidates import BATCH, Candidates, Proposer, check_disks, distinct
from sphereorient.search.normalisation import LocalNormalisation
from sphereorient.search.refine_rotation import detail_level, refine_rotation
from sphereorient.search.settings import GreySearchSettings
from sphereorient.sphere import orthographic_view, perspective_view
from sphereorient.sphere.texture_table import texture_table

# Disks normalised at once; fixed, padded with empty disks, as the last bits of sums depend on their number.
PRODUCT = 128  # most disks in one product, so that the scores stay in the cache
GROUP = 8  # neighbouring templates, represented by their best one
LOOKED_AT = 32  # best groups searched for peaks, as a broad peak spans several
TABLE_SIDE = 192  # cells of the paint table: 1 degree, below half of the finest detail
DEVIATIONS = 4.0  # value of a pixel, in root mean squares of its picture, mapped to 127


class GreySearch(Proposer):
    """Searches all of SO(3) on the CPU for the views of a texture map that resemble a disk, under any smooth light.
    Detail finer than `detail` is removed, so that the nearest template of the Lattman grid still correlates.

    Args:
        texture: (H, 2 H), the texture map, 0 black .. 1 white.
        settings: of the search; None: the defaults.
        blur: standard deviation of the pictures' own blur, radii, unless far below `detail`.
        bank: (K, P) int8, of another search with the same arguments; None: computed when needed.
    `size_px` is the side of the disks, `templates` (K, 3, 3) float32 are the rotations of the `bank`.
    """

    def __init__(
        self,
        texture: Tensor | NDArray[np.generic],
        settings: GreySearchSettings | None = None,
        blur: float = 0.0,
        bank: Tensor | None = None,
    ) -> None:
        super().__init__()
        self._settings = settings = settings or GreySearchSettings()
        self.size_px, distance = settings.size_px, settings.distance_radii
        size, pixel_rad = self.size_px, 2.0 / self.size_px
        self._view = orthographic_view(size) if distance is None else perspective_view(size, distance)
        self._normalise = LocalNormalisation(size, detail=settings.detail, window=settings.window, clip=settings.clip)
        finest = max(blur, min(pixel_rad, settings.detail))
        self._paint = texture_table(torch.as_tensor(texture), finest, TABLE_SIDE)
        self._rough = detail_level(self._view, self._paint, settings.detail, every=2, blur=blur)
        self._fine = detail_level(self._view, self._paint, pixel_rad, every=1, blur=blur)
        grid = so3.lattman_grid(math.radians(settings.step_deg)).float()
        # (GROUP, G): each group is a column, so that maxima are taken over whole rows.
        self._grid = grid[compact_groups(grid, GROUP).T]
        self.templates = self._grid.flatten(0, 1)
        self._pixels = int(self._view.inside.sum())
        if bank is not None:
            vars(self)["bank"] = bank

    @cached_property
    def bank(self) -> Tensor:
        """Normalised views of all rotations, (K, P) int8."""
        normal, views = self._view.normal_view.T.contiguous(), torch.split(self.templates, BATCH)
        pictures = (self._view.picture(self._paint.sample(R.mT @ normal)[0]) for R in views)
        return torch.cat([to_int8(self._normalise(some)) for some in pictures])

    def score(self, disks: Tensor | NDArray[np.generic]) -> Tensor:
        """Return the correlation of disks (..., S, S) with all `templates`, (..., K) float32, -1 .. 1."""
        grey = torch.as_tensor(disks).float()
        steps = self._normalised(grey.reshape(-1, *grey.shape[-2:]))
        scale = 127.0 / DEVIATIONS * math.sqrt(self._pixels)
        return (torch._int_mm(steps, self.bank.T) / scale**2).reshape(*grey.shape[:-2], -1)

    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose the best orientations of disks (F, S, S) float32, at least `distinct_deg` apart, best first.
        The outline touches the borders. The score, 0 .. 1, is the share of the disk's deviation from smooth light that
        the paint explains. A disk below `least` (None: `score_min`) has no proposal (`LOW_SCORE`). Raises ShapeError
        (the disks are of another size).
        """
        check_disks(disks, self.size_px, self.size_px)
        found = ((some, *self.search(some)) for some in torch.split(disks, PRODUCT))
        each = (one for some in found for one in zip(*some, strict=True))
        most, least = self._settings.peaks, self._settings.score_min if least is None else least
        rows = (self._refined(disk, self.templates[at[peak][:most]], least) for disk, at, peak in each)
        return Candidates.joined(list(rows))

    def rough(self, disks: Tensor) -> Candidates:
        """Return the bank's peaks (F disks), best first; the score is 0, as it is not computed."""
        check_disks(disks, self.size_px, self.size_px)
        R = self.templates[self._best(to_int8(self._normalise(disks)))]  # few disks: not padded
        peak = distinct(R, math.radians(self._settings.peak_deg))
        rows = (own[there][: self._settings.peaks].double() for own, there in zip(R, peak, strict=True))
        return Candidates.joined([Candidates.of_disk(own, own.new_zeros(len(own))) for own in rows])

    def likeness(self, disks: Tensor) -> Tensor:
        """Return the correlation of disks (F, S, S) with the most similar template of each, (F,)."""
        return self.score(disks).amax(-1)

    def search(self, disks: Tensor) -> tuple[Tensor, Tensor]:
        """Return the best templates of the best groups (F, M), best first, and which are peaks, (F, M) bool."""
        place = self._best(self._normalised(disks))
        apart = math.radians(self._settings.peak_deg)
        looked_at = self.templates[F.pad(place, (0, 0, 0, -len(disks) % BATCH))]
        peak = torch.cat([distinct(R, apart) for R in torch.split(looked_at, BATCH)])[: len(disks)]
        return place, peak

    def _best(self, steps: Tensor) -> Tensor:
        """Return the best templates of the best groups (F, M) for normalised disks (F, P) int8, best first."""
        scores = torch._int_mm(steps, self.bank.T)
        return best_of_groups(scores.reshape(-1, *self._grid.shape[:2]), LOOKED_AT)

    def _normalised(self, disks: Tensor) -> Tensor:
        filled = F.pad(disks, (0, 0, 0, 0, 0, -len(disks) % BATCH))
        return torch.cat([to_int8(self._normalise(batch)) for batch in torch.split(filled, BATCH)])[: len(disks)]

    def _refined(self, disk: Tensor, starts: Tensor, least: float) -> Candidates:
        """Refine the peaks of one disk; return its proposals, best first."""
        settings = self._settings
        R, score = refine_rotation(self._rough, disk, starts, settings.rough_steps)
        R = R[self._distinct(R, score)[: settings.finalists]]
        R, score = refine_rotation(self._fine, disk, R, settings.fine_steps)
        chosen = self._distinct(R, score)
        chosen = chosen[score[chosen] >= least]
        return Candidates.of_disk(so3.nearest_rotation(R[chosen].double()), score[chosen].double())

    def _distinct(self, R: Tensor, score: Tensor) -> Tensor:
        order = score.argsort(descending=True, stable=True)
        return order[distinct(R[order], math.radians(self._settings.distinct_deg))]


def to_int8(even: Tensor) -> Tensor:
    """Quantise normalised pictures to -127 .. 127, (B, P) int8, padded to a multiple of 8 pixels."""
    scale = 127.0 / DEVIATIONS * math.sqrt(even.shape[1])
    # One scale for all templates: as all have length 1, integer products rank them correctly.
    return F.pad((even * scale).round().clamp(-127, 127), (0, -even.shape[1] % 8)).to(torch.int8)


def compact_groups(R: Tensor, size: int) -> Tensor:
    """Divide rotations (K, 3, 3) into groups of neighbours, (G, size) int64; some are repeated unless size divides K.
    Source: halving along the matrix component that varies most (Bentley 1975).
    """
    flat = R.flatten(1)
    groups = math.ceil(len(R) / size)
    index = torch.arange(groups * size) % len(R)

    def halved(members: Tensor) -> list[Tensor]:
        if len(members) <= size:
            return [members]
        at = flat[members]
        order = members[at[:, int(at.var(0).argmax())].argsort(stable=True)]
        middle = len(members) // size // 2 * size
        return [*halved(order[:middle]), *halved(order[middle:])]

    return torch.stack(halved(index))


def best_of_groups(scores: Tensor, count: int) -> Tensor:
    """Return the best members of the `count` best groups, (F, count) int64, best first, from scores (F, M, G).
    Indices are into the flattened members and groups; all groups if there are fewer.
    """
    groups = scores.shape[2]
    group = scores.amax(1).topk(min(count, groups), dim=1).indices
    members = scores.gather(2, group[:, None].expand(-1, scores.shape[1], -1))
    return members.argmax(1) * groups + group
