"""One camera fitted to points whose lab positions are known: least squares in the picture, with a covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from sphereorient.calibration.solve import inverse_information, least_squares, slopes_along
from sphereorient.cameras import Camera, ParameterCovariance
from sphereorient.cameras.checks import check_points
from sphereorient.cameras.parameters import with_parameters
from sphereorient.errors import CameraError, ShapeError, refusal

AnyCamera = TypeVar("AnyCamera", bound=Camera)
SIGMA_PX = 0.05  # of good centroids: points without noise would make every parameter look certain


def fit_to_points(camera: AnyCamera, names: Sequence[str], x_lab_mm: Tensor, uv_px: Tensor) -> AnyCamera:
    """Fit some parameters of a camera to points and their pixels.

    Args:
        camera: near enough, of any model, also behind a port.
        names: of the fitted parameters, as in `parameter_names`.
        x_lab_mm: (n, 3), lab, mm.
        uv_px: (n, 2), px, all equally certain.

    Returns:
        The camera with the covariance of the fitted parameters, from the residuals or at least from 0.05 px.

    Raises:
        CameraError: too few points, numbers that are not finite, or undetermined parameters, named.
        ShapeError: arrays of another shape.
    """
    x_lab_mm, uv_px = checked_points(x_lab_mm, uv_px)
    size, least = len(names), -(-len(names) // 2)
    if len(x_lab_mm) < least:
        expected, got = f"{least} or more for {size} parameters", f"{len(x_lab_mm)}"
        raise CameraError(refusal("points", expected=expected, got=got, do="add points, or hold some parameters"))
    start = cast(AnyCamera, replace(cast(Any, camera), covariance=None))

    def expected_px(change: Tensor) -> Tensor:
        return with_parameters(start, names, change).project(x_lab_mm).reshape(-1)

    def slopes(change: Tensor) -> Tensor:
        return slopes_along(expected_px, change, torch.eye(size, dtype=torch.float64))

    zero = torch.zeros(size, dtype=torch.float64)
    change = least_squares(lambda change: expected_px(change).detach() - uv_px.reshape(-1), slopes, zero)
    slope, missed = torch.nan_to_num(slopes(change)), expected_px(change).detach() - uv_px.reshape(-1)
    spare = max(uv_px.numel() - size, 1)
    sigma_px = max(float(torch.nan_to_num(missed, nan=1e6).square().sum() / spare) ** 0.5, SIGMA_PX)
    matrix = sigma_px**2 * inverse_information(slope.mT @ slope, names)
    covariance = ParameterCovariance(names=tuple(names), matrix=matrix)
    return cast(AnyCamera, replace(cast(Any, with_parameters(start, names, change)), covariance=covariance))


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
    """Return the rms distance, px, between the images of points and their pixels; NaN where a point has no image."""
    return float((camera.project(x_lab_mm).detach() - uv_px).square().sum(-1).mean().sqrt())
