"""Fitted poses of one frame, and of all frames, padded, for the path."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.pose.fit import POSE_PARTS, FittedPoses, blank_parts
from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses(FittedPoses):
    """Distinct poses (M) that one frame's pictures allow, most likely first; M = 0: `reason` says why."""

    use: Tensor  # (C,) bool, cameras whose pictures count
    reason: tuple[Reason, ...]  # C

    def __len__(self) -> int:
        return len(self.nll)


def poses_of(fit: FittedPoses, chosen: Tensor, use: Tensor, reason: Sequence[Reason]) -> Poses:
    """Return some rows of a fit as the poses of one frame."""
    return Poses(**{name: part[chosen] for name, part in fit.parts().items()}, use=use, reason=tuple(reason))


def no_pose(cameras: int, reason: Sequence[Reason], use: Tensor | None = None) -> Poses:
    """Return a frame without any pose."""
    use = torch.zeros(cameras, dtype=torch.bool) if use is None else use
    return Poses(**blank_parts(cameras, 0), use=use, reason=tuple(reason))


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTable(FittedPoses):
    """Poses of N frames, padded to (N, M) with zeros and the unit rotation, likeliest first; `nll` above the best."""

    mask: Tensor  # (N, M) bool
    use: Tensor  # (N, C) bool
    reason: tuple[tuple[Reason, ...], ...]  # N of C

    def __len__(self) -> int:
        return len(self.mask)

    def rows(self, choice: Tensor) -> dict[str, Tensor]:
        """Return each part at one place per frame, (N, ...); NaN where the choice (N,) is negative."""
        frame, none = torch.arange(len(self)), choice < 0
        chosen: dict[str, Tensor] = {}
        for name, whole in self.parts().items():
            part = whole[frame, choice.clamp_min(0)]
            chosen[name] = torch.where(none.reshape(-1, *[1] * (part.ndim - 1)), torch.nan, part)
        return chosen


def pose_table(frames: Sequence[Poses], cameras: int) -> PoseTable:
    """Put the poses of N frames into arrays."""
    width = max([len(poses) for poses in frames] + [1])
    mask = torch.tensor([[k < len(poses) for k in range(width)] for poses in frames]).reshape(-1, width)
    parts = blank_parts(cameras, len(frames), width)
    if bool(mask.any()):
        for name, whole in parts.items():
            whole[mask] = torch.cat([getattr(poses, name) for poses in frames])
    parts["nll"] = parts["nll"] - parts["nll"][:, :1]
    use = torch.stack([poses.use for poses in frames])
    return PoseTable(mask=mask, **parts, use=use, reason=tuple(poses.reason for poses in frames))


def joined_tables(tables: Sequence[PoseTable]) -> PoseTable:
    """Return the frames of several tables, one after the other."""
    width = max(table.mask.shape[1] for table in tables)
    wide: dict[str, list[Tensor]] = {name: [] for name in ("mask", *POSE_PARTS)}
    for table in tables:
        count, more = len(table), width - table.mask.shape[1]
        blank = blank_parts(table.use.shape[1], count, more) | {"mask": torch.zeros(count, more, dtype=torch.bool)}
        for name, parts in wide.items():
            parts.append(torch.cat([getattr(table, name), blank[name]], dim=1))
    return PoseTable(
        **{name: torch.cat(parts) for name, parts in wide.items()},
        use=torch.cat([table.use for table in tables]),
        reason=tuple(why for table in tables for why in table.reason),
    )
