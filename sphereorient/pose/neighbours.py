"""Other spheres beside the one that is fitted: where they cover its pixels, and which part of its disk is left."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphereorient.pose.model import from_limb
from sphereorient.pose.pixels import LinesOfSight, Sights, Stencil

# Standard deviations of the blur: beyond a limb by this much a sphere covers .004 of a pixel, within it all but .004.
CLEAR = 2.65


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbours:
    """The other spheres of B poses, K each."""

    position_lab_mm: Tensor  # (B, K, 3) float64; NaN: none there
    radius_mm: Tensor  # (B, K)
    move_mm: Tensor  # (B, K, 3), while the shutter is open

    def of(self, rows: Tensor | Sequence[int]) -> "Neighbours":
        """Return those of some poses, by index."""
        parts: dict[str, Any] = {name: part[rows] for name, part in vars(self).items()}
        return Neighbours(**parts)


def joined(each: Sequence[Neighbours | None]) -> Neighbours | None:
    """Return the neighbours of all poses; None where none has any."""
    known = [one for one in each if one is not None]
    if not known:
        return None
    parts: dict[str, Any] = {name: torch.cat([getattr(one, name) for one in known]) for name in vars(known[0])}
    return Neighbours(**parts)


@dataclass(frozen=True, kw_only=True, eq=False)
class DiskPlaces:
    """Where the disks of B poses lie before C cameras; made by `Fitter`."""

    sights: Sequence[LinesOfSight]  # C
    stencil: Stencil
    middle_px: Tensor  # (C, B, 2)
    position_lab_mm: Tensor  # (B, 3)
    radius_mm: float
    blur_px: float  # standard deviation of the pictures' blur
    move_mm: Tensor | None = None  # (B, 3), while the shutter is open; None: at rest


def hidden_places(disks: DiskPlaces, neighbours: Neighbours) -> Tensor | None:
    """Return where other spheres spoil disks, (B * C, P) bool; None: nowhere.
    A nearer one covers the disk; one behind shows beside the limb, where the model expects the empty scene.
    """
    hidden: Tensor | None = None
    for row, places, _ in _spoilt(disks, neighbours):
        if hidden is None:
            hidden = torch.zeros(disks.middle_px.shape[0] * disks.middle_px.shape[1], len(places), dtype=torch.bool)
        hidden[row] = places
    return hidden


def visible_shares(disks: DiskPlaces, neighbours: Neighbours) -> Tensor:
    """Return the share of each disk that no other sphere covers, (B, C) float64."""
    cameras, poses = disks.middle_px.shape[:2]
    share = torch.ones(poses * cameras, dtype=torch.float64)
    for row, places, edges in _spoilt(disks, neighbours):
        own = edges.mean(0) > 0
        share[row] = 1.0 - float((places & own).sum()) / max(1.0, float(own.sum()))
    return share.reshape(poses, cameras)


def _spoilt(disks: DiskPlaces, neighbours: Neighbours) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Yield the disks near another one: row b * C + c, its spoilt places (P,) bool, its own `_edges`."""
    middle_px = disks.middle_px.nan_to_num().numpy()
    X, radii = neighbours.position_lab_mm.numpy(), neighbours.radius_mm.numpy()
    for c, sight in enumerate(disks.sights):
        direction, origin, pitch_rad, pitch_mm = sight.about(middle_px[c])
        to_centre = X - origin[:, None]
        along = (to_centre * direction[:, None]).sum(-1)
        # Another sphere's middle lies within its own radius and that of the stencil of this one's line of sight.
        reach = (disks.stencil.reach + 1) * (pitch_rad[:, None] * along.clip(0.0) + pitch_mm[:, None])
        aside = to_centre - along[..., None] * direction[:, None]
        near = np.sqrt((aside * aside).sum(-1)) < radii + reach
        depth = ((disks.position_lab_mm.numpy() - origin) * direction).sum(-1)
        nearer = along < depth[:, None]
        for b in np.flatnonzero(near.any(1)).tolist():
            there = sight.of((float(middle_px[c, b, 0]), float(middle_px[c, b, 1])), disks.stencil)
            some = np.flatnonzero(near[b])
            own, *others = _edges(there, disks, neighbours, b, some.tolist())
            covered = [one.amax(0) > -CLEAR for one in others]
            spoilt = torch.zeros(own.shape[1], dtype=torch.bool)
            for before, one in zip(nearer[b, some].tolist(), covered, strict=True):
                spoilt |= one if before else one & (own.amin(0) < CLEAR)
            if bool(spoilt.any()):
                yield b * len(disks.sights) + c, spoilt, own


def _edges(
    there: Sights, disks: DiskPlaces, neighbours: Neighbours, pose: int, some: Sequence[int]
) -> Sequence[Tensor]:
    """Return how far within the limb places look, standard deviations of the blur, (2, P), as the shutter opens and as
    it closes: of the sphere of a pose, and of some of its neighbours.
    """
    still = torch.zeros(1, 3, dtype=torch.float64)
    X = torch.cat([disks.position_lab_mm[pose : pose + 1], neighbours.position_lab_mm[pose, some]])
    own = still if disks.move_mm is None else disks.move_mm[pose : pose + 1]
    move = torch.cat([own, neighbours.move_mm[pose, some]])
    ends = (X[:, None] + torch.tensor([[[-0.5], [0.5]]], dtype=torch.float64) * move[:, None]).flatten(0, 1)
    radius = torch.cat([torch.tensor([disks.radius_mm], dtype=torch.float64), neighbours.radius_mm[pose, some]])
    radius = radius.repeat_interleave(2)[:, None].to(there.direction.dtype)
    return list(from_limb(there, ends, radius, disks.blur_px).edge.reshape(len(X), 2, -1))
