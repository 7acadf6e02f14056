"""Which camera models there are: their names in cameras.yaml, and how each is built and written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

from torch import Tensor

from sphereorient.cameras.brown import BrownCamera
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.cameras.io.entries import (
    BrownEntry,
    CameraEntry,
    OpenPTVEntry,
    PinholeEntry,
    TelecentricEntry,
    TsaiEntry,
)
from sphereorient.cameras.openptv_camera import OpenPTVCamera
from sphereorient.cameras.parameters import parameter_names
from sphereorient.cameras.pinhole import PinholeCamera
from sphereorient.cameras.port import Port, PortCamera
from sphereorient.cameras.telecentric import TelecentricCamera
from sphereorient.cameras.tsai import TsaiCamera
from sphereorient.errors import CameraError, refusal
from sphereorient.files.yaml_file import refuse_unknown, short, validated


def _tsai_keys(camera: TsaiCamera) -> dict[str, Tensor]:
    return {
        "f": camera.f_mm,
        "pixel_pitch": camera.pixel_pitch_mm,
        "sx": camera.sx,
        "centre": camera.centre_px,
        "kappa1": camera.kappa1,
    }


def _pinhole_keys(camera: PinholeCamera) -> dict[str, Tensor]:
    return {"f_px": camera.f_px, "centre": camera.centre_px}


def _brown_keys(camera: BrownCamera) -> dict[str, Tensor]:
    fx, fy = camera.f_px.unbind()
    cx, cy = camera.centre_px.unbind()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "k": camera.k, "p": camera.p}


def _telecentric_keys(camera: TelecentricCamera) -> dict[str, Tensor]:
    return {"scale": camera.scale_mm_px, "centre": camera.centre_px}


def _openptv_keys(camera: OpenPTVCamera) -> dict[str, Tensor]:
    return {
        "f": camera.f_mm,
        "pixel_pitch": camera.pixel_pitch_mm,
        "centre": camera.centre_px,
        "k": camera.k,
        "p": camera.p,
        "scx": camera.scx,
        "she": camera.she,
    }


@dataclass(frozen=True)
class CameraModel:
    """One camera model in cameras.yaml."""

    entry: type[CameraEntry]  # its keys; knows how to build the camera
    kind: type[Camera]  # what it builds
    keys: Callable[[Any], dict[str, Tensor]]  # the way back: camera -> its own keys


# A further model: one file with the camera, one class in entries.py, one line here.
MODELS: dict[str, CameraModel] = {
    "tsai": CameraModel(TsaiEntry, TsaiCamera, _tsai_keys),
    "pinhole": CameraModel(PinholeEntry, PinholeCamera, _pinhole_keys),
    "brown": CameraModel(BrownEntry, BrownCamera, _brown_keys),
    "telecentric": CameraModel(TelecentricEntry, TelecentricCamera, _telecentric_keys),
    "openptv": CameraModel(OpenPTVEntry, OpenPTVCamera, _openptv_keys),
}


def build_camera(entry: object, where: str) -> Camera:
    """Build a camera from what cameras.yaml says about it.

    Args:
        entry: its mapping.
        where: file and name of the camera, for the messages.

    Raises:
        CameraError: no mapping, an unknown model or key, a missing key, or an impossible parameter, port or covariance.
    """
    if not isinstance(entry, Mapping):
        raise CameraError(refusal(where, expected="the keys of a camera", got=short(entry), do="indent them below it"))
    if "model" not in entry:
        raise CameraError(refusal(f"{where}, model", expected=f"one of {', '.join(MODELS)}", got="none", do="add it"))
    if not isinstance(entry["model"], str) or entry["model"] not in MODELS:
        raise CameraError(refuse_unknown(entry["model"], MODELS, f"{where}, model"))
    checked = validated(MODELS[entry["model"]].entry, entry, where, CameraError)
    try:
        return _built(checked)
    except CameraError as error:
        raise CameraError(f"{where}, {error}") from None


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Return what cameras.yaml says about a camera: the inverse of `build_camera`.

    Raises:
        CameraError: a camera of a model that has no name.
    """
    if isinstance(camera, PortCamera):
        inner = {key: value for key, value in describe_camera(camera.camera).items() if key != "covariance"}
        return inner | {"port": _port_keys(camera.port)} | _covariance_keys(camera.covariance)
    for name, model in MODELS.items():
        if isinstance(camera, model.kind):
            first: dict[str, Any] = {"model": name, "image_size": list(camera.image_size)}
            numbers = model.keys(camera) | {"R": camera.R_cam_lab, "T": camera.T_cam_lab_mm}
            return first | _plain(numbers) | _covariance_keys(camera.covariance)
    got, do = type(camera).__name__, "register the model in cameras/registry.py"
    raise CameraError(refusal("camera", expected=f"a camera of model {', '.join(MODELS)}", got=got, do=do))


def _built(entry: CameraEntry) -> Camera:
    camera = entry.camera()
    if entry.port is not None:
        camera = PortCamera(camera=camera, port=entry.port.port())
    if entry.covariance is None:
        return camera
    covariance = entry.covariance.covariance()
    known = parameter_names(camera)
    for name in covariance.names:
        if name not in known:
            raise CameraError(refuse_unknown(name, known, "covariance, parameters"))
    return cast(Camera, replace(cast(Any, camera), covariance=covariance))


def _port_keys(port: Port) -> dict[str, Any]:
    numbers = {
        "normal": port.normal,
        "offset": port.offset_mm,
        "thickness": port.thickness_mm,
        "n_glass": port.n_glass,
        "n_fluid": port.n_fluid,
    }
    return _plain(numbers)


def _covariance_keys(covariance: ParameterCovariance | None) -> dict[str, Any]:
    if covariance is None:
        return {}
    return {"covariance": {"parameters": list(covariance.names), "matrix": covariance.matrix.tolist()}}


def _plain(numbers: Mapping[str, Tensor]) -> dict[str, Any]:
    return {key: value.detach().tolist() for key, value in numbers.items()}
