"""Positions of spheres in the lab, from two rays or more, or from one ray and the radius; and the matching of disks of
several cameras whose lines of sight meet.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.special import chdtri
from torch import Tensor

from sphereorient.cameras import Camera, Rays, nearest_point
from sphereorient.errors import ExperimentError, Flag, Reason, refusal
from sphereorient.locate.outline import Outline
from sphereorient.locate.sightings import Sightings, sightings_of

NOT_MEASURED = int(Flag.POSITION_INTERPOLATED | Flag.POSITION_OUTLIER_REPLACED)
Numbers = NDArray[np.int64]
Floats = NDArray[np.float64]
MISSED = 1e-4  # allowed share of lost right matches


@dataclass(frozen=True, kw_only=True, eq=False)
class Positions:
    """Sphere centres in N frames."""

    position_lab_mm: Tensor  # (N, 3), NaN without a centre
    covariance_mm2: Tensor  # (N, 3, 3), NaN if not measured
    gap_mm: Tensor  # (N,), largest distance of two rays, NaN with one
    flags: Tensor

    def for_motion(self) -> Tensor:
        """Return positions from several rays, (N, 3), mm, or all without any; a mixture would appear as motion."""
        several = torch.isfinite(self.gap_mm)
        return torch.where(several[:, None] | ~several.any(), self.position_lab_mm, torch.nan)

    @property
    def measured(self) -> Tensor:
        """Frames with a position from their own outlines, (N,) bool."""
        return torch.isfinite(self.position_lab_mm).all(-1) & ((self.flags & NOT_MEASURED) == 0)


def find_positions(
    sightings: Mapping[str, Sightings], cameras: Mapping[str, Camera], diameter_mm: float | None
) -> Positions:
    """Return the sphere's positions in N frames from the outlines of the cameras; in radii without a diameter.
    Lines of sight are weighted by the covariance of the centres. With one outline the distance comes from its radius
    (flag `ONE_CAMERA`).

    Raises:
        ExperimentError: several cameras and an unknown diameter.
    Source: paper section III A (triangulation).
    """
    if diameter_mm is None and len(sightings) > 1:
        got, do = f"null, {len(sightings)} cameras", "give the diameter, or track with one camera"
        raise ExperimentError(refusal("sphere.diameter", expected="a number of mm", got=got, do=do))
    radius_mm = 1.0 if diameter_mm is None else diameter_mm / 2
    views = [_view(seen, cameras[name], radius_mm) for name, seen in sightings.items()]
    placed = torch.stack([seen.placed for seen in sightings.values()])
    one = placed.sum(0) == 1
    flags = torch.where(one, int(Flag.ONE_CAMERA), 0)
    information, toward = torch.zeros(len(one), 3, 3).double(), torch.zeros(len(one), 3, 1).double()
    for view, seen, ok in zip(views, sightings.values(), placed, strict=True):
        known = torch.where(one[:, None, None], view.whole, view.across)
        information = information + torch.where(ok[:, None, None], known, 0.0)
        toward = toward + torch.where(ok[:, None, None], known @ view.from_size_mm[:, :, None], 0.0)
        flags = flags | torch.where(ok, seen.flags, 0)
    covariance = _inverse(information)
    position = (covariance @ toward)[:, :, 0]
    gap = nearest_point([view.rays for view in views])[1] if len(views) > 1 else position[:, 0] * torch.nan
    covariance = torch.where((flags & NOT_MEASURED == 0)[:, None, None], covariance, torch.nan)
    return Positions(position_lab_mm=position, covariance_mm2=covariance, gap_mm=gap, flags=flags)


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    rays: Rays  # (N), to the centre of the outline
    from_size_mm: Tensor  # (N, 3), on the ray, at the distance by the radius; arbitrary for parallel rays
    across: Tensor  # (N, 3, 3), information across the ray by the centre alone, 1/mm^2; of 1 px if not measured
    whole: Tensor  # (N, 3, 3), by centre and radius; NaN for parallel rays


def _view(seen: Sightings, camera: Camera, radius_mm: float) -> _View:
    rays = camera.rays(seen.centre_px)
    rim = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=seen.centre_px.dtype)
    limb = camera.rays(seen.centre_px[:, None] + rim * seen.radius_px[:, None, None])
    # Sine of the angle between the rays of centre and limb, exact for small angles.
    away = torch.linalg.cross(rays.direction_lab[:, None].expand_as(limb.direction_lab), limb.direction_lab)
    sine = away.norm(dim=-1).mean(1)
    parallel = sine == 0  # telecentric: pictures do not show the distance, and any value serves
    sine = torch.where(parallel, 1.0, sine)
    distance = radius_mm / sine
    # Behind a port the rays have different origins: subtract this part of the distance.
    begun = torch.linalg.cross(rays.origin_lab_mm[:, None] - limb.origin_lab_mm, limb.direction_lab)
    before = (begun * away).sum(-1).mean(1) / sine.square()
    along = (distance - before)[:, None]
    edge = limb.origin_lab_mm + along[:, None] * limb.direction_lab
    right, down = ((edge[:, k] - edge[:, k + 1]) / 2 for k in (0, 2))
    mm_px = torch.stack([right, down, -distance[:, None] * rays.direction_lab], -1) / seen.radius_px[:, None, None]
    unit = torch.eye(3).double()
    px_mm = torch.linalg.inv(torch.where(seen.placed[:, None, None], mm_px, unit))  # (u, v, radius) by position
    covariance = torch.where(torch.isfinite(seen.covariance_px2), seen.covariance_px2, unit)
    return _View(
        rays=rays,
        from_size_mm=rays.origin_lab_mm + along * rays.direction_lab,
        across=px_mm[:, :2].mT @ torch.linalg.inv(covariance[:, :2, :2]) @ px_mm[:, :2],
        whole=torch.where(parallel[:, None, None], torch.nan, px_mm.mT @ torch.linalg.inv(covariance) @ px_mm),
    )


def _inverse(information: Tensor) -> Tensor:
    finite = torch.isfinite(information).all(-1).all(-1) & (torch.linalg.det(torch.nan_to_num(information)) > 0)
    view = torch.eye(3, dtype=information.dtype)
    inverse = torch.linalg.inv(torch.where(finite[:, None, None], information, view))
    return torch.where(finite[:, None, None], inverse, torch.nan)


@dataclass(frozen=True, kw_only=True)
class Match:
    """Disks that may show one sphere, at most one per camera."""

    chosen: tuple[int, ...]  # C, the disk of each camera by index; -1: none
    disks: tuple[Outline | None, ...]  # C
    chi2: float  # of the lines of sight about their nearest point; 0 for a single disk

    @property
    def number(self) -> int:
        """Number of cameras with a disk."""
        return sum(k >= 0 for k in self.chosen)

    def shares(self, other: "Match") -> bool:
        """Return whether the matches have a disk in common."""
        return any(k == m >= 0 for k, m in zip(self.chosen, other.chosen, strict=True))


def match_disks(disks: Sequence[Sequence[Outline]], cameras: Sequence[Camera]) -> list[Match]:
    """Return all choices of disks, at most one for each of C cameras, whose lines of sight meet within the errors of
    the disks, wrong ones included. Choices of most cameras come first, then those that meet best.
    """
    chosen = np.full((1, len(disks)), -1)
    for camera, seen in enumerate(disks):  # disks that do not meet do not with further ones
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
    """Return pairs (ball, match) of least sum of costs (n, N), below 0; each ball and each disk at most once."""
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
    assert found.x is not None  # no pairs at all is a solution
    return [(int(ball[n]), int(match[n])) for n in np.flatnonzero(found.x > 0.5)]


def places_of(matches: Sequence[Match], cameras: Mapping[str, Camera], diameter_mm: float) -> Positions:
    """Return the positions of a sphere of a diameter, mm, at N matches of the cameras' disks; see `find_positions`."""
    seen = {
        name: sightings_of((one.disks[k], Reason.NOT_FOUND if one.disks[k] is None else Reason.OK) for one in matches)
        for k, name in enumerate(cameras)
    }
    return find_positions(seen, cameras, diameter_mm)


def _most(chosen: Numbers) -> Floats:
    """Return the largest chi2 (N,) of right matches, by their degrees of freedom."""
    return np.asarray(chdtri(np.maximum(2 * (chosen >= 0).sum(1) - 3, 1), MISSED))


def _misfit(chosen: Numbers, disks: Sequence[Sequence[Outline]], cameras: Sequence[Camera]) -> Floats:
    """Return chi2 (N,) of the middles of chosen disks (N, C) about the point nearest to their lines of sight."""
    if len(cameras) == 1 or not len(chosen):
        return np.zeros(len(chosen))
    nothing = [torch.nan] * 3  # the last row, for index -1
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
