"""What all camera models share: pose, principal point, and a table of keys that defines file and parameters; and the
models without distortion.

To add a model, derive a dataclass with `MODEL` and `KEYS` from `CentralCamera` (one projection centre) or
`CameraModel`, and add it to `MODELS` in io/cameras_yaml.py. `KEYS` define file, parameter names and checks.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.camera import ParameterCovariance, Rays, centre_lab_mm
from sphereorient.cameras.checks import (
    as_parameter,
    camera_error,
    check_image_size,
    check_points,
    check_positive,
    check_rotation,
)


@dataclass(frozen=True)
class Key:
    """A key of a model in cameras.yaml, the field that stores it, and its parameters."""

    name: str
    field: str
    parts: tuple[str, ...] = ()  # parameter names of a list; empty: one number, whose parameter has the key's name
    place: int | None = None  # index in the field, if several keys share it
    default: float | None = None  # of each number, if the key is optional
    optional: bool = False  # `completed` fills in the value
    positive: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraModel(ABC):
    """A camera whose parameters are float64 tensors; gradients reach those that require them."""

    image_size: tuple[int, int]  # W, H px
    R_cam_lab: Tensor  # (3, 3)
    T_cam_lab_mm: Tensor  # (3,), X_cam = R_cam_lab X_lab + T
    centre_px: Tensor  # (2,), pixel of the optical axis
    covariance: ParameterCovariance | None = None  # from a calibration

    MODEL: ClassVar[str]
    KEYS: ClassVar[tuple[Key, ...]]  # in the order of the file
    ALSO: ClassVar[tuple[str, ...]] = ()  # further keys of the file, which `completed` converts

    def __post_init__(self) -> None:
        check_image_size("image_size", self.image_size)
        object.__setattr__(self, "image_size", tuple(self.image_size))
        shapes: dict[str, tuple[int, ...]] = {"R_cam_lab": (3, 3), "T_cam_lab_mm": (3,)}
        for key in self.KEYS:  # the last of the keys that share a field has the highest index
            size = len(key.parts) if key.place is None else key.place + 1
            shapes[key.field] = (size,) if size else ()
        for name, shape in shapes.items():
            object.__setattr__(self, name, as_parameter(name, getattr(self, name), *shape))
        check_rotation("R_cam_lab", self.R_cam_lab)
        for key in self.KEYS:
            if key.positive:
                check_positive(key.field, getattr(self, key.field))

    @classmethod
    def parameter_fields(cls) -> dict[str, tuple[str, int | None]]:
        """Return field and index in it of each parameter except rotation and translation, by name."""
        found: dict[str, tuple[str, int | None]] = {}
        for key in cls.KEYS:
            found |= {part: (key.field, k) for k, part in enumerate(key.parts)}
            if not key.parts:
                found[key.name] = (key.field, key.place)
        return found

    @classmethod
    def completed(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Return the keys of cameras.yaml with defaults (centre: middle of picture); CameraError if impossible."""
        middle = {"centre": middle_of_picture(values["image_size"])}
        return values | middle if values.get("centre", 0) is None else values

    @abstractmethod
    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Project lab points (..., 3), mm, to pixels (..., 2)."""

    @abstractmethod
    def rays(self, uv_px: Tensor) -> Rays:
        """Return the rays of pixels (..., 2)."""

    def across_lab(self, x_lab_mm: Tensor) -> Tensor:
        """Return the camera's x axis, (3,), in which a sphere's radius appears."""
        return self.R_cam_lab[0].to(x_lab_mm)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) of the camera without distortion; by default unchanged."""
        check_points("uv_px", uv_px, 2)
        return uv_px

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) whose undistorted ones are `uv_px`; by default unchanged."""
        check_points("uv_px", uv_px, 2)
        return uv_px


@dataclass(frozen=True, kw_only=True, eq=False)
class CentralCamera(CameraModel):
    """A camera whose rays meet in one point; a model adds focal length and distortion."""

    @property
    def centre_lab_mm(self) -> Tensor:
        """(3,), lab, mm: the projection centre."""
        return centre_lab_mm(self)

    @property
    @abstractmethod
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope X/Z and Y/Z, or per rad, on the axis."""

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Project lab points (..., 3), mm, to pixels (..., 2); NaN for points that the camera does not see."""
        check_points("x_lab_mm", x_lab_mm, 3)
        x_cam_mm = x_lab_mm @ self.R_cam_lab.to(x_lab_mm).mT + self.T_cam_lab_mm.to(x_lab_mm)
        flat, seen = self._flattened(x_cam_mm)
        uv_px = self.distort(flat * self.focal_px.to(flat) + self.centre_px.to(flat))
        return torch.where(seen, uv_px, torch.full_like(uv_px, torch.nan))

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the rays (..., 3) of pixels (..., 2), which start at the projection centre."""
        check_points("uv_px", uv_px, 2)
        flat = (self.undistort(uv_px) - self.centre_px.to(uv_px)) / self.focal_px.to(uv_px)
        direction_lab = self._direction_cam(flat) @ self.R_cam_lab.to(uv_px)  # rows: R_lab_cam times each direction
        return Rays(origin_lab_mm=self.centre_lab_mm.to(uv_px).expand_as(direction_lab), direction_lab=direction_lab)

    def _flattened(self, x_cam_mm: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (..., 3) on the plane that `focal_px` scales, here as slopes, and whether they are seen, (...,
        1); others are finite too, or the gradient of the unused branch is NaN.
        """
        depth = x_cam_mm[..., 2:]
        before = depth > 0
        return x_cam_mm[..., :2] / torch.where(before, depth, torch.ones_like(depth)), before

    def _direction_cam(self, flat: Tensor) -> Tensor:
        """Return the unit directions (..., 3) of points (..., 2) of that plane."""
        direction_cam = torch.cat([flat, torch.ones_like(flat[..., :1])], dim=-1)
        unit: Tensor = direction_cam / direction_cam.norm(dim=-1, keepdim=True)
        return unit


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeCamera(CentralCamera):
    """Perspective without distortion and with square pixels."""

    f_px: Tensor  # (), focal length, px

    MODEL: ClassVar[str] = "pinhole"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("f_px", "f_px", optional=True, positive=True),
        Key("centre", "centre_px", ("centre_u", "centre_v"), optional=True),
    )
    ALSO: ClassVar[tuple[str, ...]] = ("vfov_deg",)

    @classmethod
    def completed(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Return the keys with f_px from vfov_deg (one of both, else CameraError), and a default centre."""
        f_px, vfov_deg = values["f_px"], values["vfov_deg"]
        if (f_px is None) == (vfov_deg is None):
            got, do = "none" if f_px is None else "both", "write one of the two"
            raise camera_error("vfov_deg, f_px", "exactly one", got, do)
        values = super().completed(values)
        return values if vfov_deg is None else values | {"f_px": focal_of_field(values["image_size"][1], vfov_deg)}

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_px.expand(2)


@dataclass(frozen=True, kw_only=True, eq=False)
class TelecentricCamera(CameraModel):
    """Orthographic projection: u = X_cam / scale + centre, at every depth; T_z has no effect on pictures."""

    scale_mm_px: Tensor  # (), mm in the lab per pixel

    MODEL: ClassVar[str] = "telecentric"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("scale", "scale_mm_px", positive=True),
        Key("centre", "centre_px", ("centre_u", "centre_v"), optional=True),
    )

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Project lab points (..., 3), mm, to pixels (..., 2)."""
        check_points("x_lab_mm", x_lab_mm, 3)
        x_cam_mm = x_lab_mm @ self.R_cam_lab[:2].to(x_lab_mm).mT + self.T_cam_lab_mm[:2].to(x_lab_mm)
        return x_cam_mm / self.scale_mm_px.to(x_lab_mm) + self.centre_px.to(x_lab_mm)

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the parallel rays of pixels (..., 2), which start in the camera's plane z = 0."""
        check_points("uv_px", uv_px, 2)
        x_cam_mm = (uv_px - self.centre_px.to(uv_px)) * self.scale_mm_px.to(uv_px)
        x_cam_mm = torch.cat([x_cam_mm, torch.zeros_like(x_cam_mm[..., :1])], dim=-1)
        R_cam_lab = self.R_cam_lab.to(uv_px)
        origin_lab_mm = (x_cam_mm - self.T_cam_lab_mm.to(uv_px)) @ R_cam_lab
        return Rays(origin_lab_mm=origin_lab_mm, direction_lab=R_cam_lab[2].expand_as(origin_lab_mm))


def focal_of_field(height_px: int, vfov_deg: float) -> float:
    """Return the focal length, px, for a vertical field of `vfov_deg`, 0 to 180 degrees (else CameraError)."""
    if not 0.0 < vfov_deg < 180.0:
        raise camera_error("vfov_deg", "an angle between 0 and 180", f"{vfov_deg:g}")
    return 0.5 * height_px / math.tan(math.radians(vfov_deg) / 2)


def field_of_focal(height_px: int, f_px: float) -> float:
    """Return the vertical field of view, degrees, of a focal length, px."""
    return 2 * math.degrees(math.atan(0.5 * height_px / f_px))


def middle_of_picture(image_size: tuple[int, int]) -> Tensor:
    """Return the middle of a W x H picture, (2,) float64 px; whole numbers are pixel centres."""
    return (torch.tensor(image_size, dtype=torch.float64) - 1) / 2
