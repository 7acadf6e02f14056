import math

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient.search.candidates import Candidates, Proposer
from sphereorient.search.peaks import distinct
from sphereorient.trajectory import Reason

SAME_DEG = 12.0  # proposals of the two nearer than this are one


class FallbackProposer:
    """Asks one proposer, and a second one where no score reaches `sure`; the second's answers come first there."""

    def __init__(self, first: Proposer, second: Proposer, sure: float) -> None:
        self._first, self._second, self._sure = first, second, sure

    @property
    def size_px(self) -> int:
        """Side of the disks, px."""
        return self._first.size_px

    def propose(self, disks: Tensor) -> Candidates:
        """Propose orientations for (F, S, S) float32 grey disks."""
        found = self._first.propose(disks)
        best = torch.zeros(len(disks), dtype=torch.float64)
        some = found.offset.diff() > 0
        best[some] = found.score[found.offset[:-1][some]]
        doubt = torch.nonzero(best < self._sure)[:, 0]
        if not len(doubt):
            return found
        more = self._second.propose(resized(disks[doubt], self._second.size_px))
        place = {int(f): k for k, f in enumerate(doubt.tolist())}
        parts = []
        for f in range(len(disks)):
            own = one_of(found, f)
            parts.append(own if f not in place else interleaved(one_of(more, place[f]), own))
        return Candidates.joined(parts)


def resized(disks: Tensor, size_px: int) -> Tensor:
    """Return disks (F, S, S) resampled to `size_px` pixels across."""
    if disks.shape[-1] == size_px:
        return disks
    grey: Tensor = F.interpolate(
        disks[:, None], (size_px, size_px), mode="bilinear", align_corners=False, antialias=True
    )
    return grey[:, 0]


def one_of(proposals: Candidates, f: int) -> Candidates:
    """Return the proposals of one disk."""
    rows = slice(int(proposals.offset[f]), int(proposals.offset[f + 1]))
    return Candidates(
        offset=torch.tensor([0, rows.stop - rows.start]),
        R_view_body=proposals.R_view_body[rows],
        score=proposals.score[rows],
        reason=proposals.reason[f : f + 1],
    )


def interleaved(one: Candidates, other: Candidates) -> Candidates:
    """Return the proposals of two for one disk in turn, the first one's first, without duplicates."""
    counts = (len(one.score), len(other.score))
    rank = torch.cat([2 * torch.arange(counts[0]), 2 * torch.arange(counts[1]) + 1])
    order = rank.argsort(stable=True)
    R = torch.cat([one.R_view_body, other.R_view_body])[order]
    score = torch.cat([one.score, other.score])[order]
    new = distinct(R, math.radians(SAME_DEG)) if len(R) else torch.zeros(0, dtype=torch.bool)
    reason = Reason.OK if len(R) else one.reason[0]
    return Candidates(offset=torch.tensor([0, int(new.sum())]), R_view_body=R[new], score=score[new], reason=(reason,))
