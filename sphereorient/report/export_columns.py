"""A track as named columns: one value a frame each, the unit in the name (docs/export.md)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from importlib import import_module
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import OutputError, refusal
from sphereorient.trajectory import CameraTrack, Flag, Trajectory, quaternions_wxyz

REASON = "why this camera has no orientation in the frame; ok where it has one"
AXES: dict[tuple[int, ...], str] = {(3,): "xyz", (2,): "uv"}  # names of the components, by the shape of a frame's value
PAIRS = tuple(combinations_with_replacement(range(3), 2))  # of a symmetric matrix: xx xy xz yy yz zz


@dataclass(frozen=True, kw_only=True, eq=False)
class Column:
    """One value a frame; made by `columns`, read by the writers of CSV and Parquet."""

    name: str
    units: str
    description: str
    values: NDArray[Any]  # (N,)


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """One dataset of the file with a row a frame; made by `frame_wise`."""

    name: str
    units: str
    description: str
    values: NDArray[Any]  # (N, ...)

    @property
    def tail(self) -> tuple[int, ...]:
        """Axes after the frames."""
        return self.values.shape[1:]

    @property
    def rotation(self) -> bool:
        """Whether the values are rotations, which tables hold as quaternions."""
        return self.tail == (3, 3) and self.units == "1"


def frame_wise(record: Trajectory | CameraTrack) -> Iterator[Dataset]:
    """Yield the datasets of a track, or of one of its cameras, that have one row a frame, in the order of the file.

    Args:
        record: a `Trajectory` or a `CameraTrack`; the candidates of a camera have another count and are left out.
    """
    for entry in fields(record):
        column = entry.metadata.get("column")
        if column is not None and column.rows == "frames":
            values = np.asarray(getattr(record, entry.name))
            yield Dataset(name=entry.name, units=column.units, description=column.description, values=values)


def columns(track: Trajectory) -> Iterator[Column]:
    """Yield every frame-wise dataset of a track as columns, N frames; names as in `Trajectory.to_pandas`.

    Args:
        track: any; NaN stays NaN.

    Returns:
        Vectors by component (position_x_mm), covariances by pair (position_cov_xy_mm2: they are symmetric), rotations
        as quaternions with w first and w >= 0 (quat_w ..), then the same of every camera with its name before it.
    """
    for dataset in frame_wise(track):
        yield from _split(dataset, "")
    for prefix, camera in safe_names(track).items():
        for dataset in frame_wise(camera):
            yield from _split(dataset, f"{prefix}_")
        reason = np.array([str(reason) for reason in camera.reason], dtype=object)
        yield Column(name=f"{prefix}_reason", units="1", description=REASON, values=reason)


def safe_names(track: Trajectory) -> dict[str, CameraTrack]:
    """Return the cameras by names that tables and programs take: letters, digits and _, told apart by a number."""
    safe: dict[str, CameraTrack] = {}
    for name, camera in track.cameras.items():
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        plain = plain if plain[:1].isalpha() else f"camera_{plain}"
        base, count = plain, 1
        while plain in safe:
            count += 1
            plain = f"{base}_{count}"
        safe[plain] = camera
    return safe


def metadata(track: Trajectory) -> dict[str, Any]:
    """Return what a track says of itself: what the root attributes of its file hold, and the names of the flags."""
    return {
        "experiment": track.experiment,
        "method": track.method,
        "frame_rate_hz": track.frame_rate,
        "cameras": list(track.cameras),
        "flags": {flag.name: flag.value for flag in Flag},
        "provenance": dict(track.provenance),
        "settings": track.settings,
    }


def as_text(value: Any) -> str:
    """Return text as it is and anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def with_unit(name: str, units: str) -> str:
    """Return a name with its unit at the end, once: alpha_lab_rad_s2, score, centre_px."""
    unit = "" if units == "1" else "_" + units.replace("^", "").replace("/", "_")
    return name if name.endswith(unit) else f"{name}{unit}"


def package(name: str, extra: str) -> Any:
    """Import a package of an extra.

    Raises:
        OutputError: it is not installed; the message says how it is.
    """
    try:
        return import_module(name)
    except ImportError as error:
        do = f"install it with `pip install sphereorient[{extra}]`"
        raise OutputError(
            refusal(f"sphereorient[{extra}]", expected=f"the package {name}", got="none", do=do)
        ) from error


def _split(dataset: Dataset, prefix: str) -> Iterator[Column]:
    """Yield a dataset's columns."""
    name, units = f"{prefix}{dataset.name}", dataset.units

    def column(stem: str, values: NDArray[Any]) -> Column:
        return Column(name=with_unit(stem, units), units=units, description=dataset.description, values=values)

    if dataset.rotation:
        stem = prefix + dataset.name.replace("orientation", "quat", 1)
        for axis, values in zip("wxyz", quaternions_wxyz(dataset.values).T, strict=True):
            yield column(f"{stem}_{axis}", values)
    elif dataset.tail == (3, 3):
        for i, j in PAIRS:
            yield column(f"{name}_{'xyz'[i]}{'xyz'[j]}", dataset.values[:, i, j])
    elif dataset.tail in AXES:
        for k, axis in enumerate(AXES[dataset.tail]):
            yield column(f"{name.removesuffix('_px')}_{axis}", dataset.values[:, k])
    else:
        yield column(name, dataset.values)
