"""calibration.yaml: what was filmed, and what is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from sphereorient.calibration.entry import Target, plate_from_entry
from sphereorient.cameras import Port
from sphereorient.cameras.io.cameras_yaml import PortEntry
from sphereorient.cameras.parameters import PORT_NUMBERS, PORT_TILT
from sphereorient.errors import CameraError, refusal
from sphereorient.files.yaml_file import read_document, refuse_unknown, short, validated

SCHEMA = "sphereorient-calibration/1"
ROTATION_TOLERANCE = 1e-4  # of R R^T - 1: what four digits after the point leave
Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Pixels = Annotated[int, Field(gt=0)]
Triple = tuple[Number, Number, Number]
Model = Literal["tsai", "pinhole", "brown"]
# Points of tables are in the lab already: a plate that lies in the lab's own axes.
IN_THE_LAB = {0: (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))}


class SurveyedKeys(BaseModel):
    """Where the plate stood in the lab in one pose; this defines the lab frame."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    pose: int
    R_lab_plate: tuple[Triple, Triple, Triple]
    T_lab_plate: Triple


class CalibrationKeys(BaseModel):
    """Keys of calibration.yaml (DESIGN section 2)."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    image_size: tuple[Pixels, Pixels]
    pixel_pitch: tuple[Positive, Positive]
    plate: Any = None
    surveyed: SurveyedKeys | None = None
    ports: dict[str, PortEntry] = {}
    pictures: list[dict[str, Any]] = []
    points: dict[str, str] = {}
    model: Model = "tsai"
    fit_ports: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """One picture of the plate."""

    camera: str
    row: int  # of the pose
    path: Path


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationDocument:
    """A calibration.yaml, checked; made by `load_calibration`."""

    path: Path
    image_size: tuple[int, int]  # W, H px
    pixel_pitch_mm: tuple[float, float]
    model: Model
    plate: Target | None
    poses: tuple[int, ...]  # numbers of the poses, by row
    surveyed: Mapping[int, tuple[Tensor, Tensor]]  # row of the pose -> R_lab_plate, T_lab_plate (mm)
    pictures: tuple[Picture, ...]
    points: Mapping[str, Path]  # camera -> table of points in the lab and their pixels
    ports: Mapping[str, Port]
    fit_ports: tuple[str, ...]  # names of the ports' parameters that are fitted too

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in the order in which the file names them."""
        return tuple(dict.fromkeys([*(picture.camera for picture in self.pictures), *self.points]))


def load_calibration(path: Path | str) -> CalibrationDocument:
    """Read calibration.yaml; pictures and tables are opened by who needs them.

    Raises:
        CameraError: missing, malformed, or without what a calibration needs.
    """
    path = Path(path)
    keys = validated(CalibrationKeys, read_document(path, SCHEMA, CameraError), str(path), CameraError)
    if bool(keys.pictures) == bool(keys.points):
        got, do = ("both" if keys.points else "neither"), "name pictures of a plate, or tables of points"
        raise CameraError(refusal(f"{path}, pictures, points", expected="one of them", got=got, do=do))
    numbers = _pose_numbers(keys, path) if keys.pictures else (0,)
    pictures = _pictures(keys, path, numbers)
    if keys.pictures and keys.plate is None:
        do = "say what the plate is: type, columns, rows, pitch"
        raise CameraError(refusal(f"{path}, plate", expected="a plate", got="none", do=do))
    document = CalibrationDocument(
        path=path,
        image_size=keys.image_size,
        pixel_pitch_mm=keys.pixel_pitch,
        model=keys.model,
        plate=plate_from_entry(keys.plate, f"{path}, plate") if keys.pictures else None,
        poses=numbers,
        surveyed=_surveyed(keys, path, numbers) if keys.pictures else IN_THE_LAB,
        pictures=pictures,
        points={name: path.parent / file for name, file in keys.points.items()},
        ports=_ports(keys, path),
        fit_ports=keys.fit_ports,
    )
    _check_ports(keys, path, document.cameras)
    return document


def _ports(keys: CalibrationKeys, path: Path) -> dict[str, Port]:
    ports = {}
    for name, entry in keys.ports.items():
        try:
            ports[name] = entry.port()
        except CameraError as error:
            raise CameraError(f"{path}, ports, {name}, {error}") from None
    return ports


def _check_ports(keys: CalibrationKeys, path: Path, cameras: tuple[str, ...]) -> None:
    for name in keys.ports:
        if name not in cameras:
            do = f"name one of {', '.join(cameras)}"
            raise CameraError(refusal(f"{path}, ports", expected="a camera with pictures", got=f"'{name}'", do=do))
    for name in keys.fit_ports:
        if name not in (*PORT_NUMBERS, *PORT_TILT):
            raise CameraError(refuse_unknown(name, (*PORT_NUMBERS, *PORT_TILT), f"{path}, fit_ports"))
    if keys.fit_ports and not keys.ports:
        do = "say under `ports` where the walls are, as well as you know"
        raise CameraError(refusal(f"{path}, fit_ports", expected="ports to fit", got="none", do=do))
    if len(set(keys.fit_ports)) < len(keys.fit_ports):
        got, do = ", ".join(keys.fit_ports), "name each once"
        raise CameraError(refusal(f"{path}, fit_ports", expected="different names", got=got, do=do))


def _pose_numbers(keys: CalibrationKeys, path: Path) -> tuple[int, ...]:
    numbers = []
    for k, entry in enumerate(keys.pictures):
        pose = entry.get("pose")
        if isinstance(pose, bool) or not isinstance(pose, int):
            expected, do = "a whole number", "number the plate's poses"
            raise CameraError(refusal(f"{path}, pictures, {k}, pose", expected=expected, got=short(pose), do=do))
        numbers.append(pose)
    return tuple(sorted(set(numbers)))


def _pictures(keys: CalibrationKeys, path: Path, numbers: tuple[int, ...]) -> tuple[Picture, ...]:
    pictures, seen = [], set()
    for k, entry in enumerate(keys.pictures):
        row = numbers.index(entry["pose"])
        if len(entry) == 1:
            do = "name a picture, such as cam1: cam1_00.png, or leave the entry out"
            raise CameraError(refusal(f"{path}, pictures, {k}", expected="a picture", got="none", do=do))
        for name, file in entry.items():
            if name == "pose":
                continue
            where = f"{path}, pictures, {k}, {name}"
            if not isinstance(file, str):
                raise CameraError(refusal(where, expected="a file", got=short(file), do="name a picture"))
            if (row, name) in seen:
                got, do = f"a second one of pose {entry['pose']}", "give every pose its own number"
                raise CameraError(refusal(where, expected="one picture of a pose", got=got, do=do))
            seen.add((row, name))
            pictures.append(Picture(camera=str(name), row=row, path=path.parent / file))
    return tuple(pictures)


def _surveyed(keys: CalibrationKeys, path: Path, numbers: tuple[int, ...]) -> dict[int, tuple[Tensor, Tensor]]:
    where = f"{path}, surveyed"
    if keys.surveyed is None:
        do = "say where the plate stood in the lab in one pose: pose, R_lab_plate, T_lab_plate"
        raise CameraError(refusal(where, expected="a pose that defines the lab frame", got="none", do=do))
    if keys.surveyed.pose not in numbers:
        got, do = f"pose {keys.surveyed.pose}, without a picture", "name a pose that was filmed"
        raise CameraError(refusal(where, expected="a pose with a picture", got=got, do=do))
    R = torch.tensor(keys.surveyed.R_lab_plate, dtype=torch.float64)
    off = float((R @ R.mT - torch.eye(3, dtype=torch.float64)).abs().max())
    if off > ROTATION_TOLERANCE or float(torch.linalg.det(R)) < 0:
        got = "a reflection" if off <= ROTATION_TOLERANCE else f"rows that are {off:.2g} from it"
        do = "write the plate's x, y and z axis in the lab as its columns"
        raise CameraError(refusal(f"{where}, R_lab_plate", expected="a rotation", got=got, do=do))
    U, _, Vh = torch.linalg.svd(R)
    return {numbers.index(keys.surveyed.pose): (U @ Vh, torch.tensor(keys.surveyed.T_lab_plate, dtype=torch.float64))}
