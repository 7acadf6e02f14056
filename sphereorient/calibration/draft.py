"""Draft of a calibration.yaml from a folder of plate pictures: dots counted, fiducials found, poses by number."""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sphereorient.calibration.dots import find_dots
from sphereorient.calibration.lattice import LEAST_DOTS, find_lattice
from sphereorient.calibration.plates import Progress, read_plate_picture
from sphereorient.calibration.targets import Ints
from sphereorient.cameras.checks import camera_error
from sphereorient.files.threads import side_by_side
from sphereorient.files.yaml_file import DraftKey

ENDINGS = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
NUMBERED = re.compile(r"^(?P<camera>.*?)[-_ ]*(?P<pose>\d+)$")
NORMALS = ([0, -1, 0], [0, 0, 1], [-1, 0, 0], [0, 1, 0])  # of walls, examples: one wall per camera
LARGER = 1.25  # of the usual width: a larger dot
CERTAIN = 30  # dots in a lattice from which the other polarity is not tried
DIAMETERS = {"plate.dot_diameter": "width", "plate.fiducial_diameter": "larger"}  # keys, and parts of `PlateSeen`


@dataclass(frozen=True, kw_only=True, eq=False)
class PlateSeen:
    """The plate of dots in one picture."""

    size: tuple[int, int]  # W, H px
    columns: int = 0  # dots along x, or the longer side if x is unknown; 0: no lattice of dots
    rows: int = 0
    dark: bool = True
    width: float = math.nan  # of a usual dot, in pitches; NaN: none
    larger: float = math.nan  # of a larger dot; NaN: none
    marks: tuple[int, int] | None = None  # dots from the origin to the larger dots on x and y; None: not three


def numbered_pictures(folder: Path) -> dict[int, dict[str, str]]:
    """Return pictures by pose and camera: cam1_07.png, or 07.png of a single one; CameraError without such names."""
    poses: dict[int, dict[str, str]] = defaultdict(dict)
    files = sorted(path for path in folder.glob("*") if path.suffix.lower() in ENDINGS)
    for path in files:
        if found := NUMBERED.match(path.stem):
            poses[int(found["pose"])][found["camera"] or "cam1"] = path.name
    if not poses:
        got = f"{len(files)} pictures, none with a number" if files else "no pictures"
        do = "name pictures by camera and pose: cam1_00.png, cam2_00.png, cam1_01.png"
        raise camera_error(str(folder), "numbered pictures of the plate", got, do)
    return {pose: dict(sorted(poses[pose].items())) for pose in sorted(poses)}


def look_at_plate(path: Path) -> PlateSeen:
    """Find the dots of a picture, dark or bright; CameraError if it cannot be decoded."""
    picture = read_plate_picture(path)
    size = picture.shape[1], picture.shape[0]
    best, dark, most = None, True, LEAST_DOTS
    for polarity in (True, False):
        lattice = find_lattice(find_dots(picture, dark=polarity)) if most <= CERTAIN else None
        if lattice is not None and len(lattice.index) > most:
            best, dark, most = lattice, polarity, len(lattice.index)
    if best is None:
        return PlateSeen(size=size)
    usual = float(np.median(best.width))
    large = best.width > LARGER * usual
    extent = (np.ptp(best.index, axis=0) + 1).tolist()
    axis, marks = _marks(best.index[large])
    columns, rows = sorted(extent, reverse=True) if axis is None else (extent[axis], extent[1 - axis])
    larger = float(np.median(best.width[large])) if large.any() else math.nan
    return PlateSeen(size=size, columns=columns, rows=rows, dark=dark, width=usual, larger=larger, marks=marks)


def _marks(large: Ints) -> tuple[int | None, tuple[int, int] | None]:
    """Return the lattice axis that is the plate's x, and the dots between the origin and the larger dots on x and y.
    The origin is the larger dot with the right angle between the other two; from the front, y is left of x.
    """
    if len(large) != 3:
        return None, None
    for k in range(3):
        first, second = np.delete(large, k, axis=0) - large[k]
        if (first != 0).sum() != 1 or (second != 0).sum() != 1 or first @ second:
            continue
        x, y = (first, second) if first[0] * second[1] > first[1] * second[0] else (second, first)
        return int(np.flatnonzero(x)[0]), (int(np.abs(x).max()), int(np.abs(y).max()))
    return None, None


def calibration_keys(
    folder: Path, pictures: Mapping[int, Mapping[str, str]], where: str, progress: Progress
) -> tuple[list[DraftKey], dict[str, float]]:
    """Return the keys of calibration.yaml, measured in the pictures of `folder`, and the widths of dots, in pitches, by
    key. `where`: folder as the file names it. Raises CameraError (an unreadable picture, pictures of several sizes, or
    no plate of dots in any).
    """
    paths = [folder / name for of_pose in pictures.values() for name in of_pose.values()]
    seen: list[PlateSeen] = []
    progress("plate", 0, len(paths))
    for one in side_by_side(look_at_plate, paths):
        seen.append(one)
        progress("plate", len(seen), len(paths))
    sizes = Counter(one.size for one in seen)
    if len(sizes) > 1:
        got = ", ".join(f"{count} of {w} x {h}" for (w, h), count in sizes.most_common())
        do = "calibrate cameras of different sizes separately, or remove other pictures"
        raise camera_error(str(folder), "pictures of one size, px", got, do)
    with_dots = [one for one in seen if one.columns]
    cameras = sorted({name for of_pose in pictures.values() for name in of_pose})
    each = {name: np.array([getattr(one, part) for one in with_dots]) for name, part in DIAMETERS.items()}
    widths = {name: float(np.nanmedian(some)) for name, some in each.items() if np.isfinite(some).any()}
    entries = [{"pose": pose} | {name: f"{where}{file}" for name, file in of.items()} for pose, of in pictures.items()]
    wall = {"offset": 120.0, "thickness": 12.0, "n_glass": 1.49, "n_fluid": 1.36}
    walls = {name: {"normal": NORMALS[k % len(NORMALS)]} | wall for k, name in enumerate(cameras)}
    axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    behind = "flat wall in front of each camera; normal points to the camera; remove the key in air"
    keys = [
        _key("image_size", "W, H px, measured", list(seen[0].size)),
        _key("pixel_pitch", "mm, of the sensor, across and down", asked=[0.02, 0.02]),
        _key("model", "or pinhole, brown", "tsai"),
        *_plate_keys(with_dots, widths, len(seen)),
        _key("surveyed.pose", "any surveyed pose: its plate defines the lab", min(pictures)),
        _key("surveyed.R_lab_plate", "the plate's x, y, z axes in the lab, as columns", asked=axes),
        _key("surveyed.T_lab_plate", "its origin in the lab, mm", asked=[0, 0, 0]),
        *(
            DraftKey(name=f"ports.{name}", comment="" if k else behind, example=walls[name])
            for k, name in enumerate(cameras)
        ),
        _key("pictures", f"{len(seen)} pictures of {len(pictures)} poses, paired by number", entries),
    ]
    return keys, widths


def _key(name: str, comment: str, value: Any = ..., asked: Any = None) -> DraftKey:
    """Return a key with a value, or a key to fill in, with an example."""
    return DraftKey(name=name, value=value, comment=comment, example=asked, asked=asked is not None)


def _plate_keys(seen: Sequence[PlateSeen], widths: Mapping[str, float], count: int) -> list[DraftKey]:
    """Return the keys of a plate of dots if any picture shows one; pictures do not show the pitch."""
    if not seen:
        comment = f"no dots found in {count} pictures: type, columns, rows, pitch (docs/calibration.md)"
        return [_key("plate", comment, asked={"type": "chessboard", "columns": 9, "rows": 6, "pitch": 10.0})]
    columns, rows = max(one.columns for one in seen), max(one.rows for one in seen)
    whole = sum((one.columns, one.rows) == (columns, rows) for one in seen)
    marks = Counter(one.marks for one in seen if one.marks).most_common(1)
    on_x, on_y = marks[0][0] if marks else (3, 2)
    fiducials = [[0, 0], [on_x, 0], [0, on_y]]
    seen_in = f"of the largest grid seen, in {whole} of {len(seen)} pictures"
    of_pitch = {name: f"{width:.3f} of the pitch, measured; mm" for name, width in widths.items()}
    mm = {name: round(8.0 * widths.get(name, 0.6), 2) for name in DIAMETERS}
    larger = "larger dots at the middle of the grid, on +x, on +y: columns and rows from the first"
    dark = 2 * sum(one.dark for one in seen) >= len(seen)
    return [
        _key("plate.type", "or chessboard, charuco, circles", "dots"),
        _key("plate.columns", seen_in, columns),
        _key("plate.rows", seen_in, rows),
        _key("plate.pitch", "mm, between the middles of dots", asked=8.0),
        *(DraftKey(name=name, comment=of_pitch.get(name, "mm; none was seen"), example=mm[name]) for name in DIAMETERS),
        _key("plate.fiducials", larger, fiducials if marks else ..., fiducials),
        _key("plate.dots", "or bright, on a dark plate", "dark" if dark else "bright"),
    ]


def with_diameters(keys: Sequence[DraftKey], widths: Mapping[str, float]) -> list[DraftKey]:
    """Return keys with the diameters of the dots in mm, from `widths` in pitches and the pitch."""
    pitch = next((key.value for key in keys if key.name == "plate.pitch"), None)
    known = {name: round(width * pitch, 4) for name, width in widths.items()} if isinstance(pitch, int | float) else {}
    return [replace(key, value=known.get(key.name, ...)) if key.value is ... else key for key in keys]
