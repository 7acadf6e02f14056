from collections.abc import Mapping
from dataclasses import replace
from itertools import chain, combinations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from sphereorient.calibration.solve import slopes_along
from sphereorient.cameras import Camera, ParameterCovariance, R_cam_view
from sphereorient.cameras.parameters import with_parameters
from sphereorient.trajectory import Trajectory

CAP_RINGS = (0.35, 0.75)  # of the radius: points of the visible cap
PER_RING = 6  # points of each of these
DIRECT_FRAMES = 200  # positions computed directly; a quadratic in position interpolates between them


def systematic_errors(
    cameras: Mapping[str, Camera], covariance: ParameterCovariance, position_lab_mm: Tensor, radius_mm: float
) -> tuple[Tensor, Tensor]:
    """Return the covariances (N, 3, 3) of errors common to all frames, due to the cameras' covariance: of the position
    (N, 3), lab, mm^2, NaN for NaN positions, and of delta in R_true = exp([delta]x) R, lab, rad^2. Parameters are named
    camera.parameter. A small camera error has the effect of a small change of pose on cap and limb.
    Source: first-order propagation of errors; least squares of the pose with fixed design.
    """
    known = torch.isfinite(position_lab_mm).all(-1)
    positions = position_lab_mm[known].double()
    some = positions
    if len(positions) > DIRECT_FRAMES:
        some = positions[torch.linspace(0, len(positions) - 1, DIRECT_FRAMES).round().long()]
    effect = _pose_by_parameters(cameras, covariance.names, some, radius_mm)
    if some is not positions:
        # Positions in a plane leave terms of the quadratic open; this driver allows that, and it is reproducible.
        law = torch.linalg.lstsq(_quadratic(some, some), effect.flatten(1), driver="gelsd").solution
        effect = (_quadratic(positions, some) @ law).unflatten(1, effect.shape[1:])
    whole = position_lab_mm.new_full((len(known), 6, 6), torch.nan, dtype=torch.float64)
    whole[known] = effect @ covariance.matrix @ effect.mT
    return whole[:, 3:, 3:], whole[:, :3, :3]


def _quadratic(positions: Tensor, usual: Tensor) -> Tensor:
    """Return all monomials (N, 10) up to second order of positions (N, 3), standardised by `usual`."""
    x = (positions - usual.mean(0)) / usual.std(0).clamp_min(1e-6)
    products = [x[:, i : i + 1] * x[:, i:] for i in range(3)]
    return torch.cat([torch.ones_like(x[:, :1]), x, *products], dim=1)


def _pose_by_parameters(
    cameras: Mapping[str, Camera], names: tuple[str, ...], positions: Tensor, radius_mm: float
) -> Tensor:
    """Return the derivative (N, 6, P) of the fitted pose (delta in rad, position in mm) by the parameters."""
    information = positions.new_zeros(len(positions), 6, 6)
    pull = positions.new_zeros(len(positions), 6, len(names))
    for name, camera in cameras.items():
        own = [k for k, label in enumerate(names) if label.rpartition(".")[0] == name]
        by_pose, by_parameter = _slopes(camera, [names[k].rpartition(".")[2] for k in own], positions, radius_mm)
        information += by_pose.mT @ by_pose
        # The picture is fixed: the pose cancels the effect of the parameters.
        pull[:, :, own] -= by_pose.mT @ by_parameter
    scale = information.diagonal(dim1=-2, dim2=-1).rsqrt()
    scaled = scale[..., None] * information * scale[..., None, :]
    effect: Tensor = scale[..., None] * torch.linalg.solve(scaled, scale[..., None] * pull)
    return effect


def _slopes(camera: Camera, names: list[str], positions: Tensor, radius_mm: float) -> tuple[Tensor, Tensor]:
    """Return the derivatives of cap and limb pixels by pose (N, M, 6) and parameters (N, M, P), px."""
    towards = normalize(camera.rays(camera.project(positions)).direction_lab, dim=-1)
    R_lab_view = camera.R_cam_lab.mT @ R_cam_view(towards @ camera.R_cam_lab.mT)
    cap = torch.cat([_ring(share, PER_RING, k * torch.pi / PER_RING) for k, share in enumerate(CAP_RINGS)])
    paint, limb = (pattern @ R_lab_view.mT * radius_mm for pattern in (cap, _ring(1.0, 12)))
    count = len(cap)
    arms = torch.cat([paint, _grazed(camera, positions, limb, radius_mm)], dim=1)
    points = positions[:, None] + arms

    def changed(delta: Tensor) -> Tensor:
        return with_parameters(camera, names, delta).project(points)

    axes, units = torch.eye(3, dtype=torch.float64), torch.eye(len(names), dtype=torch.float64)
    by_place = slopes_along(camera.project, points, [axis.expand_as(points) for axis in axes])
    by_parameter = slopes_along(changed, torch.zeros(len(names), dtype=torch.float64), units)
    # A rotation delta moves a point of the surface by delta x arm; the limb stays.
    lever = torch.linalg.cross(axes.expand(*arms.shape[:2], 3, 3), arms[..., None, :].expand(*arms.shape[:2], 3, 3))
    by_turn = by_place @ lever.mT
    by_turn[:, count:] = 0.0
    outward = normalize(camera.project(points) - camera.project(positions)[:, None], dim=-1)

    def visible(slopes: Tensor) -> Tensor:
        along = (outward[:, count:, :, None] * slopes[:, count:]).sum(2)  # motion along the limb is invisible
        return torch.cat([slopes[:, :count].flatten(1, 2), along], dim=1)

    return visible(torch.cat([by_turn, by_place], dim=-1)), visible(by_parameter)


def _grazed(camera: Camera, positions: Tensor, arms: Tensor, radius_mm: float) -> Tensor:
    """Return arms (N, M, 3), lab, mm, to the tangent points of lines of sight, which move with the limb."""
    outward = normalize(arms, dim=-1)
    for _ in range(4):  # each reduces the error by the factor radius over distance
        along = camera.rays(camera.project(positions[:, None] + arms)).direction_lab
        arms = radius_mm * normalize(outward - (outward * along).sum(-1, keepdim=True) * along, dim=-1)
    return arms


def _ring(share: float, count: int, turned: float = 0.0) -> Tensor:
    """Return unit vectors (count, 3) at a share of the radius, in the view frame (z along the line of sight)."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * torch.pi / count) + turned
    depth = -torch.full_like(angle, (1 - share**2) ** 0.5)
    return torch.stack([share * angle.cos(), share * angle.sin(), depth], dim=-1)


def with_systematic_errors(
    track: Trajectory, cameras: Mapping[str, Camera], covariance: ParameterCovariance | None, radius_mm: float
) -> Trajectory:
    """Add the calibration's systematic errors to the poses; no change without a covariance of the camera parameters."""
    if covariance is None:
        return track
    position = torch.from_numpy(track.position)
    place, turn = torch.from_numpy(track.position_cov * np.nan), torch.from_numpy(track.orientation_cov * np.nan)
    saw = dict(zip(track.cameras, track.believed.T, strict=True))
    for some in chain.from_iterable(combinations(cameras, count) for count in range(1, len(cameras) + 1)):
        rows = torch.from_numpy(np.all([saw[name] == (name in some) for name in cameras], axis=0))
        if bool(rows.any()):
            own = {name: cameras[name] for name in some}
            place[rows], turn[rows] = systematic_errors(own, covariance, position[rows], radius_mm)
    return replace(track, position_systematic_cov=place.numpy(), orientation_systematic_cov=turn.numpy())


def lasting_in_use(use: Tensor, covariance: Tensor, alone: Tensor) -> Tensor:
    """Return the lasting errors (N, 6, 6) of poses by the cameras in use, (N, C) bool; see `with_lasting_errors`."""
    # Errors of the cameras are independent: fewer cameras in use average them less.
    together = (use.shape[1] / use.sum(1).clamp_min(min(2, use.shape[1])))[:, None, None] * covariance
    single = (use.to(torch.float64) @ alone.flatten(1)).reshape(-1, 6, 6)
    return torch.where((use.sum(1) == 1)[:, None, None], single, together)


def with_lasting_errors(track: Trajectory, covariance: Tensor, alone: Tensor) -> Trajectory:
    """Add the errors common to all frames, which no path averages away, to the covariances of the poses.
    Covariances of delta (rad, lab) and position (mm): (6, 6) by all cameras together, (C, 6, 6) by each alone.
    """
    whole = lasting_in_use(torch.from_numpy(track.believed), covariance, alone).numpy()
    turn, place = whole[:, :3, :3], whole[:, 3:, 3:]
    return replace(
        track,
        position_cov=track.position_cov + place,
        position_smooth_cov=track.position_smooth_cov + place,
        orientation_cov=track.orientation_cov + turn,
        orientation_smooth_cov=track.orientation_smooth_cov + turn,
    )
