"""What cameras.yaml says about a camera: the keys of each model, and the camera they make."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor

from sphereorient.cameras.brown import BrownCamera
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.cameras.openptv_camera import OpenPTVCamera
from sphereorient.cameras.pinhole import PinholeCamera, focal_of_field, middle_of_picture
from sphereorient.cameras.port import Port
from sphereorient.cameras.telecentric import TelecentricCamera
from sphereorient.cameras.tsai import TsaiCamera
from sphereorient.errors import CameraError, refusal

Pair = tuple[float, float]
Triple = tuple[float, float, float]


class Entry(BaseModel):
    """A mapping of cameras.yaml whose keys are all known."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class PortEntry(Entry):
    """Keys of `port` (DESIGN section 2)."""

    normal: Triple
    offset: float
    thickness: float
    n_glass: float
    n_fluid: float

    def port(self) -> Port:
        """Build the port."""
        return Port(
            normal=_tensor(self.normal),
            offset_mm=_tensor(self.offset),
            thickness_mm=_tensor(self.thickness),
            n_glass=_tensor(self.n_glass),
            n_fluid=_tensor(self.n_fluid),
        )


class CovarianceEntry(Entry):
    """Keys of `covariance`, which a calibration adds."""

    parameters: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def covariance(self) -> ParameterCovariance:
        """Build the covariance."""
        lengths = {len(row) for row in self.matrix}
        if lengths != {len(self.parameters)}:
            expected, got = f"rows of {len(self.parameters)} numbers", f"lengths {sorted(lengths)}"
            do = "write one row and one column for each parameter"
            raise CameraError(refusal("covariance, matrix", expected=expected, got=got, do=do))
        return ParameterCovariance(names=self.parameters, matrix=_tensor(self.matrix))


class CameraEntry(Entry):
    """The keys that all models share."""

    model: str
    image_size: tuple[int, int]
    R: tuple[Triple, Triple, Triple]
    T: Triple
    port: PortEntry | None = None
    covariance: CovarianceEntry | None = None

    def shared(self) -> dict[str, Any]:
        """Return the arguments that every camera takes."""
        return {"image_size": self.image_size, "R_cam_lab": _tensor(self.R), "T_cam_lab_mm": _tensor(self.T)}

    @abstractmethod
    def camera(self) -> Camera:
        """Build the camera as it is in air."""


class TsaiEntry(CameraEntry):
    """Keys of `model: tsai` (DESIGN section 2)."""

    f: float
    pixel_pitch: Pair
    centre: Pair
    sx: float = 1.0
    kappa1: float = 0.0

    def camera(self) -> Camera:
        """Build the camera."""
        return TsaiCamera(
            **self.shared(),
            centre_px=_tensor(self.centre),
            f_mm=_tensor(self.f),
            pixel_pitch_mm=_tensor(self.pixel_pitch),
            sx=_tensor(self.sx),
            kappa1=_tensor(self.kappa1),
        )


class PinholeEntry(CameraEntry):
    """Keys of `model: pinhole` (DESIGN section 2); the centre defaults to the middle of the picture."""

    vfov_deg: float | None = None
    f_px: float | None = None
    centre: Pair | None = None

    def camera(self) -> Camera:
        """Build the camera.

        Raises:
            CameraError: both or none of vfov_deg and f_px, or an impossible parameter.
        """
        if self.f_px is not None and self.vfov_deg is None:
            f_px = self.f_px
        elif self.vfov_deg is not None and self.f_px is None:
            f_px = focal_of_field(self.image_size[1], self.vfov_deg)
        else:
            got, do = "none" if self.f_px is None else "both", "write one of the two"
            raise CameraError(refusal("vfov_deg, f_px", expected="exactly one", got=got, do=do))
        return PinholeCamera(**self.shared(), centre_px=_centre(self.centre, self.image_size), f_px=_tensor(f_px))


class BrownEntry(CameraEntry):
    """Keys of `model: brown` (DESIGN section 2)."""

    fx: float
    fy: float
    cx: float
    cy: float
    k: Triple = (0.0, 0.0, 0.0)
    p: Pair = (0.0, 0.0)

    def camera(self) -> Camera:
        """Build the camera."""
        return BrownCamera(
            **self.shared(),
            centre_px=_tensor((self.cx, self.cy)),
            f_px=_tensor((self.fx, self.fy)),
            k=_tensor(self.k),
            p=_tensor(self.p),
        )


class TelecentricEntry(CameraEntry):
    """Keys of `model: telecentric` (DESIGN section 2); the centre defaults to the middle of the picture."""

    scale: float
    centre: Pair | None = None

    def camera(self) -> Camera:
        """Build the camera."""
        centre = _centre(self.centre, self.image_size)
        return TelecentricCamera(**self.shared(), centre_px=centre, scale_mm_px=_tensor(self.scale))


class OpenPTVEntry(CameraEntry):
    """Keys of `model: openptv`: .ori and .addpar in our frames; `centre` holds the sensor shift xh, yh, in px."""

    f: float
    pixel_pitch: Pair
    centre: Pair
    k: Triple = (0.0, 0.0, 0.0)
    p: Pair = (0.0, 0.0)
    scx: float = 1.0
    she: float = 0.0

    def camera(self) -> Camera:
        """Build the camera."""
        return OpenPTVCamera(
            **self.shared(),
            centre_px=_tensor(self.centre),
            f_mm=_tensor(self.f),
            pixel_pitch_mm=_tensor(self.pixel_pitch),
            k=_tensor(self.k),
            p=_tensor(self.p),
            scx=_tensor(self.scx),
            she=_tensor(self.she),
        )


def _centre(centre: Pair | None, image_size: tuple[int, int]) -> Tensor:
    return middle_of_picture(image_size) if centre is None else _tensor(centre)


def _tensor(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)
