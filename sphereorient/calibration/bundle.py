"""Bundle adjustment: fit all cameras and plate poses together to all points, with covariances."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.solve import inverse_information, least_squares, slopes_along
from sphereorient.calibration.targets import PlateView
from sphereorient.cameras import Camera, ParameterCovariance, in_air
from sphereorient.cameras.checks import check_points
from sphereorient.cameras.parameters import ROTATION, TRANSLATION, parameter_names, with_parameters

POSE_PARTS = len(ROTATION) + len(TRANSLATION)  # of a plate pose: rad, lab, and mm
HELD = ("pixel_pitch_u", "pixel_pitch_v", "sx", "k3")  # scales that f covers, and a term that few lenses need
SOFT = 2.0  # sigmas beyond which the loss of a residual grows linearly
OUTLIER = 6.0  # robust standard deviations beyond which a point is left out
RIM_POINTS = 8  # of each disk; terms beyond the second order of the rim are negligible
ROUNDS = 3  # of fit, perspective bias and outliers
STEPS = 60  # at most, a round
GAIN = (1e-5, 1e-8)  # relative gain of the cost at which a round ends: of all rounds but the last; of the last


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Cameras and the plate's P poses."""

    cameras: Mapping[str, Camera]
    R_lab_plate: Tensor  # (P, 3, 3)
    T_lab_plate_mm: Tensor  # (P, 3), NaN where unknown

    @property
    def posed(self) -> set[int]:
        """Rows of the known poses."""
        return set(torch.nonzero(torch.isfinite(self.T_lab_plate_mm).all(1))[:, 0].tolist())

    def placed(self, row: int, points_plate_mm: NDArray[np.float64]) -> Tensor:
        """Return the points (n, 3) of the plate in the lab, mm, in one of its poses."""
        return torch.from_numpy(points_plate_mm) @ self.R_lab_plate[row].mT + self.T_lab_plate_mm[row]


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenPoints:
    """The n points of the plate that one camera saw, from all pictures."""

    pose: Tensor  # (n,) int64, row of the rig's poses
    points_plate_mm: Tensor  # (n, 3)
    diameter_mm: Tensor  # (n,), of the dot; 0 for corners
    uv_px: Tensor  # (n, 2), measured
    sigma_px: Tensor  # (n,)


def gathered(views: Mapping[int, PlateView]) -> SeenPoints:
    """Join the views of one camera, keyed by the row of the rig's poses."""
    rows = sorted(views)
    names = ("points_plate_mm", "diameter_mm", "uv_px", "sigma_px")
    joined = {name: torch.from_numpy(np.concatenate([getattr(views[row], name) for row in rows])) for name in names}
    pose = torch.cat([torch.full((len(views[row]),), row, dtype=torch.int64) for row in rows])
    return SeenPoints(pose=pose, **joined)


def fitted_parameters(camera: Camera, of_port: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of the fitted parameters: lens, pose, and those of the port in `of_port`."""
    return (*(name for name in parameter_names(in_air(camera)) if name not in HELD), *of_port)


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Residuals and their derivatives as functions of one vector: changes of the cameras, then of the free poses."""

    rig: Rig
    seen: Mapping[str, SeenPoints]
    names: Mapping[str, tuple[str, ...]]  # of each camera's fitted parameters
    fixed: frozenset[int]  # rows of poses that define the lab

    @property
    def free(self) -> list[int]:
        """Rows of the fitted poses: those that a camera saw and that do not define the lab."""
        rows = {row for seen in self.seen.values() for row in seen.pose.tolist()}
        return sorted(rows - self.fixed)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return sum(len(names) for names in self.names.values()) + POSE_PARTS * len(self.free)

    @property
    def labels(self) -> list[str]:
        """Names of the unknowns, such as cam1.f and pose 3, T_x."""
        of_cameras = [f"{camera}.{name}" for camera, names in self.names.items() for name in names]
        return [*of_cameras, *(f"pose {row}, {part}" for row in self.free for part in (*ROTATION, *TRANSLATION))]

    def applied(self, change: Tensor) -> Rig:
        """Return the rig with a vector of changes (size,) applied."""
        shares, poses = self.split(change)
        R, T = self._posed(poses)
        cameras = {name: self._camera(name, share) for name, share in shares.items()}
        return Rig(cameras=cameras, R_lab_plate=R, T_lab_plate_mm=T)

    def shifts(self, rig: Rig) -> dict[str, Tensor]:
        """Return the perspective bias of each dot, (n, 2) px of every camera."""
        shifts = {}
        for name, seen in self.seen.items():
            pose = rig.R_lab_plate[seen.pose], rig.T_lab_plate_mm[seen.pose]
            disks = seen.points_plate_mm[:, None], seen.diameter_mm[:, None]
            shifts[name] = torch.nan_to_num(disk_centre_shift(rig.cameras[name], *pose, *disks)[:, 0])
        return shifts

    def residuals(self, change: Tensor, shifts: Mapping[str, Tensor]) -> Tensor:
        """Return measured minus expected pixels over their sigmas, (2 n,), one camera after the other."""
        shares, poses = self.split(change)
        parts = []
        for name, seen in self.seen.items():
            missed = seen.uv_px - shifts[name] - self._expected(name, shares[name], poses)
            parts.append((missed / seen.sigma_px[:, None]).reshape(-1))
        return torch.cat(parts)

    def slopes(self, change: Tensor) -> Tensor:
        """Return the derivatives of the residuals (2 n, size)."""
        shares, poses = self.split(change)
        (of_share, of_pose), parts = self.split(torch.arange(self.size)), []
        for name, seen in self.seen.items():
            share, block = shares[name], change.new_zeros(len(seen.pose), 2, self.size)
            units = torch.eye(len(share), dtype=torch.float64)
            block[..., of_share[name]] = slopes_along(partial(self._expected, name, poses=poses), share, units)
            units = torch.eye(POSE_PARTS, dtype=torch.float64)[:, None].expand(-1, len(poses), -1)
            by_pose = slopes_along(partial(self._expected, name, share), poses, units)
            for row in self.free:
                first = int(of_pose[row, 0])
                block[seen.pose == row, :, first : first + POSE_PARTS] = by_pose[seen.pose == row]
            parts.append((-block / seen.sigma_px[:, None, None]).flatten(0, 1))
        return torch.cat(parts)

    def split(self, change: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """Return each camera's part of a vector (size,), and the part of all poses, (P, 6)."""
        lengths = [len(names) for names in self.names.values()]
        *shares, poses = torch.split(change, [*lengths, POSE_PARTS * len(self.free)])
        whole = change.new_zeros(len(self.rig.R_lab_plate), POSE_PARTS)
        whole[self.free] = poses.view(-1, POSE_PARTS)
        return dict(zip(self.names, shares, strict=True)), whole

    def _camera(self, name: str, share: Tensor) -> Camera:
        camera = self.rig.cameras[name]
        return with_parameters(camera, self.names[name], share) if self.names[name] else camera

    def _posed(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        return so3.exp(poses[:, :3]) @ self.rig.R_lab_plate, self.rig.T_lab_plate_mm + poses[:, 3:]

    def _expected(self, name: str, share: Tensor, poses: Tensor) -> Tensor:
        seen = self.seen[name]
        R, T = (part[seen.pose] for part in self._posed(poses))
        return self._camera(name, share).project((R @ seen.points_plate_mm[..., None])[..., 0] + T)


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """The result of `adjust`."""

    rig: Rig  # cameras with covariances
    residual_px: Mapping[str, Tensor]  # (n, 2) of each camera, measured minus expected
    used: Mapping[str, Tensor]  # (n,) bool: False for outliers
    scale: float  # standard deviation of the residuals over the given sigmas
    problem: Problem  # its K labels are in the order of the covariance
    covariance: Tensor  # (K, K) float64, of cameras and poses together


def adjust(problem: Problem) -> Fitted:
    """Fit cameras and poses from a start that is near enough to assign each dot to its own image.
    The covariance is the inverse information times the variance of the residuals.
    Source: Triggs et al. 2000 (bundle adjustment); soft L1 loss, Huber 1981.
    """
    change = torch.zeros(problem.size, dtype=torch.float64)
    lengths = [len(seen.pose) for seen in problem.seen.values()]
    good = torch.ones(sum(lengths), dtype=torch.bool)
    for k in range(ROUNDS):
        shifts, rows = problem.shifts(problem.applied(change)), good.repeat_interleave(2)  # rows: u and v of points
        change = _solved(problem, change, shifts, rows, GAIN[k == ROUNDS - 1])
        size = problem.residuals(change, shifts).view(-1, 2).norm(dim=1)
        usual = float(size.nanmedian()) / 1.1774  # the median length of a two-dimensional Gaussian is 1.1774 sigma
        good = size <= OUTLIER * max(usual, 1e-12)
    rig = problem.applied(change)
    residuals, rows = problem.residuals(change, problem.shifts(rig)), good.repeat_interleave(2)
    slopes = problem.slopes(change)[rows]
    scale = float((residuals[rows].square().sum() / max(len(slopes) - problem.size, 1)).sqrt())
    covariance = scale**2 * inverse_information(slopes.mT @ slopes)
    cameras, (shares, _) = {}, problem.split(torch.arange(problem.size))
    for name, camera in rig.cameras.items():
        names, known = problem.names[name], cast(Any, camera)
        own = ParameterCovariance(names=names, matrix=covariance[shares[name]][:, shares[name]]) if names else None
        cameras[name] = replace(known, covariance=own) if names else camera
    parts = dict(zip(problem.seen, torch.split(residuals.view(-1, 2), lengths), strict=True))
    return Fitted(
        rig=replace(rig, cameras=cameras),
        residual_px={name: parts[name] * seen.sigma_px[:, None] for name, seen in problem.seen.items()},
        used=dict(zip(problem.seen, torch.split(good, lengths), strict=True)),
        scale=scale,
        problem=problem,
        covariance=covariance,
    )


def _solved(problem: Problem, start: Tensor, shifts: Mapping[str, Tensor], rows: Tensor, gain: float) -> Tensor:
    return least_squares(
        lambda change: problem.residuals(change, shifts)[rows],
        lambda change: problem.slopes(change)[rows],
        start,
        soft=SOFT,
        gain=gain,
        steps=STEPS,
    )


def disk_centre_shift(
    camera: Camera, R_lab_plate: Tensor, T_lab_plate: Tensor, points_plate: Tensor, dot_diameter: Tensor
) -> Tensor:
    """Return centroid minus image of the centre (..., n, 2), px, for disks of a plate; differentiable in everything.
    Centres (..., n, 3), plate frame, mm, lie in planes z = const; X_lab = R_lab_plate X_plate + T_lab_plate (mm, any
    leading shape); diameters (..., n), mm, 0 for a corner, whose shift is 0. NaN where part of a disk is not imaged.
    Source: Green's theorem, area = 1/2 loop(u dv - v du), area times centroid_u = 1/2 loop(u^2 dv), likewise v.
    """
    check_points("points_plate", points_plate, 3)
    angle = torch.arange(RIM_POINTS, dtype=torch.float64, device=points_plate.device) * (2 * math.pi / RIM_POINTS)
    circle = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1).to(points_plate)
    # A corner would give 0/0: it gets a rim here and shift 0 below.
    is_disk = dot_diameter > 0
    radius = torch.where(is_disk, dot_diameter, torch.ones_like(dot_diameter)) / 2
    centres = points_plate[..., None, :]
    around = torch.cat([centres, centres + radius[..., None, None] * circle], dim=-2)
    uv_px = camera.project(around @ R_lab_plate[..., None, :, :].mT + T_lab_plate[..., None, None, :])
    rim = uv_px[..., 1:, :] - uv_px[..., :1, :]
    # d/d angle of the trigonometric interpolant (Trefethen 2000, chapter 3).
    order = 1j * torch.arange(RIM_POINTS // 2 + 1, device=rim.device)[:, None]
    unit = torch.eye(RIM_POINTS, dtype=torch.float64, device=rim.device)
    along = torch.fft.irfft(order * torch.fft.rfft(unit, dim=0), n=RIM_POINTS, dim=0).to(rim) @ rim
    u, v = rim.unbind(-1)
    du, dv = along.unbind(-1)
    twice_area = (u * dv - v * du).sum(-1)
    shift = torch.stack([(u * u * dv).sum(-1), -(v * v * du).sum(-1)], dim=-1) / twice_area[..., None]
    return torch.where(is_disk[..., None], shift, torch.zeros_like(shift))
