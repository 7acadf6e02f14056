"""Start and result of fits of poses; the poses of one frame, and of all frames, padded, for the path."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import Reason
from sphereorient.pose.neighbours import Neighbours
from sphereorient.pose.pixels import Pixels


@dataclass(frozen=True, eq=False)
class PoseStart:
    """Start of the fit of B poses."""

    position_lab_mm: Tensor  # (B, 3)
    R_lab_body: Tensor  # (B, 3, 3)
    use: Tensor  # (B, C) bool, cameras that see the sphere; a pose without any is not changed
    place_precision: Tensor | None = None  # (B, 3, 3), 1/mm^2, prior of `position_lab_mm`
    moved: Tensor | None = None  # (B, 6), rotation (rad) and displacement (mm) during the exposure; None: at rest
    held: bool = False  # whether each step starts at the given position
    among: Neighbours | None = None  # None: no other sphere is in view

    def of(self, rows: Tensor) -> "PoseStart":
        """Return some of the poses, by index."""
        parts: dict[str, Any] = {name: part[rows] for name, part in vars(self).items() if isinstance(part, Tensor)}
        return replace(self, **parts, among=None if self.among is None else self.among.of(rows))

    def after(self, fit: "FittedPoses") -> "PoseStart":
        """Return the start of a further fit from the poses of one."""
        X = self.position_lab_mm if self.held else fit.position_lab_mm
        return replace(self, position_lab_mm=X, R_lab_body=fit.R_lab_body)


def _of(*shape: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of a part of `FittedPoses` after the leading one; -1: per camera."""
    return {"shape": shape}


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedPoses:
    """Fitted poses of C cameras, float64, of any leading shape; compiled code writes the parts in this order."""

    position_lab_mm: Tensor = field(metadata=_of(3))
    R_lab_body: Tensor = field(metadata=_of(3, 3))
    covariance: Tensor = field(metadata=_of(6, 6))  # of delta (rad) and position (mm), lab
    own_turn: Tensor = field(metadata=_of(-1, 3))  # rad: rotation of the pose by each camera alone, position held
    own_covariance: Tensor = field(metadata=_of(-1, 3, 3))  # rad^2
    # mm, lab: displacement of the pose by each camera alone, with distance by size.
    own_move: Tensor = field(metadata=_of(-1, 3))
    own_sigma_mm: Tensor = field(metadata=_of(-1))  # of the position by each camera alone, across its line of sight
    limb_coverage: Tensor = field(metadata=_of(-1))  # 0 to 1: share of the limb whose pixels are used
    excess: Tensor = field(
        metadata=_of(-1)
    )  # ratio of own rotation's scatter to independent noise; 1 for a right model
    # Explained share of the picture's variance; 0 if hardly any paint is known.
    score: Tensor = field(metadata=_of(-1))
    nll: Tensor = field(metadata=_of())  # negative log-likelihood of all pixels, as if they were independent
    step: Tensor = field(metadata=_of(6))  # the last one of the fit

    def parts(self) -> dict[str, Tensor]:
        """Return the arrays by name."""
        return {name: getattr(self, name) for name in POSE_PARTS}

    def of(self, rows: Tensor) -> "FittedPoses":
        """Return some of the poses (B,), by index."""
        return FittedPoses(**{name: part[rows] for name, part in self.parts().items()})

    def where(self, mask: Tensor, other: "FittedPoses") -> "FittedPoses":
        """Return these poses where the mask (B,) holds, the others elsewhere."""
        own, others = self.parts(), other.parts()
        return FittedPoses(
            **{
                name: torch.where(mask.reshape(-1, *[1] * (part.ndim - 1)), part, others[name])
                for name, part in own.items()
            }
        )

    def with_rows(self, rows: Sequence[int], others: "FittedPoses") -> "FittedPoses":
        """Return the poses (B,) with others in some rows, by index."""
        at, there = torch.tensor(rows, dtype=torch.int64), others.parts()
        return FittedPoses(**{name: part.index_copy(0, at, there[name]) for name, part in self.parts().items()})


SHAPES: dict[str, tuple[int, ...]] = {part.name: part.metadata["shape"] for part in fields(FittedPoses)}
POSE_PARTS = tuple(SHAPES)


def pose_arrays(cameras: int, *shape: int) -> dict[str, Tensor]:
    """Return the zero arrays of `FittedPoses` of a leading shape."""
    return {
        name: torch.zeros(*shape, *(cameras if n < 0 else n for n in tail), dtype=torch.float64)
        for name, tail in SHAPES.items()
    }


def blank_parts(cameras: int, *shape: int) -> dict[str, Tensor]:
    """Return `pose_arrays` with unit rotations."""
    parts = pose_arrays(cameras, *shape)
    return parts | {"R_lab_body": parts["R_lab_body"] + torch.eye(3, dtype=torch.float64)}


Record = TypeVar("Record", Pixels, PoseStart, FittedPoses)


def moved_to(device: torch.device, record: Record) -> Record:
    """Return a record with its tensors on a device."""
    tensors: dict[str, Any] = {name: part for name, part in vars(record).items() if isinstance(part, Tensor)}
    if next(iter(tensors.values())).device == device:
        return record
    return replace(record, **{name: part.to(device) for name, part in tensors.items()})


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses(FittedPoses):
    """Distinct poses (M) consistent with one frame's pictures, likeliest first; for M = 0, `reason` says why."""

    use: Tensor  # (C,) bool, cameras whose pictures are used
    reason: tuple[Reason, ...]  # C

    def __len__(self) -> int:
        return len(self.nll)


def poses_of(fit: FittedPoses, chosen: Tensor | slice, use: Tensor, reason: Sequence[Reason]) -> Poses:
    """Return some rows of a fit as the poses of one frame."""
    return Poses(**{name: part[chosen] for name, part in fit.parts().items()}, use=use, reason=tuple(reason))


def best_poses(found: Sequence[Poses]) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions (n, 3), rotations (n, 3, 3) and use (n, C) of the likeliest poses of n frames with poses."""
    X, R = (torch.cat([getattr(one, name)[:1] for one in found]) for name in ("position_lab_mm", "R_lab_body"))
    return X, R, torch.stack([one.use for one in found])


def no_pose(cameras: int, reason: Sequence[Reason], use: Tensor | None = None) -> Poses:
    """Return a frame without poses; a camera with the reason OK had too low a score."""
    use = torch.zeros(cameras, dtype=torch.bool) if use is None else use
    why = tuple(Reason.LOW_SCORE if one is Reason.OK else one for one in reason)
    return Poses(**blank_parts(cameras, 0), use=use, reason=why)


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTable(FittedPoses):
    """Poses of N frames, padded to (N, M), likeliest first; `nll` relative to the best."""

    mask: Tensor  # (N, M) bool
    use: Tensor  # (N, C) bool
    reason: tuple[tuple[Reason, ...], ...]  # N of C

    def __len__(self) -> int:
        return len(self.mask)

    def rows(self, choice: Tensor) -> dict[str, Tensor]:
        """Return each part of the chosen pose per frame, (N, ...); NaN where the choice (N,) is negative."""
        frame, none = torch.arange(len(self)), choice < 0
        chosen: dict[str, Tensor] = {}
        for name, whole in self.parts().items():
            part = whole[frame, choice.clamp_min(0)]
            chosen[name] = torch.where(none.reshape(-1, *[1] * (part.ndim - 1)), torch.nan, part)
        return chosen

    def margin(self, choice: Tensor) -> tuple[Tensor, Tensor]:
        """Return log-likelihood margin and angle to the next distinct orientation, (N,) each; NaN without one."""
        frame, place = torch.arange(len(self)), choice.clamp_min(0)
        others = self.mask.clone()
        others[frame, place] = False
        others &= (choice >= 0)[:, None]
        nll = torch.where(others, self.nll, torch.inf)
        best, which = nll.min(1)
        there = torch.isfinite(best)
        angle = so3.geodesic_distance(self.R_lab_body[frame, which], self.R_lab_body[frame, place])
        return torch.where(there, best - self.nll[frame, place], torch.nan), torch.where(there, angle, torch.nan)


def turned_alone(picked: Mapping[str, Tensor], camera: int) -> Tensor:
    """Return R_lab_body (N, 3, 3) by one camera alone, of poses from `PoseTable.rows`."""
    return so3.exp(picked["own_turn"][:, camera]) @ picked["R_lab_body"]


def pose_tables(
    batches: Iterable[Mapping[str, Sequence[Poses]]], names: Iterable[str], cameras: int
) -> dict[str, PoseTable]:
    """Return the poses of each ball in N frames, given batch by batch, as arrays."""
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
    """Return the poses of one ball in N frames as arrays."""
    (table,) = pose_tables([{"only": frames}], ["only"], cameras).values()
    return table


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
    """Return the tables of K balls, reassigned: ball k in frame n is that of table `row` (K, N)."""
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
