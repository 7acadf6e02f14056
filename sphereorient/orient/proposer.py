"""What the pipeline asks of anyone who proposes orientations: the template search, later a trained network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposals:
    """Possible orientations of a batch of disks in their own view frames; made by a Proposer, read by the pipeline.

    Those of disk f are the rows `offset[f] .. offset[f + 1]`, best score first. F disks, M rows.
    """

    offset: Tensor  # (F + 1,) int64
    R_view_body: Tensor  # (M, 3, 3) float64
    score: Tensor  # (M,) float64, 0 .. 1
    reason: tuple[Reason, ...]  # F, why a disk has no proposal; Reason.OK where it has


class Proposer(Protocol):
    """Proposes orientations for disks cropped to `size_px`."""

    @property
    def size_px(self) -> int:
        """Side of the pictures it wants, px."""

    def propose(self, disks: Tensor) -> Proposals:
        """Propose orientations for (F, S, S) float32 grey disks; a disk's answer depends on no other disk."""
