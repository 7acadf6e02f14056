"""cameras.yaml: from file to cameras and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sphereorient.cameras.camera import Camera
from sphereorient.cameras.registry import build_camera, describe_camera
from sphereorient.cameras.yaml_file import read_document, refuse_unknown, write_document
from sphereorient.errors import CameraError, refusal

SCHEMA = "sphereorient-cameras/1"


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
        if key != "cameras":
            raise CameraError(refuse_unknown(key, ["cameras"], str(path)))
    entries = document.get("cameras")
    if not isinstance(entries, dict) or not entries:
        do = "write one camera or more below 'cameras:'"
        raise CameraError(refusal(f"{path}, cameras", expected="named cameras", got=repr(entries)[:60], do=do))
    return {str(name): build_camera(entry, f"{path}, {name}") for name, entry in entries.items()}


def save_cameras(path: Path | str, cameras: Mapping[str, Camera], comment: str = "") -> None:
    """Write cameras to a file that `load_cameras` reads back to the last bit, ports and covariances among them.

    Args:
        path: the file; an old one is replaced at once.
        cameras: name -> camera.
        comment: lines for the top of the file.

    Raises:
        CameraError: a camera whose model has no name in cameras.yaml.
        OutputError: the file cannot be written.
    """
    document = {"cameras": {name: describe_camera(camera) for name, camera in cameras.items()}}
    write_document(Path(path), SCHEMA, document, comment)
