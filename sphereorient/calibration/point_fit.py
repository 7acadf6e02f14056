"""One camera fitted to points whose places in the lab are known: least squares in the picture, with a covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from sphereorient.calibration.slopes import slopes_along
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.checks import check_points
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.cameras.parameters import with_parameters
from sphereorient.errors import CameraError, ShapeError, refusal

AnyCamera = TypeVar("AnyCamera", bound=Camera)
NO_PICTURE_PX = 1e6  # residual where a trial has no picture of a point, or is no camera: such steps are taken back
EVALUATIONS = 200  # at most; from Tsai's linear stage about ten do
SIGMA_PX = 0.05  # of good centroids: points without noise would make every parameter look certain
LOOSE = 1e-9  # smallest eigenvalue of the scaled information: float64 does not tell less from zero


def fit_to_points(camera: AnyCamera, names: Sequence[str], x_lab_mm: Tensor, uv_px: Tensor) -> AnyCamera:
    """Return the camera with some of its parameters changed so that points fall on their pixels.

    Args:
        camera: near enough, of any model, also behind a port.
        names: of the parameters that are fitted, as in `parameter_names`; the others are held.
        x_lab_mm: (n, 3), lab, mm.
        uv_px: (n, 2), px, all equally certain.

    Returns:
        The camera with the covariance of what was fitted, as the residuals tell it, but at least that of 0.05 px.

    Raises:
        CameraError: fewer numbers than unknowns, numbers that are not finite, or parameters that the points do not
            determine, named.
        ShapeError: arrays of another shape.

    Source: Levenberg and Marquardt (scipy's least_squares); the slopes are those of the cameras themselves.
    """
    x_lab_mm, uv_px = checked_points(x_lab_mm, uv_px)
    _check_enough(names, x_lab_mm)
    camera = replace(cast(Any, camera), covariance=None)
    size = len(names)

    def residuals(change: NDArray[Any]) -> NDArray[Any]:
        try:
            moved = with_parameters(camera, names, torch.from_numpy(change))
        except CameraError:  # a trial beyond the fold of the distortion, say
            return np.full(uv_px.numel(), NO_PICTURE_PX)
        missed = moved.project(x_lab_mm).detach() - uv_px
        return missed.nan_to_num(nan=NO_PICTURE_PX).reshape(-1).numpy()

    def slopes(change: NDArray[Any]) -> NDArray[Any]:
        at, directions = torch.from_numpy(change), torch.eye(size, dtype=torch.float64)
        columns = slopes_along(lambda delta: with_parameters(camera, names, delta).project(x_lab_mm), at, directions)
        return columns.reshape(-1, size).nan_to_num(nan=0.0).numpy()

    fit = least_squares(
        residuals, np.zeros(size), slopes, method="trf", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14,
        max_nfev=EVALUATIONS,
    )  # fmt: skip
    slope = torch.from_numpy(slopes(fit.x))
    spare = max(uv_px.numel() - size, 1)
    sigma_px = max((2 * float(fit.cost) / spare) ** 0.5, SIGMA_PX)
    covariance = ParameterCovariance(names=tuple(names), matrix=sigma_px**2 * _inverse(slope.mT @ slope, names))
    fitted = with_parameters(camera, names, torch.from_numpy(fit.x))
    return cast(AnyCamera, replace(cast(Any, fitted), covariance=covariance))


def checked_points(x_lab_mm: Tensor, uv_px: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (n, 3) and their pixels (n, 2) as float64 on the CPU.

    Raises:
        CameraError: a row that is not finite, named.
        ShapeError: another shape, or unequal numbers of rows.
    """
    for name, numbers, size in (("x_lab_mm", x_lab_mm, 3), ("uv_px", uv_px, 2)):
        check_points(name, numbers, size)
        if numbers.dim() != 2:
            got, do = str(tuple(numbers.shape)), "pass one row per point"
            raise ShapeError(refusal(name, expected=f"shape (n, {size})", got=got, do=do))
        bad = (~torch.isfinite(numbers)).any(-1).nonzero()[:, 0].tolist()
        if bad:
            do = "leave such points out"
            raise CameraError(refusal(f"{name}, row {bad[0]}", expected="finite numbers", got="others", do=do))
    if len(x_lab_mm) != len(uv_px):
        got, do = f"{len(x_lab_mm)} points and {len(uv_px)} pixels", "pass one pixel per point"
        raise ShapeError(refusal("uv_px", expected="as many rows as x_lab_mm", got=got, do=do))
    return x_lab_mm.detach().double().cpu(), uv_px.detach().double().cpu()


def rms_px(camera: Camera, x_lab_mm: Tensor, uv_px: Tensor) -> float:
    """Return the root mean square of the distances, px, between points' pictures and their pixels; NaN where none."""
    return float((camera.project(x_lab_mm).detach() - uv_px).square().sum(-1).mean().sqrt())


def _check_enough(names: Sequence[str], x_lab_mm: Tensor) -> None:
    least = -(-len(names) // 2)
    if len(x_lab_mm) < least:
        expected, got = f"{least} or more for {len(names)} parameters", f"{len(x_lab_mm)}"
        raise CameraError(refusal("points", expected=expected, got=got, do="add points, or hold some parameters"))


def _inverse(information: Tensor, names: Sequence[str]) -> Tensor:
    """Invert an information matrix of parameters in different units; refuse what is not determined, by name."""
    scale = information.diagonal().clamp_min(1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(scale[:, None] * information * scale)
    if float(values[0]) < LOOSE:
        part = vectors[:, 0].abs()
        loose = [name for name, share in zip(names, part.tolist(), strict=True) if share > 0.3 * float(part.max())]
        do = "add points at other depths, tilt the plate, or hold some of them"
        got = f"no hold on {', '.join(loose)}"
        raise CameraError(refusal("points", expected="a determined camera", got=got, do=do))
    inverse: Tensor = (vectors / values) @ vectors.mT
    whole: Tensor = scale[:, None] * inverse * scale
    return (whole + whole.mT) / 2
