"""Cameras that were bumped, put right again by the sphere that they filmed: one ball, in one place, in one attitude."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.slopes import slopes_along
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.cameras.parameters import ROTATION, TRANSLATION, with_parameters
from sphereorient.errors import CameraError, refusal

MOVED = (*ROTATION, *TRANSLATION)
PRIOR = np.array([0.1] * 3 + [2.0] * 3)  # how far a camera may have been pushed, rad and mm
BIAS_RAD = np.deg2rad(0.08)  # constant turn by which one camera alone may be off: a dark rim pulls its centre
SHARED = 12  # frames that share one error of the centre: neighbours see the same light
HELD_SHARE = 0.5  # of the prior: what is known no better afterwards was not determined
FRAMES_MIN = 20
OUTLIER = 5.0  # robust standard deviations beyond which a frame is left out
ROUNDS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Told:
    """What one camera says of the sphere by itself, N frames; NaN where nothing."""

    centre_px: Tensor  # (N, 2)
    R_lab_body: Tensor  # (N, 3, 3), as the camera before the repair says


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """Cameras that fit together; made by `self_calibrate`."""

    cameras: Mapping[str, Camera]
    moved: Mapping[str, Tensor]  # camera -> (6,) rotation (rad, camera frame) and T (mm), as `with_parameters` has it
    sigma: Mapping[str, Tensor]  # camera -> (6,)
    held: tuple[str, ...]  # what the sphere does not determine: kept near what it was
    gap_before_mm: float  # rms distance of the lines of sight to the sphere's centre
    gap_after_mm: float
    frames: int


def self_calibrate(cameras: Mapping[str, Camera], told: Mapping[str, Told]) -> Repaired:
    """Turn and move cameras until they see one ball in one place and one attitude.

    The first camera stays: that both move together, and the lab with them, no ball can tell. Lines of sight must meet,
    and orientations agree up to a small constant turn; how far apart the cameras stand, and what moves a line of sight
    within the plane of the other, only the sphere's apparent size would tell, worse than any calibration: it is held.

    Args:
        cameras: two or more.
        told: of each.

    Raises:
        CameraError: one camera, or too few frames that both saw.
    """
    names = list(cameras)
    if len(names) < 2:
        do = "give the track of both cameras"
        raise CameraError(refusal("cameras", expected="two or more that saw the ball", got=f"{len(names)}", do=do))
    first, repaired = names[0], dict(cameras)
    moved, sigma, held = {}, {}, [f"{names[0]}: all (the lab frame)"]
    before, after, count = [], [], 0
    for name in names[1:]:
        pair = _Pair(cameras[first], cameras[name], told[first], told[name])
        change, spread, free = pair.solved()
        repaired[name] = with_parameters(cameras[name], MOVED, change)
        moved[name], sigma[name] = change, spread
        held += [f"{name}.{part}" for part, told_of in zip(MOVED, free, strict=True) if not told_of]
        before.append(pair.gaps(torch.zeros(6, dtype=torch.float64)))
        after.append(pair.gaps(change))
        count += len(pair)
        known = cameras[name].covariance
        if known is not None:
            repaired[name] = _with_spread(repaired[name], known, spread)
    return Repaired(
        cameras=repaired,
        moved=moved,
        sigma=sigma,
        held=tuple(held),
        gap_before_mm=_rms(torch.cat(before)),
        gap_after_mm=_rms(torch.cat(after)),
        frames=count,
    )


class _Pair:
    """Residuals of one camera against the first."""

    def __init__(self, still: Camera, loose: Camera, told_still: Told, told_loose: Told) -> None:
        both = torch.isfinite(told_still.centre_px).all(-1) & torch.isfinite(told_loose.centre_px).all(-1)
        both &= torch.isfinite(told_still.R_lab_body).all(-1).all(-1)
        both &= torch.isfinite(told_loose.R_lab_body).all(-1).all(-1)
        if int(both.sum()) < FRAMES_MIN:
            expected = f"{FRAMES_MIN} frames or more in which both cameras tell the ball's orientation"
            do = "pass a longer track, made with both cameras"
            raise CameraError(refusal("track", expected=expected, got=f"{int(both.sum())}", do=do))
        self.loose = loose
        self.ray = still.rays(told_still.centre_px[both])
        self.centre_px = told_loose.centre_px[both]
        self.R_still = told_still.R_lab_body[both]
        # What the camera saw of the body, whatever its own place in the lab.
        self.R_view_body = _R_lab_view(loose, self.centre_px).mT @ told_loose.R_lab_body[both]

    def __len__(self) -> int:
        return len(self.centre_px)

    def gaps(self, change: Tensor) -> Tensor:
        """Signed distances (N,) of the two lines of sight, mm."""
        ray = with_parameters(self.loose, MOVED, change).rays(self.centre_px)
        across = torch.linalg.cross(self.ray.direction_lab, ray.direction_lab)
        apart: Tensor = ((ray.origin_lab_mm - self.ray.origin_lab_mm) * across).sum(-1) / across.norm(dim=-1)
        return apart

    def turns(self, change: Tensor) -> Tensor:
        """Turns (N, 3) from what the loose camera says of the orientation to what the still one says, rad, lab."""
        camera = with_parameters(self.loose, MOVED, change)
        return so3.log(self.R_still @ (_R_lab_view(camera, self.centre_px) @ self.R_view_body).mT)

    def solved(self) -> tuple[Tensor, Tensor, NDArray[np.bool_]]:
        """Return the change (6,), its standard deviations, and which of its parts the sphere determines."""
        # Nothing is held fast: a wrong place that is held would bend the turn that goes with it.
        at, spread = self._improved(np.zeros(9), PRIOR)
        free = spread[:6] <= HELD_SHARE * PRIOR
        return torch.from_numpy(at[:6].copy()), torch.from_numpy(spread[:6].copy()), free

    def _improved(self, at: NDArray[Any], prior: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        scatter = self._scatter(at, prior)
        for _ in range(ROUNDS):  # the scatter is measured at the solution
            at = least_squares(self._residuals, at, jac=self._jacobian, x_scale="jac", args=(scatter,)).x
            scatter = self._scatter(at, prior)
        slopes = self._jacobian(at, scatter)
        return at, np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))

    def _scatter(self, at: NDArray[Any], prior: NDArray[Any]) -> _Scatter:
        change = torch.from_numpy(at[:6])
        told = torch.cat([self.gaps(change)[:, None], self.turns(change)], dim=-1)
        away = told - told.median(dim=0).values
        spread = (1.4826 * away.abs().median(dim=0).values).clamp_min(1e-6)
        # A soft loss is not enough: the prior would be softened with it, and a few mirror images pull for ever.
        kept = (away.abs() <= OUTLIER * spread).all(-1)
        return _Scatter(gap_mm=float(spread[0]), turn_rad=spread[1:], kept=kept, prior=torch.from_numpy(prior))

    def _residuals(self, at: NDArray[Any], scatter: _Scatter) -> NDArray[Any]:
        return np.asarray(self._stacked(torch.from_numpy(at), scatter).numpy())

    def _jacobian(self, at: NDArray[Any], scatter: _Scatter) -> NDArray[Any]:
        def stacked(x: Tensor) -> Tensor:
            return self._stacked(x, scatter)

        return np.asarray(slopes_along(stacked, torch.from_numpy(at), torch.eye(9, dtype=torch.float64)).numpy())

    def _stacked(self, at: Tensor, scatter: _Scatter) -> Tensor:
        shared = SHARED**0.5
        gap = self.gaps(at[:6])[scatter.kept] / (scatter.gap_mm * shared)
        turn = (self.turns(at[:6]) - at[6:])[scatter.kept] / (scatter.turn_rad * shared)
        return torch.cat([gap, turn.reshape(-1), at[:6] / scatter.prior, at[6:] / BIAS_RAD])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Scatter:
    """How far frames lie apart, and which are no outliers."""

    gap_mm: float
    turn_rad: Tensor  # (3,)
    kept: Tensor  # (N,) bool
    prior: Tensor  # (6,)


def _R_lab_view(camera: Camera, uv_px: Tensor) -> Tensor:
    """Return a frame (N, 3, 3) fixed to what the camera sees at pixels: z along the line of sight, x along rows."""
    step = torch.zeros_like(uv_px)
    step[:, 0] = 1.0
    z = camera.rays(uv_px).direction_lab
    x = camera.rays(uv_px + step).direction_lab - camera.rays(uv_px - step).direction_lab
    x = torch.nn.functional.normalize(x - (x * z).sum(-1, keepdim=True) * z, dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def _with_spread(camera: Camera, known: ParameterCovariance, spread: Tensor) -> Camera:
    """Put the spread of what was moved in the place of what was known of it; correlations with the lens are lost."""
    matrix = known.matrix.clone()
    for part, sigma in zip(MOVED, spread.tolist(), strict=True):
        if part in known.names:
            k = known.names.index(part)
            matrix[k], matrix[:, k], matrix[k, k] = 0.0, 0.0, sigma**2
    changed: Any = camera
    result: Camera = replace(changed, covariance=ParameterCovariance(names=known.names, matrix=matrix))
    return result
