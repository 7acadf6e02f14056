from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, create_model
from scipy.linalg import block_diag

from sphereorient.cameras.brown import BrownCamera, OpenPTVCamera, TsaiCamera
from sphereorient.cameras.camera import Camera, ParameterCovariance
from sphereorient.cameras.checks import camera_error, check_camera_names, check_known, named
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.cameras.model import CameraModel, Key, PinholeCamera, TelecentricCamera
from sphereorient.cameras.parameters import parameter_names
from sphereorient.cameras.port import Port, PortCamera
from sphereorient.errors import CameraError
from sphereorient.files.yaml_file import read_document, refuse_unknown, short, validated, write_document

SCHEMA = "sphereorient-cameras/1"
KEYS = ("cameras", "covariance")
MOST = 100  # cameras of a file
Triple = tuple[float, float, float]
IN_ITS_OWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0)  # frame: R and T
# By the number of parts of a key.
HOLDS: dict[int, Any] = {0: float, 2: tuple[float, float], 3: Triple, 4: tuple[float, float, float, float]}

# To add a model: one file with the camera, one name here.
KINDS = TsaiCamera, PinholeCamera, BrownCamera, FisheyeCamera, TelecentricCamera, OpenPTVCamera
MODELS: dict[str, type[CameraModel]] = {kind.MODEL: kind for kind in KINDS}


class Entry(BaseModel, frozen=True, extra="forbid"):
    """A mapping of cameras.yaml; unknown keys are refused."""


class PortEntry(Entry):
    """Keys of `port`."""

    normal: Triple
    offset: float
    thickness: float
    n_glass: float
    n_fluid: float

    def port(self) -> Port:
        """Build the port."""
        return Port(**{key.field: getattr(self, key.name) for key in Port.KEYS})


class CovarianceEntry(Entry):
    """Keys of `covariance`, which a calibration adds."""

    parameters: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def covariance(self) -> ParameterCovariance:
        """Build the covariance."""
        lengths = {len(row) for row in self.matrix}
        if lengths != {len(self.parameters)}:
            got, do = f"lengths {sorted(lengths)}", "write one row and one column for each parameter"
            raise camera_error("covariance, matrix", f"rows of {len(self.parameters)} numbers", got, do)
        return ParameterCovariance(names=self.parameters, matrix=torch.tensor(self.matrix, dtype=torch.float64))


class CameraEntry(Entry):
    """The keys common to all models."""

    model: str
    image_size: tuple[int, int]
    R: tuple[Triple, Triple, Triple] | None = None  # None, with T: a single camera, whose frame is the lab
    T: Triple | None = None
    port: PortEntry | None = None
    covariance: CovarianceEntry | None = None


def _entry(kind: type[CameraModel]) -> type[CameraEntry]:
    fields: dict[str, Any] = dict.fromkeys(kind.ALSO, (float | None, None))
    for key in kind.KEYS:
        holds = HOLDS[len(key.parts)]
        usual = (key.default,) * len(key.parts) if key.parts else key.default
        fields[key.name] = (holds | None, None) if key.optional else (holds, ... if key.default is None else usual)
    return create_model(f"{kind.__name__}Entry", __base__=CameraEntry, **fields)


ENTRIES = {name: _entry(kind) for name, kind in MODELS.items()}


def add_model(kind: type[CameraModel]) -> None:
    """Register another model, a dataclass with `MODEL` and `KEYS`, for cameras.yaml, in this process."""
    MODELS[kind.MODEL], ENTRIES[kind.MODEL] = kind, _entry(kind)


def load_cameras(path: Path | str) -> dict[str, Camera]:
    """Read all cameras of a cameras.yaml (docs/cameras.md), in its order; a camera with a `port` becomes a PortCamera.
    Raises CameraError: missing, not YAML, another schema, an unknown key or model, or an impossible parameter.
    """
    path = Path(path)
    document = read_document(path, SCHEMA, CameraError, "write it with `sphereorient calibrate`, or correct the path")
    check_known(document, KEYS, str(path))
    entries = document.get("cameras")
    if not isinstance(entries, dict) or not entries:
        do = "write one camera or more below 'cameras:'"
        raise camera_error(f"{path}, cameras", "named cameras", short(entries), do)
    if len(entries) > MOST:
        do = "write those of one experiment"
        raise camera_error(f"{path}, cameras", f"at most {MOST} cameras", f"{len(entries)}", do)
    check_camera_names(map(str, entries), f"{path}, cameras")
    alone = len(entries) == 1
    return {str(name): _build(entry, f"{path}, {name}", alone) for name, entry in entries.items()}


def load_covariance(path: Path | str, cameras: Mapping[str, Camera]) -> ParameterCovariance | None:
    """Read the joint covariance of the given cameras from cameras.yaml, with parameters named camera.parameter.
    Cameras that it does not name add their own as independent blocks; None if one of these has none. CameraError if
    impossible.
    """
    path = Path(path)
    entry = read_document(path, SCHEMA, CameraError).get("covariance")
    if entry is None:
        return _with_own(None, cameras)
    where = f"{path}, covariance"
    checked = validated(CovarianceEntry, entry, where, CameraError)
    with named(str(path)):
        own = checked.covariance().of(cameras)
    known = [f"{name}.{parameter}" for name, camera in cameras.items() for parameter in parameter_names(camera)]
    check_known(() if own is None else own.names, known, f"{where}, parameters")
    return _with_own(own, cameras)


def save_cameras(
    path: Path | str,
    cameras: Mapping[str, Camera],
    comment: str = "",
    covariance: ParameterCovariance | None = None,
    unplaced: Collection[str] = (),
) -> None:
    """Write cameras, by name, to a file that `load_cameras` reads back to the last bit; replace an old file atomically.
    `comment` comes first in the file; `covariance`: of a joint fit; cameras named in `unplaced` get no R and T. Raises
    CameraError (a model that is not in MODELS, a name that is refused), OutputError (a file that cannot be written).
    """
    check_camera_names(cameras, f"{path}, cameras")
    document: dict[str, Any] = {"cameras": {name: _described(camera) for name, camera in cameras.items()}}
    for name in unplaced:
        del document["cameras"][name]["R"], document["cameras"][name]["T"]
    write_document(Path(path), SCHEMA, document | _covariance_keys(covariance), comment)


def _build(entry: object, where: str, alone: bool) -> Camera:
    if not isinstance(entry, Mapping):
        raise camera_error(where, "the keys of a camera", short(entry), "indent them below it")
    if "model" not in entry:
        raise camera_error(f"{where}, model", f"one of {', '.join(MODELS)}", "none", "add it")
    if not isinstance(entry["model"], str) or entry["model"] not in MODELS:
        raise CameraError(refuse_unknown(entry["model"], MODELS, f"{where}, model"))
    checked = validated(ENTRIES[entry["model"]], entry, where, CameraError)
    missing = [name for name in ("R", "T") if getattr(checked, name) is None]
    if missing and not (alone and len(missing) == 2):
        do = "write both, X_cam = R X_lab + T; a single camera whose frame is the lab's has neither"
        raise camera_error(f"{where}, {' and '.join(missing)}", "the camera's pose in the lab", "none", do)
    with named(where):
        lens = _lens(MODELS[checked.model], checked)
        whole = lens if checked.port is None else PortCamera(camera=lens, port=checked.port.port())
        if checked.covariance is None:
            return whole
        covariance = checked.covariance.covariance()
        check_known(covariance.names, parameter_names(whole), "covariance, parameters")
        return replace(whole, covariance=covariance)


def _lens(kind: type[CameraModel], entry: CameraEntry) -> CameraModel:
    values = kind.completed(dict(entry))
    R, T = entry.R or IN_ITS_OWN[0], entry.T or IN_ITS_OWN[1]
    fields: dict[str, Any] = {"image_size": entry.image_size, "R_cam_lab": R, "T_cam_lab_mm": T}
    for key in kind.KEYS:
        if key.place is None:
            fields[key.field] = values[key.name]
        else:
            fields.setdefault(key.field, []).append(values[key.name])
    return kind(**fields)


def _described(camera: Camera) -> dict[str, Any]:
    if isinstance(camera, PortCamera):
        inner = {key: value for key, value in _described(camera.camera).items() if key != "covariance"}
        return inner | {"port": _values(Port.KEYS, camera.port)} | _covariance_keys(camera.covariance)
    if not isinstance(camera, CameraModel) or camera.MODEL not in MODELS:
        do = "register the model in cameras/io/cameras_yaml.py"
        raise camera_error("camera", f"a camera of model {', '.join(MODELS)}", type(camera).__name__, do)
    pose = {"R": camera.R_cam_lab.detach().tolist(), "T": camera.T_cam_lab_mm.detach().tolist()}
    first: dict[str, Any] = {"model": camera.MODEL, "image_size": list(camera.image_size)}
    return first | _values(camera.KEYS, camera) | pose | _covariance_keys(camera.covariance)


def _values(keys: tuple[Key, ...], owner: CameraModel | Port) -> dict[str, Any]:
    fields = {key.name: getattr(owner, key.field).detach() for key in keys}
    return {key.name: fields[key.name][... if key.place is None else key.place].tolist() for key in keys}


def _covariance_keys(covariance: ParameterCovariance | None) -> dict[str, Any]:
    if covariance is None:
        return {}
    return {"covariance": {"parameters": list(covariance.names), "matrix": covariance.matrix.tolist()}}


def _with_own(joint: ParameterCovariance | None, cameras: Mapping[str, Camera]) -> ParameterCovariance | None:
    """Add to a joint covariance those of cameras that it does not name, as diagonal blocks; None if one has none."""
    names, blocks = ([], []) if joint is None else ([*joint.names], [joint.matrix])
    inside = {name.rpartition(".")[0] for name in names}
    for name, camera in cameras.items():
        if name not in inside:
            if camera.covariance is None:
                return None
            names += [f"{name}.{parameter}" for parameter in camera.covariance.names]
            blocks.append(camera.covariance.matrix)
    return ParameterCovariance(names=tuple(names), matrix=torch.from_numpy(block_diag(*blocks))) if names else None
