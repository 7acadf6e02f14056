"""Steps with candidates, one after the other: what a path visits, without its holes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Visits:
    """The M steps that a movie visits at most; made by `visits_of`, read by trellis, soft_path and the second order.

    A movie that visits fewer waits behind its end in place 0, at no cost: the recursion needs no other case.
    """

    step: Tensor  # (..., M) int64, of the N steps; behind the end any
    real: Tensor  # (..., M) bool, False behind the end
    mask: Tensor  # (..., M, C) bool, candidates; behind the end place 0 alone
    rank: Tensor  # (..., N) int64, which of the M is the last one visited up to each step, 0 before the first
    visited: Tensor  # (..., N) bool
    whole: bool  # there is no hole in any movie

    def rows(self, part: Tensor, back: int = 0, first: int = 0) -> Tensor:
        """Return (..., M - first, *tail): rows of a part (..., N - back, *tail) that belong to the steps visited.

        Args:
            part: row k belongs to step k + back.
            back: as said.
            first: leave out this many of the steps visited.
        """
        if self.whole and back == first:
            return part
        index = (self.step[..., first:] - back).clamp_min(0)
        axis = self.step.ndim - 1
        tail = part.shape[axis + 1 :]
        return part.gather(axis, index[(..., *[None] * len(tail))].expand(*index.shape, *tail))

    def spread(self, part: Tensor) -> Tensor:
        """Return (..., N, *tail) of a part (..., M, *tail), 0 in the steps that are not visited."""
        if self.whole:
            return part
        axis = self.step.ndim - 1
        tail = part.shape[axis + 1 :]
        shape = (..., *[None] * len(tail))
        held = part.gather(axis, self.rank[shape].expand(*self.rank.shape, *tail))
        return torch.where(self.visited[shape], held, 0)


def visits_of(mask: Tensor) -> Visits:
    """Return which steps each movie visits.

    Args:
        mask: (..., N, C) bool, True where there is a candidate; N and C at least 1.
    """
    visited = mask.any(-1)
    count = visited.sum(-1)
    most = max(int(count.max()), 1) if count.numel() else mask.shape[-2]
    step = torch.argsort(visited.logical_not().to(torch.uint8), dim=-1, stable=True)[..., :most]
    real = torch.arange(most, device=mask.device) < count[..., None]
    waiting = torch.arange(mask.shape[-1], device=mask.device) == 0
    here = mask.gather(-2, step[..., None].expand(*step.shape, mask.shape[-1]))
    return Visits(
        step=step,
        real=real,
        mask=torch.where(real[..., None], here, waiting),
        rank=(visited.cumsum(-1) - 1).clamp_min(0),
        visited=visited,
        whole=bool(visited.all()),
    )
