"""The names of a camera's parameters, and cameras with small changes of them.

All models have `rotation_x`, `rotation_y`, `rotation_z` (rad, camera frame: R_true = exp([delta]x) R, T unchanged) and
`T_x`, `T_y`, `T_z` (mm). Others are named as in cameras.yaml, in parts `centre_u`, `centre_v`, `k1`, `k2`, `k3`. A port
has `port_offset`, `port_thickness` (mm), `port_n_glass`, `port_n_fluid`, and `port_tilt_x`, `port_tilt_y`,
`port_tilt_z` (rad, lab: normal_true = exp([delta]x) normal, offset unchanged; about the normal no effect).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.checks import camera_error, check_known
from sphereorient.cameras.model import CameraModel
from sphereorient.cameras.port import Port, PortCamera
from sphereorient.errors import check_tail

AnyCamera = TypeVar("AnyCamera", bound=Camera)
ROTATION = ("rotation_x", "rotation_y", "rotation_z")
TRANSLATION = ("T_x", "T_y", "T_z")
PORT_TILT = ("port_tilt_x", "port_tilt_y", "port_tilt_z")
PORT_NUMBERS = {f"port_{key.name}": key.field for key in Port.KEYS if not key.parts}


def parameter_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of all parameters that `with_parameters` can change; CameraError unless a `CameraModel`."""
    if isinstance(camera, PortCamera):
        return (*parameter_names(camera.camera), *PORT_NUMBERS, *PORT_TILT)
    if not isinstance(camera, CameraModel):
        got, do = type(camera).__name__, "derive the model from CameraModel"
        raise camera_error("camera", "a model that names its parameters", got, do)
    return (*camera.parameter_fields(), *ROTATION, *TRANSLATION)


def with_parameters(camera: AnyCamera, names: Sequence[str], delta: Tensor) -> AnyCamera:
    """Return the camera with small changes `delta` (P,) of the parameters `names`, in their units; differentiable.
    Raises CameraError (an unknown name, a name twice, or changes that make the camera impossible), ShapeError (`delta`
    has another shape).
    """
    check_tail("delta", delta, len(names))
    check_known(names, parameter_names(camera), "parameter")
    change = dict(zip(names, delta.to(torch.float64).unbind(), strict=True))
    if len(change) < len(names):
        raise camera_error("parameters", "different names", ", ".join(names), "name every parameter once")
    return cast(AnyCamera, _changed(camera, change))


def _changed(camera: Camera, change: Mapping[str, Tensor]) -> Camera:
    fields: dict[str, Any] = {}
    if isinstance(camera, PortCamera):
        wall = camera.port
        fields = {field: getattr(wall, field) + change[name] for name, field in PORT_NUMBERS.items() if name in change}
        if any(name in change for name in PORT_TILT):
            fields["normal"] = so3.exp(_vector(change, PORT_TILT)) @ wall.normal
        return replace(camera, camera=_changed(camera.camera, change), port=replace(wall, **fields))
    assert isinstance(camera, CameraModel)
    for name, (field, place) in camera.parameter_fields().items():
        if name in change:
            value: Tensor = fields.get(field, getattr(camera, field))
            unit = torch.zeros_like(value)
            unit[() if place is None else place] = 1.0
            fields[field] = value + change[name] * unit
    if any(name in change for name in ROTATION):
        fields["R_cam_lab"] = so3.exp(_vector(change, ROTATION)) @ camera.R_cam_lab
    if any(name in change for name in TRANSLATION):
        fields["T_cam_lab_mm"] = camera.T_cam_lab_mm + _vector(change, TRANSLATION)
    return replace(camera, **fields)


def _vector(change: Mapping[str, Tensor], names: tuple[str, str, str]) -> Tensor:
    zero = torch.zeros_like(next(iter(change.values())))
    return torch.stack([change.get(name, zero) for name in names])
