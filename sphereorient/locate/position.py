"""Position of the sphere in the lab: from two rays or more, or from one ray and the radius."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.cameras import Camera, Rays, nearest_point
from sphereorient.errors import ExperimentError, Flag, refusal
from sphereorient.locate.sightings import Sightings

NOT_MEASURED = int(Flag.POSITION_INTERPOLATED | Flag.POSITION_OUTLIER_REPLACED)


@dataclass(frozen=True, kw_only=True, eq=False)
class Positions:
    """Sphere centres in N frames; made by `find_positions`."""

    position_lab_mm: Tensor  # (N, 3), NaN without a centre
    covariance_mm2: Tensor  # (N, 3, 3), NaN if not measured
    gap_mm: Tensor  # (N,), largest distance of two rays, NaN with one
    flags: Tensor

    def for_motion(self) -> Tensor:
        """Return positions from several rays, or all without any, (N, 3), mm; a mixture would look like motion."""
        several = torch.isfinite(self.gap_mm)
        return torch.where(several[:, None] | ~several.any(), self.position_lab_mm, torch.nan)

    @property
    def measured(self) -> Tensor:
        """Frames whose position comes from their own outlines, (N,) bool."""
        return torch.isfinite(self.position_lab_mm).all(-1) & ((self.flags & NOT_MEASURED) == 0)


def find_positions(
    sightings: Mapping[str, Sightings], cameras: Mapping[str, Camera], diameter_mm: float | None
) -> Positions:
    """Return the sphere's positions in N frames from the outlines of the cameras; in radii without a diameter.
    Lines of sight count by the covariance of the centres. With one outline the distance comes from its radius: flag
    `ONE_CAMERA`.

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
    from_size_mm: Tensor  # (N, 3), on the ray, at the distance from the radius
    across: Tensor  # (N, 3, 3), information across the ray, of the centre alone, 1/mm^2; 1 px where not measured
    whole: Tensor  # (N, 3, 3), of centre and radius


def _view(seen: Sightings, camera: Camera, radius_mm: float) -> _View:
    rays = camera.rays(seen.centre_px)
    rim = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=seen.centre_px.dtype)
    limb = camera.rays(seen.centre_px[:, None] + rim * seen.radius_px[:, None, None])
    # Sine of the angle between the rays of centre and limb: exact for small angles.
    away = torch.linalg.cross(rays.direction_lab[:, None].expand_as(limb.direction_lab), limb.direction_lab)
    sine = away.norm(dim=-1).mean(1)
    distance = radius_mm / sine
    # Behind a port the rays start apart: subtract this part of the distance.
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
        whole=px_mm.mT @ torch.linalg.inv(covariance) @ px_mm,
    )


def _inverse(information: Tensor) -> Tensor:
    finite = torch.isfinite(information).all(-1).all(-1) & (torch.linalg.det(torch.nan_to_num(information)) > 0)
    view = torch.eye(3, dtype=information.dtype)
    inverse = torch.linalg.inv(torch.where(finite[:, None, None], information, view))
    return torch.where(finite[:, None, None], inverse, torch.nan)
