"""The columns of a track with the unit in the name, as tables of Arrow and arrays of xarray (docs/export.md)."""

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.files.provenance import package
from sphereorient.trajectory import CameraTrack, Trajectory, quaternions_wxyz
from sphereorient.trajectory.datasets import stored_fields

if TYPE_CHECKING:
    import pyarrow as pa
    import xarray as xr

REASON = "why this camera has no orientation in the frame; ok where it has one"
AXES: dict[tuple[int, ...], str] = {(3,): "xyz", (2,): "uv"}  # names of the components, by the shape of a frame's value
FORMULA = re.compile(r"(^|[,;\t])([=+\-@\t\r])")  # begins a cell that spreadsheet programs compute


def to_arrow(track: Trajectory) -> "pa.Table":
    """Return a track as an Arrow table, a row per frame, with units and descriptions. OutputError without pyarrow."""
    arrow = package("pyarrow", "table")
    parts = list(columns(track))
    text = arrow.string()
    arrays = [arrow.array(c.values, type=text if c.values.dtype == object else None, from_pandas=False) for c in parts]
    schema = arrow.schema(
        [arrow.field(c.name, array.type, metadata=c.about) for c, array in zip(parts, arrays, strict=True)],
        metadata={key: as_text(value) for key, value in metadata(track).items()},
    )
    return arrow.table(arrays, schema=schema)


def to_xarray(track: Trajectory) -> "xr.Dataset":
    """Return a track as an xarray dataset, with units and descriptions as attributes; candidates are left out.
    Dimensions: time (s), axis (x, y, z of lab or body), axis_2 (covariances), body_axis (columns of orientations),
    camera, image_axis (u, v). Variables of the cameras are camera_*; provenance is JSON. OutputError without xarray.
    """
    xarray = package("xarray", "table")
    own = {dataset.name: dataset for dataset in frame_wise(track)}
    time = own.pop("time")
    made = {name: (dataset.dims, dataset.values, dataset.about) for name, dataset in own.items()}
    for same in zip(*(frame_wise(camera) for camera in track.cameras.values()), strict=True):
        values = np.stack([each.values for each in same])
        made[f"camera_{same[0].name}"] = (("camera", *same[0].dims), values, same[0].about)
    if track.cameras:
        reason = np.array([[str(why) for why in camera.reason] for camera in track.cameras.values()])
        made["camera_reason"] = (("camera", "time"), reason, {"units": "1", "description": REASON})
    coordinates = {
        "time": (("time",), track.time, time.about),
        **{axis: list("xyz") for axis in ("axis", "axis_2", "body_axis")},
        **({"camera": list(track.cameras), "image_axis": list("uv")} if track.cameras else {}),
    }
    about = {key: value if isinstance(value, str | float) else as_text(value) for key, value in metadata(track).items()}
    named: xr.Dataset = xarray.Dataset(made, coords=coordinates, attrs=about)
    return named


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """A dataset of the file with a row per frame, or one column of it; made by `frame_wise` and `columns`."""

    name: str
    units: str
    description: str
    values: NDArray[Any]  # (N, ...); of a column (N,)

    @property
    def rotation(self) -> bool:
        """Whether the values are rotations, which tables hold as quaternions."""
        return self.values.shape[1:] == (3, 3) and self.units == "1"

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of its axes."""
        first = "image_axis" if self.values.shape[1:] == (2,) else "axis"
        return ("time", first, "body_axis" if self.rotation else "axis_2")[: self.values.ndim]

    @property
    def about(self) -> dict[str, str]:
        """Units and description, for the attributes of other formats."""
        return {"units": self.units, "description": self.description}


def frame_wise(record: Trajectory | CameraTrack) -> Iterator[Dataset]:
    """Yield the datasets of a track or camera that have a row for each frame, in the order of the file."""
    for name, column in stored_fields(record):
        if column.rows == "frames":
            values = np.asarray(getattr(record, name))
            yield Dataset(name=name, units=column.units, description=column.description, values=values)


def columns(track: Trajectory) -> Iterator[Dataset]:
    """Yield the columns of a track, then of each camera: components (position_x_mm), pairs (position_cov_xy_mm2),
    quaternions.
    """
    for dataset in frame_wise(track):
        yield from _split(dataset, "")
    for prefix, camera in safe_names(track).items():
        for dataset in frame_wise(camera):
            yield from _split(dataset, f"{prefix}_")
        yield Dataset(name=f"{prefix}_reason", units="1", description=REASON, values=reasons(camera))


def _split(dataset: Dataset, prefix: str) -> Iterator[Dataset]:
    name, values = f"{prefix}{dataset.name}", dataset.values
    parts, tail = {name: values}, values.shape[1:]
    if dataset.rotation:
        stem = prefix + dataset.name.replace("orientation", "quat", 1)
        parts = {f"{stem}_{axis}": column for axis, column in zip("wxyz", quaternions_wxyz(values).T, strict=True)}
    elif tail == (3, 3):
        pairs = combinations_with_replacement(range(3), 2)  # of a symmetric matrix: xx xy xz yy yz zz
        parts = {f"{name}_{'xyz'[i]}{'xyz'[j]}": values[:, i, j] for i, j in pairs}
    elif tail in AXES:
        parts = {f"{name.removesuffix('_px')}_{axis}": values[:, k] for k, axis in enumerate(AXES[tail])}
    for stem, column in parts.items():
        yield replace(dataset, name=with_unit(stem, dataset.units), values=column)


def reasons(camera: CameraTrack) -> NDArray[Any]:
    """Return a camera's reasons as text, (N,)."""
    return np.array([str(reason) for reason in camera.reason], dtype=object)


def safe_names(track: Trajectory) -> dict[str, CameraTrack]:
    """Return the cameras by unique names of letters, digits and _, which all programs accept."""
    plain = plain_names(track.cameras, "camera")
    return {plain[name]: camera for name, camera in track.cameras.items()}


def plain_names(names: Iterable[str], kind: str) -> dict[str, str]:
    """Return unique names of letters, digits and _, by name; one without a leading letter gets the kind in front."""
    known: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        plain = plain if plain[:1].isalpha() else f"{kind}_{plain}"
        base, count = plain, 1
        while plain in known.values():
            count += 1
            plain = f"{base}_{count}"
        known[name] = plain
    return known


def metadata(track: Trajectory) -> dict[str, Any]:
    """Return the root attributes of a track's file, with the names of the flags."""
    return {
        "experiment": track.experiment,
        **({"sphere": track.sphere} if track.sphere else {}),
        "method": track.method,
        "frame_rate_hz": track.frame_rate,
        "length_unit": track.length_unit,
        "cameras": list(track.cameras),
        "flags": track.bits,
        "provenance": dict(track.provenance),
        "settings": track.settings,
    }


def as_text(value: Any) -> str:
    """Return text unchanged and anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def plain_cell(value: Any) -> Any:
    """Return a cell for CSV; text that a spreadsheet program would compute gets an apostrophe."""
    return f"'{value}" if isinstance(value, str) and FORMULA.match(value) else value


def with_unit(name: str, units: str) -> str:
    """Return a name with its unit at the end, once: alpha_lab_rad_s2, score, centre_px."""
    unit = "" if units == "1" else "_" + units.replace("^", "").replace("/", "_")
    return name if name.endswith(unit) else f"{name}{unit}"
