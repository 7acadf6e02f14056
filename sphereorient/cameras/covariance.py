from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.cameras.checks import camera_error
from sphereorient.errors import CameraError, refusal

ASYMMETRY = 1e-6  # of the correlation matrix: covariances written with seven digits pass


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterCovariance:
    """Covariance of the small changes that `with_parameters` applies."""

    names: tuple[str, ...]  # P different names, as in `parameter_names`
    matrix: Tensor  # (P, P) float64, in the products of the parameters' units

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        matrix = torch.as_tensor(self.matrix, dtype=torch.float64).detach()
        object.__setattr__(self, "matrix", matrix)
        size = len(self.names)
        if len(set(self.names)) != size or size == 0:
            got, do = ", ".join(self.names) or "none", "name every parameter once"
            raise CameraError(refusal("covariance, parameters", expected="different names", got=got, do=do))
        if tuple(matrix.shape) != (size, size):
            got, do = f"shape {tuple(matrix.shape)}", "write one row and one column for each parameter"
            raise camera_error("covariance, matrix", f"{size} rows of {size} numbers", got, do)
        _check_covariance(matrix)

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of each parameter, in its own unit."""
        return dict(zip(self.names, self.matrix.diagonal().sqrt().tolist(), strict=True))

    def of(self, cameras: Iterable[str]) -> ParameterCovariance | None:
        """Return the block of some cameras, for names like cam1.f; None without parameters of them."""
        wanted = set(cameras)
        kept = [k for k, name in enumerate(self.names) if name.partition(".")[0] in wanted]
        if not kept:
            return None
        return ParameterCovariance(names=tuple(self.names[k] for k in kept), matrix=self.matrix[kept][:, kept])


def _check_covariance(matrix: Tensor) -> None:
    do = "calibrate again, or remove the covariance"
    if not bool(torch.isfinite(matrix).all()) or bool((matrix.diagonal() < 0).any()):
        raise camera_error("covariance, matrix", "finite numbers, none below zero on the diagonal", "others", do)
    sigma = matrix.diagonal().sqrt()
    scale = torch.where(sigma > 0, sigma, torch.ones_like(sigma))  # parameters of different units: judge correlations
    correlation = matrix / (scale[:, None] * scale)
    asymmetry = float((correlation - correlation.mT).abs().max())
    if asymmetry > ASYMMETRY:
        got = f"entries that differ by {asymmetry:.2g} of the sigmas' product"
        raise CameraError(refusal("covariance, matrix", expected="a symmetric matrix", got=got, do=do))
    smallest = float(torch.linalg.eigvalsh((correlation + correlation.mT) / 2)[0])
    if smallest < -ASYMMETRY * len(matrix):
        got = f"{smallest:.2g} among the correlations' eigenvalues"
        raise CameraError(refusal("covariance, matrix", expected="no negative eigenvalue", got=got, do=do))
