"""Candidate orientations without history, and proposers."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from sphereorient.errors import Reason, ShapeError, check_finite, check_tail, refusal, tensor_of

BATCH = 32  # disks at once; full batches give the same bits for any number of disks
SAME_DEG = 12.0  # nearer proposals of two proposers are the same


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """M candidate orientations of N disks or frames; those of k are rows offset[k] .. offset[k + 1], best first."""

    offset: Tensor  # (N + 1,) int64, offset[0] = 0, offset[N] = M
    R_view_body: Tensor  # (M, 3, 3) float64
    score: Tensor  # (M,) float64, 0 .. 1
    reason: tuple[Reason, ...]  # N, why there is no candidate; Reason.OK if there is one
    R_lab_view: Tensor | None = None  # (N, 3, 3), of each frame; None if the camera is unknown

    def __post_init__(self) -> None:
        """Check the lengths of the parts."""
        check_tail("Candidates.R_view_body", self.R_view_body, 3, 3)
        rows = int(self.offset[-1])
        if not len(self.R_view_body) == len(self.score) == rows or len(self.reason) != len(self.offset) - 1:
            got = f"{len(self.R_view_body)} orientations, {len(self.score)} scores, {len(self.reason)} reasons"
            expected = f"{rows} orientations and scores, {len(self.offset) - 1} reasons"
            raise ShapeError(refusal("Candidates", expected=expected, got=got, do="pass one row per candidate"))

    @classmethod
    def of_disk(cls, R_view_body: Tensor, score: Tensor, otherwise: Reason = Reason.LOW_SCORE) -> Self:
        """Return the candidates of one disk, (M, 3, 3) and (M,), best first; `otherwise`: why there is none."""
        reason = (Reason.OK if len(score) else otherwise,)
        return cls(offset=torch.tensor([0, len(score)]), R_view_body=R_view_body, score=score, reason=reason)

    @classmethod
    def none(cls, reason: Sequence[Reason]) -> Self:
        """Return disks without candidates, for these reasons."""
        return cls(
            offset=torch.zeros(len(reason) + 1, dtype=torch.int64),
            R_view_body=torch.zeros(0, 3, 3, dtype=torch.float64),
            score=torch.zeros(0, dtype=torch.float64),
            reason=tuple(reason),
        )

    @classmethod
    def joined(cls, parts: "Sequence[Candidates]") -> Self:
        """Return the disks of all parts, one after the other."""
        parts = [cls.none(()), *parts]
        counts = torch.cat([part.counts for part in parts])
        return cls(
            offset=F.pad(counts.cumsum(0), (1, 0)),
            R_view_body=torch.cat([part.R_view_body for part in parts]),
            score=torch.cat([part.score for part in parts]),
            reason=tuple(why for part in parts for why in part.reason),
        )

    def __len__(self) -> int:
        """Return the number of disks or frames."""
        return len(self.offset) - 1

    def each(self) -> "list[Candidates]":
        """Return the candidates of each disk alone."""
        counts = self.counts.tolist()
        rows = zip(torch.split(self.R_view_body, counts), torch.split(self.score, counts), self.reason, strict=True)
        return [Candidates.of_disk(R, score, why) for R, score, why in rows]

    @property
    def counts(self) -> Tensor:
        """Number of candidates of each frame, (N,) int64."""
        return self.offset[1:] - self.offset[:-1]

    @property
    def R_lab_body(self) -> Tensor:
        """Orientations in the lab, (M, 3, 3)."""
        assert self.R_lab_view is not None  # set when the camera is known
        return self.R_lab_view[torch.repeat_interleave(torch.arange(len(self)), self.counts)] @ self.R_view_body

    def spread(self, placed: Tensor, reason: Sequence[Reason]) -> Self:
        """Return one entry per frame, if only the frames `placed` (N,) bool had a disk; `reason`: of the others."""
        counts = torch.zeros(len(placed), dtype=torch.int64)
        counts[placed] = self.counts
        own = iter(self.reason)
        return replace(
            self,
            offset=F.pad(counts.cumsum(0), (1, 0)),
            reason=tuple(next(own) if here else why for here, why in zip(placed.tolist(), reason, strict=True)),
        )

    def padded(self, views: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return R_lab_body or R_view_body (N, C, 3, 3), scores and mask (N, C); unused: unit rotation and 0."""
        R = self.R_view_body if views else self.R_lab_body
        mask = torch.arange(max([*self.counts.tolist(), 1])) < self.counts[:, None]
        rotations, score = torch.eye(3).to(R).repeat(*mask.shape, 1, 1), self.score.new_zeros(mask.shape)
        rotations[mask], score[mask] = R, self.score
        return rotations, score, mask

    @property
    def best_score(self) -> Tensor:
        """Score of each frame's best candidate, (N,) float64, 0 without one."""
        return torch.tensor([float(own.score[:1].sum()) for own in self.each()], dtype=torch.float64)


def check_disks(disks: Tensor, height: int, width: int) -> None:
    """Raise ShapeError unless the disks are (F, height, width)."""
    if disks.shape[1:] != (height, width):
        size = f"(F, {height}, {width})"
        raise ShapeError(refusal("disks", expected=size, got=str(tuple(disks.shape)), do="crop anew"))


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposals:
    """Candidate orientations of disks of any leading shape, best first, padded with NaN; float64."""

    R_view_body: Tensor  # (..., M, 3, 3)
    score: Tensor  # (..., M), 0 .. 1
    reason: tuple[Reason, ...]  # of each disk: why it has none; `OK` if it has one


class Proposer(nn.Module, ABC):
    """Proposes orientations for disks: templates, a network, or both. A call accepts disks of any leading shape."""

    size_px: int  # side of the disks

    @abstractmethod
    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose orientations for (F, S, S) float32 grey disks, one by one. `least`: instead of `score_min`."""

    def rough(self, disks: Tensor) -> Candidates:
        """Return the starts of the refinement in `propose`: right to the step of its grid, in a quarter of the time."""
        return self.propose(disks)

    def likeness(self, disks: Tensor) -> Tensor:
        """Return the similarity of disks (F, S, S) to the ball in its best orientation, (F,); faster than `propose`."""
        return self.propose(disks).best_score

    def forward(self, disks: Tensor | NDArray[np.generic]) -> Proposals:
        """Return the candidates of disks (..., S, S), grey levels of any scale, the outline touching the borders.

        Raises:
            ShapeError: the disks are of another size, or not finite.
        """
        grey = tensor_of("disks", disks).float()
        check_finite("disks", grey)
        found = self.propose(grey.reshape(-1, *grey.shape[-2:]))
        R, score, mask = found.padded(views=True)
        R[~mask], score[~mask] = torch.nan, torch.nan
        lead, most = grey.shape[:-2], mask.shape[1]
        return Proposals(
            R_view_body=R.reshape(*lead, most, 3, 3), score=score.reshape(*lead, most), reason=found.reason
        )


class FallbackProposer(Proposer):
    """Uses one proposer, and a second one if no score reaches `sure`; then the second's results come first."""

    def __init__(self, first: Proposer, second: Proposer, sure: float) -> None:
        super().__init__()
        self._first, self._second, self._sure = first, second, sure
        self.size_px = first.size_px

    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose orientations for (F, S, S) float32 grey disks."""
        first = self._first.propose(disks, least)
        found, doubt = first.each(), torch.nonzero(first.best_score < self._sure)[:, 0].tolist()
        if doubt:
            more = self._second.propose(resized(disks[doubt], self._second.size_px), least)
            for f, other in zip(doubt, more.each(), strict=True):
                found[f] = interleaved(other, found[f])
        return Candidates.joined(found)

    def rough(self, disks: Tensor) -> Candidates:
        """Return the result of the first proposer."""
        return self._first.rough(disks)

    def likeness(self, disks: Tensor) -> Tensor:
        """Return the result of the first proposer."""
        return self._first.likeness(disks)


def resized(disks: Tensor, size_px: int) -> Tensor:
    """Return disks (F, S, S) resampled to `size_px` pixels across."""
    if disks.shape[-1] == size_px:
        return disks
    grey: Tensor = F.interpolate(disks[:, None], (size_px,) * 2, mode="bilinear", align_corners=False, antialias=True)
    return grey[:, 0]


def interleaved(one: Candidates, other: Candidates) -> Candidates:
    """Return the proposals of two for one disk alternately, the first one's first, without duplicates."""
    rank = torch.cat([2 * torch.arange(len(one.score)), 2 * torch.arange(len(other.score)) + 1])
    order = rank.argsort(stable=True)
    R = torch.cat([one.R_view_body, other.R_view_body])[order]
    score = torch.cat([one.score, other.score])[order]
    new = distinct(R, math.radians(SAME_DEG))
    return Candidates.of_disk(R[new], score[new], one.reason[0])


def distinct(R: Tensor, apart_rad: float) -> Tensor:
    """Return which rotations (..., M, 3, 3), best first, are peaks, (..., M) bool; the first always is.
    Non-maximum suppression: any better neighbour within apart_rad suppresses, even a suppressed one.
    """
    flat = R.flatten(-2)
    return ~torch.tril(flat @ flat.mT > 1 + 2 * math.cos(apart_rad), -1).any(-1)  # the product is the trace of A^T B
