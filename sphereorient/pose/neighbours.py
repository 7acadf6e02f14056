"""Other spheres beside the fitted one: which pixels they cover, and which part of its disk is left."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.pose.pixels import LinesOfSight, Stencil

# Standard deviations of the blur: this far outside a limb a sphere covers .004 of a pixel, as far inside all but .004.
CLEAR = 2.65

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbours:
    """The other spheres of B poses, K each."""

    position_lab_mm: Tensor  # (B, K, 3) float64; NaN: none there
    radius_mm: Tensor  # (B, K)
    move_mm: Tensor  # (B, K, 3), during the exposure

    def of(self, rows: Tensor | Sequence[int]) -> "Neighbours":
        """Return the neighbours of some poses, by index."""
        parts: dict[str, Any] = {name: part[rows] for name, part in vars(self).items()}
        return Neighbours(**parts)


def joined_neighbours(each: Sequence[Neighbours | None]) -> Neighbours | None:
    """Return the neighbours of all poses; None if there are none."""
    known = [one for one in each if one is not None]
    if not known:
        return None
    parts: dict[str, Any] = {name: torch.cat([getattr(one, name) for one in known]) for name in vars(known[0])}
    return Neighbours(**parts)


@dataclass(frozen=True, kw_only=True, eq=False)
class DiskPlaces:
    """Where the disks of B poses lie in C cameras."""

    sights: Sequence[LinesOfSight]  # C
    stencil: Stencil
    middle_px: Tensor  # (C, B, 2)
    position_lab_mm: Tensor  # (B, 3)
    radius_mm: float
    blur_px: float  # standard deviation of the pictures' blur
    move_mm: Tensor | None = None  # (B, 3), during the exposure; None: all spheres at rest


@dataclass(frozen=True, kw_only=True, eq=False)
class Spoilt:
    """Where other spheres spoil the disks of B poses in C cameras. A nearer one covers the disk; one behind appears
    beside the limb, where the model expects the empty scene.
    """

    hidden: Tensor | None  # (B * C, P) bool, places not used; None: all are used
    left: Tensor  # (B, C) float64, the share of each disk that no other sphere covers


def spoilt(disks: DiskPlaces, neighbours: Neighbours) -> Spoilt:
    """Return where other spheres spoil disks."""
    cameras, poses = disks.middle_px.shape[:2]
    hidden, left = None, np.ones((poses, cameras))
    for c in range(cameras):
        found = _spoilt_before(disks, neighbours, c)
        if found is None or not found[1].any():
            continue
        rows, places, own = found
        if hidden is None:
            hidden = np.zeros((poses, cameras, places.shape[1]), bool)
        hidden[rows, c] = places
        left[rows, c] = 1.0 - (places & own).sum(1) / own.sum(1).clip(1)
    places_ = None if hidden is None else torch.from_numpy(hidden).flatten(0, 1)
    return Spoilt(hidden=places_, left=torch.from_numpy(left))


def _spoilt_before(disks: DiskPlaces, neighbours: Neighbours, camera: int) -> tuple[NDArray[Any], ...] | None:
    """Return the indices of the n poses with neighbours near their disks in a camera, the spoilt places of these disks
    and their own places, (n, P) bool; None if there are none.
    """
    sight, middle_px = disks.sights[camera], disks.middle_px[camera].nan_to_num().numpy()
    # The sphere itself comes first.
    X = torch.cat([disks.position_lab_mm[:, None], neighbours.position_lab_mm], dim=1).numpy()
    radius_mm = np.insert(neighbours.radius_mm.numpy(), 0, disks.radius_mm, axis=1)
    direction, origin, pitch_rad, pitch_mm = (part[:, None] for part in sight.about(middle_px))
    along = ((X - origin) * direction).sum(-1)
    aside = np.linalg.norm(X - origin - along[..., None] * direction, axis=-1)
    pitch = pitch_rad * along.clip(0.0) + pitch_mm
    # Near: the centre is less than its own and the stencil's radius from this sphere's line of sight.
    near = aside < radius_mm + (disks.stencil.reach + 1) * pitch
    rows = np.flatnonzero(near[:, 1:].any(1))
    if not len(rows):
        return None
    near[:, 0] = True
    at, which = np.nonzero(near[rows])
    of = rows[at]
    lines = [part[at] if len(part) > 1 else part for part in sight.of(middle_px[rows], disks.stencil)]
    away2 = [_away_mm2(lines, end[of, which]) for end in _ends(disks, neighbours, X)]
    least, most = (away2[0], away2[0]) if len(away2) == 1 else (np.minimum(*away2), np.maximum(*away2))
    blur = disks.blur_px * pitch[of, which] / radius_mm[of, which]

    def limit_mm2(edge: float) -> Floats:
        # The limb is curved: a blur is half covered blur^2 / 2 radii inside it.
        limit: Floats = (radius_mm[of, which] * (1.0 - 0.5 * blur**2 - edge * blur).clip(0.0))[:, None] ** 2
        return limit

    own = which == 0
    beside = (most > limit_mm2(CLEAR))[own]
    # A nearer sphere covers places; one behind is visible beside this one.
    spoilt_ = (least < limit_mm2(-CLEAR)) & (beside[at] | (along[of, which] < along[of, 0])[:, None])
    spoilt_[own] = False
    return rows, np.maximum.reduceat(spoilt_, np.flatnonzero(own)), (least < limit_mm2(0.0))[own]


def _ends(disks: DiskPlaces, neighbours: Neighbours, X: Floats) -> list[Floats]:
    """Return positions (B, 1 + K, 3) at the start and at the end of the exposure; one entry if all are at rest."""
    if disks.move_mm is None:
        return [X]
    move = torch.cat([disks.move_mm[:, None], neighbours.move_mm], dim=1).numpy()
    return [X - 0.5 * move, X + 0.5 * move]


def _away_mm2(lines: Sequence[NDArray[np.float32]], X: Floats) -> Floats:
    """Return the squared distances (n, P) of points (n, 3) from lines of sight (n, 3, P)."""
    direction, origin = lines
    to_point = X[:, :, None] - origin
    along = np.einsum("ncp,ncp->np", to_point, direction)
    away2: Floats = (to_point * to_point).sum(1) - along * along
    return away2
