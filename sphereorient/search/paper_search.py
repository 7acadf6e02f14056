"""The paper's template search: a coarse bank at half size, groups, a fine grid about each at real size."""

import math

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.search.candidates import Candidates
from sphereorient.search.extraction import extract_paint
from sphereorient.search.settings import OrientSettings
from sphereorient.sphere import DirectionTable, DiskView, orthographic_view, reduced_texture
from sphereorient.sphere.view import disk_offsets
from sphereorient.trajectory import Reason

# Disks in one product. Fixed, filled up with empty disks: the last bits of a product depend on its number of rows.
BATCH = 32


class PaperSearch:
    """Searches all of SO(3) for the views of a map that look like a disk (paper sections III B and C).
    The texture (H, W) is 0 black .. 1 white; size_px, the side of the disks, is rounded up to an even number.
    """

    def __init__(self, texture: Tensor, size_px: int, settings: OrientSettings) -> None:
        self._settings = settings
        self._size_px = size_px + size_px % 2
        self._table = DirectionTable(reduced_texture(texture, self._size_px))
        self._fine, self._fine_used = _counted(orthographic_view(self._size_px), settings.disk_share)
        self._coarse, self._coarse_used = _counted(orthographic_view(self._size_px // 2), settings.disk_share)
        self._grid = so3.lattman_grid(math.radians(settings.coarse_step_deg)).float()
        self._bank = self._table.render(self._grid, self._coarse.normal_view[self._coarse_used]).float()
        self._around = so3.local_grid(
            math.radians(settings.fine_step_deg), math.radians(settings.fine_radius_deg)
        ).float()

    @property
    def size_px(self) -> int:
        """Side of the disks, px."""
        return self._size_px

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
        half = torch.nn.functional.avg_pool2d(paint[:, None], 2)[:, 0]
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
        gap = so3.geodesic_distance(R[:, None], R[None])
        first = ~torch.tril(gap < 2 * math.radians(self._settings.fine_step_deg), -1).any(1)
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
