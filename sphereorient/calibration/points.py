"""Tables of points and the pixels where a camera shows them, read as views of a plate that lies in the lab's axes."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sphereorient.calibration.document import CalibrationDocument, Picture
from sphereorient.calibration.view import PlateView
from sphereorient.errors import CameraError, refusal
from sphereorient.files.whole_file import TABLE_BYTES, read_whole
from sphereorient.files.yaml_file import short

COLUMNS = ("x", "y", "z", "u", "v")  # mm, mm, mm, px, px
SIGMA_PX = 0.05  # of good centroids; only shares of it matter, for the residuals tell the scale


def read_tables(document: CalibrationDocument) -> dict[Picture, PlateView]:
    """Read all tables of points, one a camera.

    Raises:
        CameraError: a file that cannot be read, without the columns, or with something that is no number.
    """
    views = {}
    for name, path in document.points.items():
        table = read_points(path)
        n = len(table)
        views[Picture(camera=name, row=0, path=path)] = PlateView(
            points_plate_mm=table[:, :3],
            uv_px=table[:, 3:],
            sigma_px=np.full(n, SIGMA_PX),
            diameter_mm=np.zeros(n),
            index=np.stack([np.arange(n), np.zeros(n, dtype=np.int64)], axis=1),
        )
    return views


def read_points(path: Path) -> NDArray[np.float64]:
    """Read a table with the columns x, y, z (lab, mm), u, v (px), in any order, (n, 5).

    Raises:
        CameraError: as `read_tables`.
    """
    content = read_whole(path, TABLE_BYTES, "a table", CameraError, "correct the path")
    try:
        text = content.decode("utf-8-sig")
        rows = list(csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error) as fault:
        do = "save the table as CSV"
        raise CameraError(refusal(str(path), expected="a table", got="a file that is none", do=do)) from fault
    known = [name.strip() for name in rows[0] if name is not None] if rows else []
    missing = [name for name in COLUMNS if name not in known]
    if missing:
        expected, do = f"a first line {','.join(COLUMNS)} and one row a point", "write mm in the lab, and px"
        got = f"no {', '.join(missing)}" if rows else "no rows"
        raise CameraError(refusal(str(path), expected=expected, got=got, do=do))
    return np.array([[_number(path, k, row, name) for name in COLUMNS] for k, row in enumerate(rows)])


def _number(path: Path, k: int, row: dict[str, str], name: str) -> float:
    text = row.get(name)
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        do = "correct the number, or leave the point out"
        raise CameraError(refusal(f"{path}, row {k + 1}, {name}", expected="a number", got=short(text), do=do))
    return value
