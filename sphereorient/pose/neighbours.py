"""Other spheres beside the one that is fitted: where they cover its pixels, and which part of its disk is left."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

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
    cameras, rest = len(disks.sights), torch.zeros(3, dtype=torch.float64)
    middles = disks.middle_px.nan_to_num().tolist()
    for b, (X, radii, moves) in enumerate(
        zip(neighbours.position_lab_mm, neighbours.radius_mm.tolist(), neighbours.move_mm, strict=True)
    ):
        for c, sight in enumerate(disks.sights):
            direction, origin, pitch_rad, pitch_mm = sight.about(middles[c][b])
            to_centre = X - origin
            along = to_centre @ direction
            # Another sphere's middle lies within its own radius and that of the stencil of this one's line of sight.
            reach = (disks.stencil.reach + 1) * (pitch_rad * along.clamp_min(0.0) + pitch_mm)
            away = (to_centre - along[:, None] * direction).norm(dim=-1)
            near = [k for k, radius in enumerate(radii) if float(away[k]) < radius + float(reach[k])]
            if not near:
                continue
            there, place = sight.of(middles[c][b], disks.stencil), disks.position_lab_mm[b]
            own = _edges(there, place, rest if disks.move_mm is None else disks.move_mm[b], disks.radius_mm, disks)
            spoilt = torch.zeros(own.shape[1], dtype=torch.bool)
            for k in near:
                covered = _edges(there, X[k], moves[k], radii[k], disks).amax(0) > -CLEAR
                nearer = float((X[k] - place) @ direction) < 0
                spoilt |= covered if nearer else covered & (own.amin(0) < CLEAR)
            if bool(spoilt.any()):
                yield b * cameras + c, spoilt, own


def _edges(there: Sights, X: Tensor, move: Tensor, radius_mm: float, disks: DiskPlaces) -> Tensor:
    """Return how far within a sphere's limb places look, standard deviations of the blur, (2, P): as the shutter opens
    and as it closes.
    """
    ends = X + torch.tensor([[-0.5], [0.5]], dtype=torch.float64) * move
    return torch.cat([from_limb(there, end[None], radius_mm, disks.blur_px).edge for end in ends])
