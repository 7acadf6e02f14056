"""Candidate orientations without history, and who proposes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import torch
from torch import Tensor

from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """M possible orientations of N disks or frames; those of k are rows offset[k] .. offset[k + 1], best first."""

    offset: Tensor  # (N + 1,) int64, offset[0] = 0, offset[N] = M
    R_view_body: Tensor  # (M, 3, 3) float64
    score: Tensor  # (M,) float64, 0 .. 1
    reason: tuple[Reason, ...]  # N, why there is no candidate; Reason.OK where there is one
    R_lab_view: Tensor | None = None  # (N, 3, 3), of each frame; None before the camera is known

    def __post_init__(self) -> None:
        """Compare the lengths of the parts."""
        check_tail("Candidates.R_view_body", self.R_view_body, 3, 3)
        rows = int(self.offset[-1])
        if not len(self.R_view_body) == len(self.score) == rows or len(self.reason) != len(self.offset) - 1:
            got = f"{len(self.R_view_body)} orientations, {len(self.score)} scores, {len(self.reason)} reasons"
            expected = f"{rows} orientations and scores, {len(self.offset) - 1} reasons"
            raise ShapeError(refusal("Candidates", expected=expected, got=got, do="pass one row per candidate"))

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
    def joined(cls, parts: Sequence[Candidates]) -> Self:
        """Return the disks of all parts, one after the other."""
        counts = torch.cat([part.counts for part in parts])
        return cls(
            offset=torch.nn.functional.pad(counts.cumsum(0), (1, 0)),
            R_view_body=torch.cat([part.R_view_body for part in parts]),
            score=torch.cat([part.score for part in parts]),
            reason=tuple(why for part in parts for why in part.reason),
        )

    def __len__(self) -> int:
        """Return the number of disks or frames."""
        return len(self.offset) - 1

    @property
    def counts(self) -> Tensor:
        """Number of candidates of each frame, (N,) int64."""
        return self.offset[1:] - self.offset[:-1]

    @property
    def R_lab_body(self) -> Tensor:
        """Orientations in the lab, (M, 3, 3)."""
        assert self.R_lab_view is not None  # set once the camera is known
        return self.R_lab_view[torch.repeat_interleave(torch.arange(len(self)), self.counts)] @ self.R_view_body

    def spread(self, placed: Tensor, reason: Sequence[Reason]) -> Self:
        """Return one entry per frame where only the frames `placed` (N,) bool had a disk; `reason` is of the others."""
        counts = torch.zeros(len(placed), dtype=torch.int64)
        counts[placed] = self.counts
        own = iter(self.reason)
        return replace(
            self,
            offset=torch.nn.functional.pad(counts.cumsum(0), (1, 0)),
            reason=tuple(next(own) if here else why for here, why in zip(placed.tolist(), reason, strict=True)),
        )

    def padded(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return R_lab_body (N, C, 3, 3), scores (N, C) and mask (N, C), C the largest count, at least 1.

        Unused places hold the unit rotation, score 0 and mask False.
        """
        counts = self.counts
        width = max(int(counts.max()) if len(counts) else 0, 1)
        place = torch.arange(width, device=counts.device)
        mask = place < counts[:, None]
        R = torch.eye(3, dtype=self.R_view_body.dtype, device=counts.device).repeat(len(self), width, 1, 1)
        score = torch.zeros(len(self), width, dtype=self.score.dtype, device=counts.device)
        R[mask], score[mask] = self.R_lab_body, self.score
        return R, score, mask


class Proposer(Protocol):
    """Proposes orientations for disks cropped to `size_px`: templates, a network, or both."""

    @property
    def size_px(self) -> int:
        """Side of the disks, px."""

    def propose(self, disks: Tensor) -> Candidates:
        """Propose orientations for (F, S, S) float32 grey disks; a disk's answer depends on no other disk."""
