"""cameras.yaml: from file to cameras and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from sphereorient.cameras.camera import Camera
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.cameras.io.entries import CovarianceEntry
from sphereorient.cameras.io.registry import build_camera, describe_camera
from sphereorient.cameras.parameters import parameter_names
from sphereorient.errors import CameraError, refusal
from sphereorient.files.yaml_file import read_document, refuse_unknown, short, validated, write_document

SCHEMA = "sphereorient-cameras/1"
KEYS = ("cameras", "covariance")
MOST = 100  # cameras of a file


def load_cameras(path: Path | str) -> dict[str, Camera]:
    """Read all cameras of a file, in the file's order.

    Args:
        path: a YAML file of schema sphereorient-cameras/1. A camera with a `port` comes as PortCamera; its
            `covariance` is the camera's attribute of that name.

    Raises:
        CameraError: missing, not YAML, another schema, an unknown key or model, or an impossible parameter.

    Source: DESIGN section 2.
    """
    path = Path(path)
    document = read_document(path, SCHEMA, CameraError)
    for key in document:
        if key not in KEYS:
            raise CameraError(refuse_unknown(key, KEYS, str(path)))
    entries = document.get("cameras")
    if not isinstance(entries, dict) or not entries:
        do = "write one camera or more below 'cameras:'"
        raise CameraError(refusal(f"{path}, cameras", expected="named cameras", got=short(entries), do=do))
    if len(entries) > MOST:
        got, do = f"{len(entries)}", "write those of one experiment"
        raise CameraError(refusal(f"{path}, cameras", expected=f"at most {MOST} cameras", got=got, do=do))
    return {str(name): build_camera(entry, f"{path}, {name}") for name, entry in entries.items()}


def load_covariance(path: Path | str, cameras: Mapping[str, Camera]) -> ParameterCovariance | None:
    """Read what a file of cameras says of their errors.

    Args:
        path: the file.
        cameras: those of it that are in use.

    Returns:
        Covariance of the parameters of these cameras together, named camera.parameter. Where the file has none of all
        cameras, their own ones side by side, as if their errors had nothing in common; None where a camera has none.

    Raises:
        CameraError: a covariance that is none.
    """
    path = Path(path)
    entry = read_document(path, SCHEMA, CameraError).get("covariance")
    if entry is None:
        return _side_by_side(cameras)
    where = f"{path}, covariance"
    try:
        whole = validated(CovarianceEntry, entry, where, CameraError).covariance()
    except CameraError as error:
        raise CameraError(str(error) if str(error).startswith(where) else f"{path}, {error}") from None
    for name in whole.names:
        camera, _, parameter = name.partition(".")
        if camera in cameras and parameter not in parameter_names(cameras[camera]):
            known = [f"{camera}.{one}" for one in parameter_names(cameras[camera])]
            raise CameraError(refuse_unknown(name, known, f"{where}, parameters"))
    return whole.of(cameras)


def _side_by_side(cameras: Mapping[str, Camera]) -> ParameterCovariance | None:
    known = {name: camera.covariance for name, camera in cameras.items()}
    parts = {name: covariance for name, covariance in known.items() if covariance is not None}
    if not parts or len(parts) < len(known):
        return None
    names = tuple(f"{name}.{parameter}" for name, covariance in parts.items() for parameter in covariance.names)
    whole = torch.zeros(len(names), len(names), dtype=torch.float64)
    begin = 0
    for part in parts.values():
        share = slice(begin, begin + len(part.names))
        whole[share, share] = part.matrix
        begin = share.stop
    return ParameterCovariance(names=names, matrix=whole)


def save_cameras(
    path: Path | str,
    cameras: Mapping[str, Camera],
    comment: str = "",
    covariance: ParameterCovariance | None = None,
) -> None:
    """Write cameras to a file that `load_cameras` reads back to the last bit, ports and covariances among them.

    Args:
        path: the file; an old one is replaced at once.
        cameras: name -> camera.
        comment: lines for the top of the file.
        covariance: of all cameras together, where a joint fit made them: their errors are correlated.

    Raises:
        CameraError: a camera whose model has no name in cameras.yaml.
        OutputError: the file cannot be written.
    """
    document: dict[str, Any] = {"cameras": {name: describe_camera(camera) for name, camera in cameras.items()}}
    if covariance is not None:
        document["covariance"] = {"parameters": list(covariance.names), "matrix": covariance.matrix.tolist()}
    write_document(Path(path), SCHEMA, document, comment)
