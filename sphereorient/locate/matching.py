"""Disks of several cameras that may show one sphere: their lines of sight meet."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.stats import chi2

from sphereorient.cameras import Camera, nearest_point
from sphereorient.errors import Reason
from sphereorient.locate.outline import Outline
from sphereorient.locate.position import Positions, find_positions
from sphereorient.locate.sightings import sightings_of

Numbers = NDArray[np.int64]
Floats = NDArray[np.float64]
MISSED = 1e-4  # share of right matches that may be lost


@dataclass(frozen=True, kw_only=True)
class Match:
    """Disks that may show one sphere, at most one a camera; made by `match_disks`."""

    chosen: tuple[int, ...]  # C, the disk of each camera by index; -1: none
    disks: tuple[Outline | None, ...]  # C
    chi2: float  # of the lines of sight about their nearest point; 0 of a single disk

    @property
    def number(self) -> int:
        """Number of cameras with a disk."""
        return sum(k >= 0 for k in self.chosen)

    def shares(self, other: "Match") -> bool:
        """Return whether a disk is in both."""
        return any(k == m >= 0 for k, m in zip(self.chosen, other.chosen, strict=True))


def match_disks(disks: Sequence[Sequence[Outline]], cameras: Sequence[Camera]) -> list[Match]:
    """Return all choices of disks of C cameras, of one camera or more, whose lines of sight meet within the errors of
    the disks; wrong ones are among them. Those of most cameras come first, then those that meet best.
    """
    chosen = np.full((1, len(disks)), -1)
    for camera, seen in enumerate(disks):  # what does not meet with some disks does not with more
        more = np.repeat(chosen, len(seen), 0)
        more[:, camera] = np.tile(np.arange(len(seen)), len(chosen))
        chosen = np.concatenate([chosen, more[_misfit(more, disks, cameras) <= _most(more)]])
    chosen = chosen[1:]
    misfit = _misfit(chosen, disks, cameras)
    order = np.lexsort((misfit / _most(chosen), -(chosen >= 0).sum(1)))
    return [
        Match(
            chosen=tuple(chosen[n].tolist()),
            disks=tuple(seen[k] if k >= 0 else None for seen, k in zip(disks, chosen[n], strict=True)),
            chi2=float(misfit[n]),
        )
        for n in order
    ]


def assigned(cost: NDArray[np.float64], matches: Sequence[Match]) -> list[tuple[int, int]]:
    """Return pairs (ball, match) of the least sum of costs (n, N): each ball at most once, and each disk for at most
    one ball. Pairs of cost 0 or more are left out.
    """
    ball, match = np.nonzero(cost < 0)
    if not len(ball):
        return []
    disks = sorted({(k, disk) for one in matches for k, disk in enumerate(one.chosen) if disk >= 0})
    rows = np.zeros((len(cost) + len(disks), len(ball)))
    rows[ball, np.arange(len(ball))] = 1
    for row, (k, disk) in enumerate(disks, len(cost)):
        rows[row] = [matches[n].chosen[k] == disk for n in match.tolist()]
    found = milp(
        cost[ball, match],
        integrality=np.ones(len(ball), np.int64),
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(rows, ub=1),
    )
    assert found.x is not None  # leaving all out is a solution
    return [(int(ball[n]), int(match[n])) for n in np.flatnonzero(found.x > 0.5)]


def places_of(matches: Sequence[Match], cameras: Mapping[str, Camera], diameter_mm: float) -> Positions:
    """Return the positions of a sphere of a diameter, mm, at N matches of the cameras' disks; see `find_positions`."""
    seen = {
        name: sightings_of((one.disks[k], Reason.NOT_FOUND if one.disks[k] is None else Reason.OK) for one in matches)
        for k, name in enumerate(cameras)
    }
    return find_positions(seen, cameras, diameter_mm)


def _most(chosen: Numbers) -> Floats:
    """Return the largest chi2 (N,) of a match, by its degrees of freedom."""
    return np.asarray(chi2.isf(MISSED, np.maximum(2 * (chosen >= 0).sum(1) - 3, 1)))


def _misfit(chosen: Numbers, disks: Sequence[Sequence[Outline]], cameras: Sequence[Camera]) -> Floats:
    """Return chi2 (N,) of the middles of chosen disks (N, C) about the point nearest to their lines of sight."""
    if len(cameras) == 1 or not len(chosen):
        return np.zeros(len(chosen))
    nothing = [torch.nan] * 3  # the last row, of index -1
    rows = [
        torch.tensor([*([one.u_px, one.v_px, one.rms_px] for one in seen), nothing], dtype=torch.float64)[index]
        for seen, index in zip(disks, torch.from_numpy(chosen).T, strict=True)
    ]
    X, _ = nearest_point([camera.rays(row[:, :2]) for camera, row in zip(cameras, rows, strict=True)])
    away = [
        (camera.project(X) - row[:, :2]).square().sum(-1) / row[:, 2].square()
        for camera, row in zip(cameras, rows, strict=True)
    ]
    return torch.stack(away).nan_to_num().sum(0).numpy()
