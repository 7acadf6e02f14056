import csv
import io
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat, PositiveInt, StrictInt
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.targets import FIDUCIALS, CalibrationTarget, DotPlate, missing_keys, plate_from_entry
from sphereorient.cameras import Port
from sphereorient.cameras.checks import camera_error, check_camera_names, check_known, check_rotation, named
from sphereorient.cameras.io.cameras_yaml import Entry, PortEntry
from sphereorient.cameras.parameters import PORT_NUMBERS, PORT_TILT
from sphereorient.errors import CameraError
from sphereorient.files.whole_file import TABLE_BYTES, read_whole
from sphereorient.files.yaml_file import read_document, short, validated

SCHEMA = "sphereorient-calibration/1"
ROTATION_TOLERANCE = 1e-4  # of R R^T - 1: rounding to four digits after the point
COLUMNS = ("x", "y", "z", "u", "v")  # mm, mm, mm, px, px
Positive = Annotated[FiniteFloat, Field(gt=0)]
_Triple = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
ModelName = Literal["tsai", "pinhole", "brown"]
# Points of tables are lab points, as on a plate whose frame is the lab.
IN_THE_LAB = {0: (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))}


class SurveyedKeys(Entry):
    """The plate's pose in the lab in one picture; it defines the lab frame."""

    pose: int
    R_lab_plate: tuple[_Triple, _Triple, _Triple]
    T_lab_plate: _Triple


class PictureKeys(BaseModel, frozen=True, extra="allow"):
    """One pose: its number, the picture of each camera, and its clicked fiducials."""

    __pydantic_extra__: dict[str, str]
    pose: StrictInt
    clicked: dict[str, list[tuple[FiniteFloat, FiniteFloat]]] = {}  # camera -> px, see `checked_clicks`


class CalibrationKeys(BaseModel, frozen=True, extra="forbid"):
    """Keys of calibration.yaml (docs/calibration.md)."""

    image_size: tuple[PositiveInt, PositiveInt]  # W, H px
    pixel_pitch: tuple[Positive, Positive]  # mm
    plate: Any = None
    surveyed: SurveyedKeys | None = None
    ports: dict[str, PortEntry] = {}
    pictures: list[PictureKeys] = []
    points: dict[str, str] = {}
    model: ModelName = "tsai"
    fit_ports: tuple[str, ...] = ()  # parameters of the ports to fit


@dataclass(frozen=True, kw_only=True, eq=False)
class Photo:
    """One picture of the plate."""

    camera: str
    row: int  # of the pose
    path: Path
    clicked_px: NDArray[np.float64] | None = None  # (2 or 3, 2), approximate fiducials, in the plate's order


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationDocument:
    """A checked calibration.yaml."""

    path: Path
    keys: CalibrationKeys
    plate: CalibrationTarget | None
    poses: tuple[int, ...]  # numbers of the poses, by row
    surveyed: Mapping[int, tuple[Tensor, Tensor]]  # row of the pose -> R_lab_plate, T_lab_plate (mm)
    pictures: tuple[Photo, ...]
    points: Mapping[str, Path]  # camera -> table of lab points and their pixels
    cameras: tuple[str, ...]  # names, in the file's order
    ports: Mapping[str, Port]


def load_calibration(path: Path | str) -> CalibrationDocument:
    """Read calibration.yaml, without its pictures and tables; CameraError if missing, malformed or incomplete."""
    path = Path(path)
    do = "write one with `sphereorient init --plate FOLDER`, or correct the path"
    document = read_document(path, SCHEMA, CameraError, do)
    missing = [f"plate.{key}" for key in missing_keys(document.get("plate"))]
    keys = validated(CalibrationKeys, document, str(path), CameraError, missing)
    if bool(keys.pictures) == bool(keys.points):
        got, do = ("both" if keys.points else "neither"), "name pictures of a plate, or tables of points"
        raise camera_error(f"{path}, pictures, points", "one of them", got, do)
    if keys.pictures and keys.plate is None:
        raise camera_error(f"{path}, plate", "a plate", "none", "write what the plate is: type, columns, rows, pitch")
    numbers = tuple(sorted({one.pose for one in keys.pictures})) or (0,)
    pictures = tuple(_pictures(keys, path, numbers))
    plate = plate_from_entry(keys.plate, f"{path}, plate") if keys.pictures else None
    if not isinstance(plate, DotPlate) and any(picture.clicked_px is not None for picture in pictures):
        raise camera_error(f"{path}, clicked", "a plate with fiducials, of type dots", "another one", "remove the key")
    cameras = tuple(dict.fromkeys([*(picture.camera for picture in pictures), *keys.points]))
    check_camera_names(cameras, f"{path}, {'pictures' if keys.pictures else 'points'}")
    return CalibrationDocument(
        path=path,
        keys=keys,
        plate=plate,
        poses=numbers,
        surveyed=_surveyed(keys, path, numbers) if keys.pictures else IN_THE_LAB,
        pictures=pictures,
        points={name: path.parent / file for name, file in keys.points.items()},
        cameras=cameras,
        ports=_ports(keys, path, cameras),
    )


def read_points(path: Path) -> NDArray[np.float64]:
    """Read a CSV table with columns x, y, z (lab, mm), u, v (px), in any order, as (n, 5); CameraError if malformed."""
    content = read_whole(path, TABLE_BYTES, "a table", CameraError, "correct the path")
    try:
        rows = list(csv.DictReader(io.StringIO(content.decode("utf-8-sig"), newline=""), skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error) as fault:
        raise camera_error(str(path), "a table", "a file that is not CSV", "save the table as CSV") from fault
    known = [name.strip() for name in rows[0] if name is not None] if rows else []
    missing = [name for name in COLUMNS if name not in known]
    if missing:
        expected, do = f"a first line {','.join(COLUMNS)} and one row a point", "write mm in the lab, and px"
        raise camera_error(str(path), expected, f"no {', '.join(missing)}" if rows else "no rows", do)
    return np.array([[_number(path, k, row, name) for name in COLUMNS] for k, row in enumerate(rows)])


def _number(path: Path, k: int, row: dict[str, str], name: str) -> float:
    with suppress(ValueError):
        value = float(row.get(name) or "")
        if np.isfinite(value):
            return value
    do = "correct the number, or leave the point out"
    raise camera_error(f"{path}, row {k + 1}, {name}", "a number", short(row.get(name)), do)


def _ports(keys: CalibrationKeys, path: Path, cameras: tuple[str, ...]) -> dict[str, Port]:
    ports = {}
    check_known(keys.ports, cameras, f"{path}, ports")
    for name, entry in keys.ports.items():
        with named(f"{path}, ports, {name}"):
            ports[name] = entry.port()
    where = f"{path}, fit_ports"
    check_known(keys.fit_ports, (*PORT_NUMBERS, *PORT_TILT), where)
    if keys.fit_ports and not keys.ports:
        do = "write under `ports` approximately where the walls are"
        raise camera_error(where, "ports to fit", "none", do)
    if len(set(keys.fit_ports)) < len(keys.fit_ports):
        raise camera_error(where, "different names", ", ".join(keys.fit_ports), "name each once")
    return ports


def _pictures(keys: CalibrationKeys, path: Path, numbers: tuple[int, ...]) -> Iterator[Photo]:
    seen = set()
    for k, entry in enumerate(keys.pictures):
        row, files, where = numbers.index(entry.pose), entry.model_extra or {}, f"{path}, pictures, {k}"
        if not files:
            do = "name a picture, such as cam1: cam1_00.png, or leave the entry out"
            raise camera_error(where, "a picture", "none", do)
        for name, file in files.items():
            if (row, name) in seen:
                got, do = f"a second one of pose {entry.pose}", "give every pose its own number"
                raise camera_error(f"{where}, {name}", "one picture of a pose", got, do)
            seen.add((row, name))
            clicked = None
            if name in entry.clicked:
                clicked = checked_clicks(entry.clicked[name], keys.image_size, f"{where}, clicked, {name}")
            yield Photo(camera=name, row=row, path=path.parent / file, clicked_px=clicked)
        check_known(entry.clicked, files, f"{where}, clicked")


def checked_clicks(points: Any, image_size: tuple[int, int], where: str) -> NDArray[np.float64]:
    """Return clicked fiducials (two or three pairs u, v, px: the origin, on +x, on +y) as an array (2 or 3, 2);
    CameraError for another number, or points outside a picture of `image_size` (W, H).
    """
    do, clicked = "click them again, or remove the points", np.zeros((0, 0))
    with suppress(TypeError, ValueError):
        clicked = np.asarray(points, dtype=np.float64)
    if clicked.shape not in ((2, 2), (3, 2)):
        raise camera_error(where, f"two or three pairs u, v: {', '.join(FIDUCIALS)}", short(points), do)
    for name, uv_px in zip(FIDUCIALS, clicked, strict=False):
        if not ((uv_px >= -0.5) & (uv_px <= np.array(image_size) - 0.5)).all():
            expected = f"a point inside {image_size[0]} x {image_size[1]} px"
            raise camera_error(f"{where}, {name}", expected, f"{uv_px.tolist()}", do)
    return clicked


def _surveyed(keys: CalibrationKeys, path: Path, numbers: tuple[int, ...]) -> dict[int, tuple[Tensor, Tensor]]:
    where, known = f"{path}, surveyed", keys.surveyed
    if known is None:
        do = "write the plate's pose in the lab in one picture: pose, R_lab_plate, T_lab_plate"
        raise camera_error(where, "a pose that defines the lab frame", "none", do)
    if known.pose not in numbers:
        got = f"pose {known.pose}, without a picture"
        raise camera_error(where, "a pose with a picture", got, "name a pose that was filmed")
    R, T = (torch.tensor(part, dtype=torch.float64) for part in (known.R_lab_plate, known.T_lab_plate))
    do = "write the plate's x, y and z axis in the lab as its columns"
    check_rotation(f"{where}, R_lab_plate", R, ROTATION_TOLERANCE, do)
    return {numbers.index(known.pose): (so3.nearest_rotation(R), T)}
