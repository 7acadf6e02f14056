from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import torch
from torch import Tensor

from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposals:
    """Possible orientations of a batch of disks in their own view frames: F disks, M rows.
    Those of disk f are the rows `offset[f] .. offset[f + 1]`, best score first.
    """

    offset: Tensor  # (F + 1,) int64
    R_view_body: Tensor  # (M, 3, 3) float64
    score: Tensor  # (M,) float64, 0 .. 1
    reason: tuple[Reason, ...]  # F, why a disk has no proposal; Reason.OK where it has

    @classmethod
    def none(cls, reason: Sequence[Reason]) -> Self:
        """Return the proposals of disks without any, for these reasons."""
        return cls(
            offset=torch.zeros(len(reason) + 1, dtype=torch.int64),
            R_view_body=torch.zeros(0, 3, 3, dtype=torch.float64),
            score=torch.zeros(0, dtype=torch.float64),
            reason=tuple(reason),
        )

    @classmethod
    def joined(cls, parts: Sequence[Proposals]) -> Self:
        """Return the disks of all parts, one after the other."""
        counts = torch.cat([part.offset.diff() for part in parts])
        return cls(
            offset=torch.nn.functional.pad(counts.cumsum(0), (1, 0)),
            R_view_body=torch.cat([part.R_view_body for part in parts]),
            score=torch.cat([part.score for part in parts]),
            reason=tuple(why for part in parts for why in part.reason),
        )

    def spread(self, placed: Tensor, reason: Sequence[Reason]) -> Self:
        """Return one entry per frame; `placed` (N,) bool marks the F frames with a disk, `reason` (N) all others."""
        counts = torch.zeros(len(placed), dtype=torch.int64)
        counts[placed] = self.offset.diff()
        own = iter(self.reason)
        return replace(
            self,
            offset=torch.nn.functional.pad(counts.cumsum(0), (1, 0)),
            reason=tuple(next(own) if here else why for here, why in zip(placed.tolist(), reason, strict=True)),
        )


class Proposer(Protocol):
    """Proposes orientations for disks cropped to `size_px`."""

    @property
    def size_px(self) -> int:
        """Side of the pictures it wants, px."""

    def propose(self, disks: Tensor) -> Proposals:
        """Propose orientations for (F, S, S) float32 grey disks; a disk's answer depends on no other disk."""
