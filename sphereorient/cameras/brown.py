"""OpenCV's camera: Brown's polynomial acts on the undistorted point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from sphereorient.cameras.brown_polynomial import bent, straightened
from sphereorient.cameras.central import CentralCamera
from sphereorient.cameras.checks import check_points, check_positive, check_unfolded


@dataclass(frozen=True, kw_only=True, eq=False)
class BrownCamera(CentralCamera):
    """Perspective with Brown-Conrady distortion of the slopes X/Z and Y/Z (DESIGN section 2, `brown`).

    Source: OpenCV's pinhole model with the coefficients k1, k2, p1, p2, k3.
    """

    f_px: Tensor  # (2,), fx and fy
    k: Tensor  # (3,), radial k1, k2, k3, no unit
    p: Tensor  # (2,), tangential p1, p2, no unit

    PARAMETERS: ClassVar[Mapping[str, tuple[str, int | None]]] = {
        "fx": ("f_px", 0),
        "fy": ("f_px", 1),
        "cx": ("centre_px", 0),
        "cy": ("centre_px", 1),
        "k1": ("k", 0),
        "k2": ("k", 1),
        "k3": ("k", 2),
        "p1": ("p", 0),
        "p2": ("p", 1),
    }

    def __post_init__(self) -> None:
        """Refuse what is no camera, and a distortion that folds the picture."""
        super().__post_init__()
        for name, size in (("f_px", 2), ("k", 3), ("p", 2)):
            self._set_parameter(name, size)
        check_positive("f_px", self.f_px)
        check_unfolded("k, p", self)

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_px

    def _slope(self, uv_px: Tensor) -> Tensor:
        return (uv_px - self.centre_px.to(uv_px)) / self.f_px.to(uv_px)

    def _pixel(self, slope: Tensor) -> Tensor:
        return slope * self.f_px.to(slope) + self.centre_px.to(slope)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return where the same camera without lens distortion would show what a pixel shows.

        Args:
            uv_px: (..., 2), px.

        Returns:
            (..., 2), px, to the last digits (Newton); NaN where no point before the fold of the polynomial goes, which
            lies outside the picture.
        """
        check_points("uv_px", uv_px, 2)
        return self._pixel(straightened(self._slope(uv_px), self.k, self.p))

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixel that `undistort` takes to `uv_px`.

        Args:
            uv_px: (..., 2), px.

        Returns:
            (..., 2), px; NaN beyond the fold of the polynomial.
        """
        check_points("uv_px", uv_px, 2)
        return self._pixel(bent(self._slope(uv_px), self.k, self.p))
