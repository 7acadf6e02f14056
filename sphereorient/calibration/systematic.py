"""What errors of the calibration do to a track: the part of position and orientation that no averaging removes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.calibration.slopes import slopes_along
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.cameras.parameters import with_parameters
from sphereorient.cameras.sight import R_cam_view

CAP_RINGS = (0.35, 0.75)  # of the radius: where paint is looked at
PER_RING = 6
LIMB_POINTS = 12
GRAZING_ROUNDS = 4  # each brings the grazed point nearer by the ball's radius over its distance
DIRECT_FRAMES = 200  # at so many places the effect is computed; it is smooth, a quadratic in place tells it in between


@dataclass(frozen=True, kw_only=True, eq=False)
class Systematic:
    """Covariances of the errors that all frames share, N frames; made by `systematic_errors`."""

    position_mm2: Tensor  # (N, 3, 3), lab
    orientation_rad2: Tensor  # (N, 3, 3), of delta in R_true = exp([delta]x) R, lab


def systematic_errors(
    cameras: Mapping[str, Camera], covariance: ParameterCovariance, position_lab_mm: Tensor, radius_mm: float
) -> Systematic:
    """Carry the covariance of camera parameters through to position and orientation.

    Cameras that are a little wrong show the same picture for a ball that stands a little elsewhere: that change of
    pose is linear in the parameters' errors, and is found from points of the visible cap and of the limb.

    Args:
        cameras: those the track was made with.
        covariance: of the parameters of all of them, named camera.parameter; errors of different cameras may be
            correlated, as they are after a joint fit.
        position_lab_mm: (N, 3), lab; NaN where there is none.
        radius_mm: of the sphere.

    Returns:
        The covariances; NaN where there is no position.

    Source: first-order propagation of errors; least squares of the pose with fixed design.
    """
    known = torch.isfinite(position_lab_mm).all(-1)
    places = position_lab_mm[known].double()
    if len(places) > DIRECT_FRAMES:
        rows = torch.linspace(0, len(places) - 1, DIRECT_FRAMES).round().long()
        some = _pose_by_parameters(cameras, covariance.names, places[rows], radius_mm)
        basis, target = _quadratic(places[rows], places[rows]), some.flatten(1)
        effect = (_quadratic(places, places[rows]) @ torch.linalg.lstsq(basis, target).solution).unflatten(
            1, some.shape[1:]
        )
    else:
        effect = _pose_by_parameters(cameras, covariance.names, places, radius_mm)
    whole = effect @ covariance.matrix @ effect.mT
    parts = []
    for block in (slice(3, 6), slice(0, 3)):
        part = position_lab_mm.new_full((len(known), 3, 3), torch.nan, dtype=torch.float64)
        part[known] = whole[:, block, block]
        parts.append(part)
    return Systematic(position_mm2=parts[0], orientation_rad2=parts[1])


def _quadratic(places: Tensor, usual: Tensor) -> Tensor:
    """Return all monomials up to the second order of places (N, 3), scaled by where the usual ones lie, (N, 10)."""
    x = (places - usual.mean(0)) / usual.std(0).clamp_min(1e-6)
    products = [x[:, i : i + 1] * x[:, i:] for i in range(3)]
    return torch.cat([torch.ones_like(x[:, :1]), x, *products], dim=1)


def _pose_by_parameters(
    cameras: Mapping[str, Camera], names: tuple[str, ...], places: Tensor, radius_mm: float
) -> Tensor:
    """Return how the fitted pose (delta in rad, place in mm) changes with the parameters, (N, 6, P)."""
    information = places.new_zeros(len(places), 6, 6)
    pull = places.new_zeros(len(places), 6, len(names))
    for name, camera in cameras.items():
        # Parameters of cameras that do not see the ball have no part in it.
        own = [k for k, label in enumerate(names) if label.partition(".")[0] == name]
        by_pose, by_parameter = _slopes(camera, [names[k].partition(".")[2] for k in own], places, radius_mm)
        information += by_pose.mT @ by_pose
        # The picture stays as it is: what the parameters change, the pose must take back.
        pull[:, :, own] -= by_pose.mT @ by_parameter
    scale = information.diagonal(dim1=-2, dim2=-1).rsqrt()
    scaled = scale[..., None] * information * scale[..., None, :]
    effect: Tensor = scale[..., None] * torch.linalg.solve(scaled, scale[..., None] * pull)
    return effect


def _slopes(camera: Camera, names: list[str], places: Tensor, radius_mm: float) -> tuple[Tensor, Tensor]:
    """Return how the pictures of paint and limb move with pose and parameters, (N, M, 6) and (N, M, P), px."""
    towards = torch.nn.functional.normalize(camera.rays(camera.project(places)).direction_lab, dim=-1)
    R_lab_view = camera.R_cam_lab.mT @ R_cam_view(towards @ camera.R_cam_lab.mT)
    paint, limb = (pattern @ R_lab_view.mT * radius_mm for pattern in (_cap(), _limb()))
    arms = torch.cat([paint, _grazed(camera, places, limb, radius_mm)], dim=1)
    points = places[:, None] + arms

    def shown(x: Tensor) -> Tensor:
        return camera.project(x)

    def changed(delta: Tensor) -> Tensor:
        return with_parameters(camera, names, delta).project(points)

    axes, units = torch.eye(3, dtype=torch.float64), torch.eye(len(names), dtype=torch.float64)
    by_place = slopes_along(shown, points, [axis.expand_as(points) for axis in axes])
    by_parameter = slopes_along(changed, torch.zeros(len(names), dtype=torch.float64), units)
    # A turn delta moves a point of the surface by delta x arm; the limb it does not move at all.
    lever = torch.linalg.cross(axes.expand(*arms.shape[:2], 3, 3), arms[..., None, :].expand(*arms.shape[:2], 3, 3))
    by_turn = by_place @ lever.mT
    by_turn[:, len(_cap()) :] = 0.0
    whole = torch.cat([by_turn, by_place], dim=-1)
    outward = torch.nn.functional.normalize(camera.project(points) - camera.project(places)[:, None], dim=-1)
    count = len(_cap())
    parts = []
    for slopes in (whole, by_parameter):
        along = (outward[:, count:, :, None] * slopes[:, count:]).sum(2)  # of the limb only what goes outwards is seen
        parts.append(torch.cat([slopes[:, :count].flatten(1, 2), along], dim=1))
    return parts[0], parts[1]


def _grazed(camera: Camera, places: Tensor, arms: Tensor, radius_mm: float) -> Tensor:
    """Return arms (N, M, 3), lab, mm, to where lines of sight graze the ball: a little before its middle.

    Only of these points the picture's way outwards is that of the limb, whatever else they do.
    """
    outward = torch.nn.functional.normalize(arms, dim=-1)
    for _ in range(GRAZING_ROUNDS):
        along = camera.rays(camera.project(places[:, None] + arms)).direction_lab
        arms = radius_mm * torch.nn.functional.normalize(
            outward - (outward * along).sum(-1, keepdim=True) * along, dim=-1
        )
    return arms


def _cap() -> Tensor:
    """Return unit vectors of the visible cap in the view frame (z along the line of sight), (M, 3)."""
    angle = torch.arange(PER_RING, dtype=torch.float64) * (2 * torch.pi / PER_RING)
    rings = []
    for k, share in enumerate(CAP_RINGS):
        turned = angle + k * torch.pi / PER_RING
        depth = -torch.full_like(angle, (1 - share**2) ** 0.5)
        rings.append(torch.stack([share * turned.cos(), share * turned.sin(), depth], dim=-1))
    return torch.cat(rings)


def _limb() -> Tensor:
    angle = torch.arange(LIMB_POINTS, dtype=torch.float64) * (2 * torch.pi / LIMB_POINTS)
    return torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
