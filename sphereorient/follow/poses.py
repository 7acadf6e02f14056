"""Fitted poses of one frame, and of all frames, padded, for the path."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.pose.poses import POSE_PARTS, FittedPoses, blank_parts
from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses(FittedPoses):
    """Distinct poses (M) that one frame's pictures allow, most likely first; M = 0: `reason` says why."""

    use: Tensor  # (C,) bool, cameras whose pictures count
    reason: tuple[Reason, ...]  # C

    def __len__(self) -> int:
        return len(self.nll)


def poses_of(fit: FittedPoses, chosen: Tensor | slice, use: Tensor, reason: Sequence[Reason]) -> Poses:
    """Return some rows of a fit as the poses of one frame."""
    return Poses(**{name: part[chosen] for name, part in fit.parts().items()}, use=use, reason=tuple(reason))


def best_poses(found: Sequence[Poses]) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions (n, 3), rotations (n, 3, 3) and use (n, C) of the likeliest poses of n frames that have one."""
    X, R = (torch.cat([getattr(one, name)[:1] for one in found]) for name in ("position_lab_mm", "R_lab_body"))
    return X, R, torch.stack([one.use for one in found])


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


def pose_table(batches: Iterable[Sequence[Poses]], cameras: int) -> PoseTable:
    """Put the poses of N frames, given batch by batch, into arrays."""
    flat: dict[str, list[Tensor]] = {name: [] for name in POSE_PARTS}
    counts: list[int] = []
    use: list[Tensor] = []
    reason: list[tuple[Reason, ...]] = []
    for frames in batches:
        counts += [len(poses) for poses in frames]
        use.append(torch.stack([poses.use for poses in frames]))
        reason += [poses.reason for poses in frames]
        for name, pieces in flat.items():
            pieces.append(torch.cat([getattr(poses, name) for poses in frames]))
    mask = torch.arange(max([*counts, 1])) < torch.tensor(counts)[:, None]
    parts = blank_parts(cameras, *mask.shape)
    for name, whole in parts.items():
        whole[mask] = torch.cat(flat[name])
    parts["nll"] = parts["nll"] - parts["nll"][:, :1]
    return PoseTable(mask=mask, **parts, use=torch.cat(use), reason=tuple(reason))


def supported(poses: Poses) -> bool:
    """Return whether a picture supports the best pose of a frame."""
    return len(poses) > 0 and bool(poses.use.any())
