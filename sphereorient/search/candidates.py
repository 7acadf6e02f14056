from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Possible orientations of every frame of one camera: N frames, M rows.
    The candidates of frame k are the rows `offset[k] .. offset[k + 1]`, best score first.
    """

    offset: Tensor  # (N + 1,) int64, offset[0] = 0, offset[N] = M
    R_lab_body: Tensor  # (M, 3, 3) float64
    score: Tensor  # (M,) float64, the quality T in 0 .. 1
    reason: tuple[Reason, ...]  # N, why a frame has no candidate; Reason.OK where it has

    def __post_init__(self) -> None:
        check_tail("Candidates.R_lab_body", self.R_lab_body, 3, 3)
        rows = int(self.offset[-1])
        if not len(self.R_lab_body) == len(self.score) == rows or len(self.reason) != len(self.offset) - 1:
            got = f"{len(self.R_lab_body)} orientations, {len(self.score)} scores, {len(self.reason)} reasons"
            expected = f"{rows} orientations and scores, {len(self.offset) - 1} reasons"
            raise ShapeError(refusal("Candidates", expected=expected, got=got, do="pass one row a candidate"))

    def __len__(self) -> int:
        return len(self.offset) - 1

    @property
    def counts(self) -> Tensor:
        """Number of candidates of each frame, (N,) int64."""
        return self.offset[1:] - self.offset[:-1]

    def padded(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return orientations (N, C, 3, 3), scores (N, C), mask (N, C), C >= 1; padded by unit rotation, 0, False."""
        counts = self.counts
        width = max(int(counts.max()) if len(counts) else 0, 1)
        place = torch.arange(width, device=counts.device)
        mask = place < counts[:, None]
        R = torch.eye(3, dtype=self.R_lab_body.dtype, device=counts.device).repeat(len(self), width, 1, 1)
        score = torch.zeros(len(self), width, dtype=self.score.dtype, device=counts.device)
        R[mask], score[mask] = self.R_lab_body, self.score
        return R, score, mask
