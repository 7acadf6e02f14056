"""Fitted poses of one frame, and of all frames, padded, for the path."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.errors import Reason
from sphereorient.pose.poses import POSE_PARTS, FittedPoses, blank_parts


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


def pose_tables(
    batches: Iterable[Mapping[str, Sequence[Poses]]], names: Iterable[str], cameras: int
) -> dict[str, PoseTable]:
    """Put the poses of each ball in N frames, given batch by batch, into arrays."""
    flat: dict[str, list[dict[str, Tensor]]] = {name: [] for name in names}
    counts: dict[str, list[int]] = {name: [] for name in flat}
    reason: dict[str, list[tuple[Reason, ...]]] = {name: [] for name in flat}
    for batch in batches:
        for name, frames in batch.items():
            counts[name] += [len(poses) for poses in frames]
            reason[name] += [poses.reason for poses in frames]
            parts = {part: torch.cat([getattr(poses, part) for poses in frames]) for part in POSE_PARTS}
            flat[name].append(parts | {"use": torch.stack([poses.use for poses in frames])})
    return {name: _padded(flat[name], counts[name], reason[name], cameras) for name in flat}


def pose_table(frames: Sequence[Poses], cameras: int) -> PoseTable:
    """Put the poses of one ball in N frames into arrays."""
    return pose_tables([{"": frames}], [""], cameras)[""]


def _padded(
    flat: Sequence[Mapping[str, Tensor]], counts: Sequence[int], reason: Sequence[tuple[Reason, ...]], cameras: int
) -> PoseTable:
    mask = torch.arange(max([*counts, 1])) < torch.tensor(counts)[:, None]
    parts = blank_parts(cameras, *mask.shape)
    for name, whole in parts.items():
        whole[mask] = torch.cat([batch[name] for batch in flat])
    parts["nll"] = parts["nll"] - parts["nll"][:, :1]
    return PoseTable(mask=mask, **parts, use=torch.cat([batch["use"] for batch in flat]), reason=tuple(reason))


def exchanged(tables: Sequence[PoseTable], row: Tensor) -> list[PoseTable]:
    """Return the tables of K balls of which ball k in frame n is the one of table `row` (K, N)."""
    frame, (count, cameras) = torch.arange(row.shape[1]), (len(row), tables[0].use.shape[1])
    most = max(table.mask.shape[1] for table in tables)
    mask = torch.zeros(count, len(frame), most, dtype=torch.bool)
    parts = blank_parts(cameras, count, len(frame), most)
    for k, table in enumerate(tables):
        mask[k, :, : table.mask.shape[1]] = table.mask
        for name, part in table.parts().items():
            parts[name][k, :, : part.shape[1]] = part
    use = torch.stack([table.use for table in tables])
    return [
        PoseTable(
            mask=mask[own, frame],
            **{name: part[own, frame] for name, part in parts.items()},
            use=use[own, frame],
            reason=tuple(tables[k].reason[n] for n, k in enumerate(own.tolist())),
        )
        for own in row
    ]


def supported(poses: Poses) -> bool:
    """Return whether a picture supports the best pose of a frame."""
    return len(poses) > 0 and bool(poses.use.any())
