"""Which camera models there are: their names and keys in cameras.yaml, and how each is built and written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor

from sphereorient.cameras.camera import Camera
from sphereorient.cameras.pinhole import PinholeCamera, focal_of_field, middle_of_picture
from sphereorient.cameras.tsai import TsaiCamera
from sphereorient.cameras.yaml_file import refuse_unknown, validated
from sphereorient.errors import CameraError, refusal

Pair = tuple[float, float]
Triple = tuple[float, float, float]


class CameraEntry(BaseModel):
    """The keys that all models share. `covariance`, which a calibration adds, is accepted and not kept."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    model: str
    image_size: tuple[int, int]
    R: tuple[Triple, Triple, Triple]
    T: Triple
    covariance: Any = None

    def shared(self) -> dict[str, Any]:
        """Return the arguments that every camera takes."""
        return {"image_size": self.image_size, "R_cam_lab": _tensor(self.R), "T_cam_lab_mm": _tensor(self.T)}


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
        centre = middle_of_picture(self.image_size) if self.centre is None else _tensor(self.centre)
        return PinholeCamera(**self.shared(), centre_px=centre, f_px=_tensor(f_px))


def _tsai_keys(camera: TsaiCamera) -> dict[str, Any]:
    return {
        "f": camera.f_mm,
        "pixel_pitch": camera.pixel_pitch_mm,
        "sx": camera.sx,
        "centre": camera.centre_px,
        "kappa1": camera.kappa1,
    }


def _pinhole_keys(camera: PinholeCamera) -> dict[str, Any]:
    return {"f_px": camera.f_px, "centre": camera.centre_px}


@dataclass(frozen=True)
class CameraModel:
    """One camera model in cameras.yaml."""

    entry: type[TsaiEntry] | type[PinholeEntry]  # its keys; knows how to build the camera
    kind: type[Camera]  # what it builds
    keys: Callable[[Any], dict[str, Any]]  # the way back: camera -> its own keys, tensors or numbers


# A further model: one file with the camera, one entry class above, one line here.
MODELS: dict[str, CameraModel] = {
    "tsai": CameraModel(TsaiEntry, TsaiCamera, _tsai_keys),
    "pinhole": CameraModel(PinholeEntry, PinholeCamera, _pinhole_keys),
}


def build_camera(entry: object, where: str) -> Camera:
    """Build a camera from what cameras.yaml says about it.

    Args:
        entry: its mapping.
        where: file and name of the camera, for the messages.

    Raises:
        CameraError: no mapping, an unknown model or key, a port, a missing key, or an impossible parameter.
    """
    if not isinstance(entry, Mapping):
        raise CameraError(refusal(where, expected="the keys of a camera", got=repr(entry), do="indent them below it"))
    if "model" not in entry:
        raise CameraError(refusal(f"{where}, model", expected=f"one of {', '.join(MODELS)}", got="none", do="add it"))
    if not isinstance(entry["model"], str) or entry["model"] not in MODELS:
        raise CameraError(refuse_unknown(entry["model"], MODELS, f"{where}, model"))
    if entry.get("port") is not None:
        expected, do = f"a camera without a port, of model {' or '.join(MODELS)}", "calibrate the camera without a port"
        raise CameraError(
            refusal(f"{where}, port", expected=expected, got="a port, which this version cannot bend rays at", do=do)
        )
    keys = {key: value for key, value in entry.items() if key != "port"}
    checked = validated(MODELS[entry["model"]].entry, keys, where, CameraError)
    try:
        return checked.camera()
    except CameraError as error:
        raise CameraError(f"{where}, {error}") from None


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Return what cameras.yaml says about a camera: the inverse of `build_camera`.

    Raises:
        CameraError: a camera of a model that has no name.
    """
    for name, model in MODELS.items():
        if isinstance(camera, model.kind):
            first: dict[str, Any] = {"model": name, "image_size": list(camera.image_size)}
            last = {"R": camera.R_cam_lab, "T": camera.T_cam_lab_mm}
            return first | {key: value.detach().tolist() for key, value in (model.keys(camera) | last).items()}
    got, do = type(camera).__name__, "register the model in cameras/registry.py"
    raise CameraError(refusal("camera", expected=f"a camera of model {', '.join(MODELS)}", got=got, do=do))


def _tensor(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)
