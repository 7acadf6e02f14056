"""The poses of all frames in a few arrays: what the path chooses from, and what it chose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sphereorient.follow.initialise import POSE_PARTS, Poses
from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTable:
    """Poses of N frames, padded to M each, most likely first; made by `pose_table`, read by the pipeline.

    C cameras. Places not in use hold zeros, and the unit rotation.
    """

    mask: Tensor  # (N, M) bool
    position_lab_mm: Tensor  # (N, M, 3)
    R_lab_body: Tensor  # (N, M, 3, 3)
    covariance: Tensor  # (N, M, 6, 6), of delta (rad) and position (mm), lab
    own_turn: Tensor  # (N, M, C, 3), rad
    own_covariance: Tensor  # (N, M, C, 3, 3)
    own_move: Tensor  # (N, M, C, 3), mm
    deviation: Tensor  # (N, M, C)
    score: Tensor  # (N, M, C)
    nll: Tensor  # (N, M), above the frame's best
    use: Tensor  # (N, C) bool
    reason: tuple[tuple[Reason, ...], ...]  # N of C

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.mask)

    def rows(self, choice: Tensor) -> dict[str, Tensor]:
        """Return each part at one place a frame, (N, ...), NaN where the choice (N,) is negative."""
        frame, none = torch.arange(len(self)), choice < 0
        chosen: dict[str, Tensor] = {}
        for name in POSE_PARTS:
            part = getattr(self, name)[frame, choice.clamp_min(0)]
            chosen[name] = torch.where(none.reshape(-1, *[1] * (part.ndim - 1)), torch.nan, part)
        return chosen


def pose_table(frames: Sequence[Poses], cameras: int) -> PoseTable:
    """Put the poses of all frames into arrays.

    Args:
        frames: N, with none to several poses each.
        cameras: C.
    """
    width = max([len(poses) for poses in frames] + [1])
    mask = torch.tensor([[k < len(poses) for k in range(width)] for poses in frames]).reshape(-1, width)
    tails = {"position_lab_mm": (3,), "R_lab_body": (3, 3), "covariance": (6, 6), "own_turn": (cameras, 3)}
    tails |= {"own_covariance": (cameras, 3, 3), "own_move": (cameras, 3), "deviation": (cameras,)}
    tails |= {"score": (cameras,), "nll": ()}
    parts = {}
    for name in POSE_PARTS:
        whole = torch.zeros(len(frames), width, *tails[name], dtype=torch.float64)
        if name == "R_lab_body":
            whole = whole + torch.eye(3, dtype=torch.float64)
        if bool(mask.any()):
            whole[mask] = torch.cat([getattr(poses, name) for poses in frames])
        parts[name] = whole
    parts["nll"] = parts["nll"] - parts["nll"][:, :1]
    return PoseTable(
        mask=mask,
        **parts,
        use=torch.stack([poses.use for poses in frames]),
        reason=tuple(poses.reason for poses in frames),
    )


def joined_tables(tables: Sequence[PoseTable]) -> PoseTable:
    """Return the frames of several tables, one after the other."""
    width = max(table.mask.shape[1] for table in tables)
    wide = [_widened(table, width) for table in tables]
    parts = {name: torch.cat([getattr(table, name) for table in wide]) for name in ("mask", *POSE_PARTS, "use")}
    return PoseTable(**parts, reason=tuple(why for table in wide for why in table.reason))


def _widened(table: PoseTable, width: int) -> PoseTable:
    """Add places that are not in use."""
    more = width - table.mask.shape[1]
    if not more:
        return table
    parts: dict[str, Any] = {}
    for name in ("mask", *POSE_PARTS):
        part = getattr(table, name)
        empty = part.new_zeros(len(part), more, *part.shape[2:])
        if name == "R_lab_body":
            empty = empty + torch.eye(3, dtype=part.dtype)
        parts[name] = torch.cat([part, empty], dim=1)
    return replace(table, **parts)
