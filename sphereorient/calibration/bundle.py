"""All cameras and all plate poses fitted at once to all points seen: bundle adjustment with covariances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sphereorient.calibration.descent import robust_least_squares
from sphereorient.calibration.problem import Problem, Rig
from sphereorient.cameras.covariance import ParameterCovariance

SOFT = 2.0  # sigmas beyond which a residual pulls less than by its square
OUTLIER = 6.0  # robust standard deviations beyond which a point is left out
ROUNDS = 3  # of fit, perspective bias and outliers
STEPS = 60  # at most, a round
TOLERANCE = (1e-5, 1e-8)  # relative gain of the cost at which a round ends: those whose weights change, and the last


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """What a fit found; made by `adjust`."""

    rig: Rig  # cameras with covariances
    residual_px: Mapping[str, Tensor]  # (n, 2) of each camera, measured less expected
    used: Mapping[str, Tensor]  # (n,) bool: False for outliers
    scale: float  # standard deviation of the residuals over the sigmas given
    labels: tuple[str, ...]  # K unknowns, in the order of the covariance
    covariance: Tensor  # (K, K) float64, of cameras and poses together


def adjust(problem: Problem) -> Fitted:
    """Fit cameras and poses.

    Args:
        problem: with a rig near enough: dots must fall nearer to their own pictures than to their neighbours'.

    Returns:
        The fit; its covariance is the inverse information times the residuals' variance.

    Source: Triggs et al. 2000 (bundle adjustment); soft L1 loss, Huber 1981.
    """
    used = {name: torch.ones(len(seen.pose), dtype=torch.bool) for name, seen in problem.seen.items()}
    change = torch.zeros(problem.size, dtype=torch.float64)
    for k in range(ROUNDS):
        shifts = problem.shifts(problem.applied(change))
        change = _solved(problem, change, shifts, _rows(used), TOLERANCE[k == ROUNDS - 1])
        residuals = problem.residuals(change, shifts)
        used = _inliers(problem, residuals)
    shifts = problem.shifts(problem.applied(change))
    residuals = problem.residuals(change, shifts)
    rows = _rows(used)
    slopes = problem.slopes(change)[rows]
    spare = max(len(slopes) - problem.size, 1)
    scale = float((residuals[rows].square().sum() / spare).sqrt())
    covariance = scale**2 * _inverse(slopes.mT @ slopes)
    rig = problem.applied(change)
    return Fitted(
        rig=replace(rig, cameras=_with_covariances(problem, rig, covariance)),
        residual_px=_in_px(problem, residuals),
        used=used,
        scale=scale,
        labels=tuple(problem.labels),
        covariance=covariance,
    )


def _solved(problem: Problem, start: Tensor, shifts: Mapping[str, Tensor], rows: Tensor, gain: float) -> Tensor:
    return robust_least_squares(
        lambda change: problem.residuals(change, shifts)[rows],
        lambda change: problem.slopes(change)[rows],
        start,
        soft=SOFT,
        gain=gain,
        steps=STEPS,
    )


def _rows(used: Mapping[str, Tensor]) -> Tensor:
    """Rows of the residuals, u and v of each point, that belong to points in use."""
    return torch.cat([mask.repeat_interleave(2) for mask in used.values()])


def _inliers(problem: Problem, residuals: Tensor) -> dict[str, Tensor]:
    size = residuals.reshape(-1, 2).norm(dim=1)
    # The median length of a two-dimensional Gaussian is 1.1774 sigma.
    usual = float(size.nanmedian()) / 1.1774
    good = size <= OUTLIER * max(usual, 1e-12)
    lengths = [len(seen.pose) for seen in problem.seen.values()]
    return dict(zip(problem.seen, torch.split(good, lengths), strict=True))


def _in_px(problem: Problem, residuals: Tensor) -> dict[str, Tensor]:
    lengths = [len(seen.pose) for seen in problem.seen.values()]
    parts = torch.split(residuals.reshape(-1, 2), lengths)
    return {name: part * seen.sigma_px[:, None] for part, (name, seen) in zip(parts, problem.seen.items(), strict=True)}


def _inverse(information: Tensor) -> Tensor:
    """Invert an information matrix of parameters in different units; what nothing determines gets a huge variance."""
    known = information.diagonal()
    scale = torch.where(known > 0, known, torch.ones_like(known)).rsqrt()
    values, vectors = torch.linalg.eigh(scale[:, None] * information * scale)
    inverse: Tensor = (vectors / values.clamp_min(1e-14)) @ vectors.mT
    whole: Tensor = scale[:, None] * inverse * scale
    return (whole + whole.mT) / 2


def _with_covariances(problem: Problem, rig: Rig, covariance: Tensor) -> dict[str, Any]:
    cameras, begin = {}, 0
    for name, camera in rig.cameras.items():
        names = problem.names[name]
        block = covariance[begin : begin + len(names), begin : begin + len(names)]
        begin += len(names)
        known: Any = camera
        cameras[name] = replace(known, covariance=ParameterCovariance(names=names, matrix=block)) if names else camera
    return cameras
