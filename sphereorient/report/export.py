"""A track for other programs: tables, MATLAB, and what programs of poses read (docs/export.md)."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sphereorient.cameras import Camera
from sphereorient.errors import OutputError, refusal
from sphereorient.files.whole_file import put_aside
from sphereorient.report import export_poses
from sphereorient.report.columns import (
    FORMULA,
    as_text,
    columns,
    frame_wise,
    metadata,
    reasons,
    safe_names,
    to_arrow,
    with_unit,
)
from sphereorient.trajectory import CameraTrack, Trajectory, quaternions_wxyz

SUFFIXES = {
    ".csv": "csv",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".mat": "mat",
    ".dat": "fictrac",
    ".tum": "tum",
    ".vtkhdf": "vtk",
    ".nwb": "nwb",
    ".nc": "netcdf",
}
ROWS = 50_000  # written at once
Advance = Callable[[int, int], None]


def export_track(
    track: Trajectory,
    path: Path,
    to: str | None = None,
    progress: Advance = lambda done, total: None,
    camera: Camera | None = None,
) -> None:
    """Write a track for other programs, whole or not at all; NaN stays NaN.

    `to` is a key of `WRITERS`; None: by the suffix. `camera`: of the picture, for FicTrac's table.

    Raises:
        OutputError: an unknown format, a package that is not installed, or a file that cannot be written.
    """
    write = WRITERS[format_of(path, to)]
    with put_aside(path) as aside:
        write(Export(track=track, path=aside, progress=progress, camera=camera))


def format_of(path: Path, to: str | None) -> str:
    """Return the format, from `to`, or from the suffix if None; OutputError if unknown or contradictory."""
    by_name, known = SUFFIXES.get(path.suffix.lower()), ", ".join(WRITERS)
    if to is not None and to not in WRITERS:
        do = "write --to with one of these"
        raise OutputError(refusal("--to", expected=f"one of {known}", got=repr(to)[:60], do=do))
    if to is None and by_name is None:
        do = f"add --to with one of {known}, or end the name in one of these"
        got = f"'{path.suffix}'"
        raise OutputError(refusal(f"--out {path}", expected=" ".join(SUFFIXES), got=got, do=do))
    if to is not None and by_name not in (None, to):
        do = "let --to and the name agree"
        raise OutputError(refusal(f"--out {path}", expected=f"a name for {to}", got=f"'{path.suffix}'", do=do))
    return to or str(by_name)


@dataclass(frozen=True, kw_only=True, eq=False)
class Export:
    """A track on its way into a file."""

    track: Trajectory
    path: Path
    progress: Advance
    camera: Camera | None


def _write_csv(job: Export) -> None:
    parts = list(columns(job.track))
    about = metadata(job.track)
    settings = about.pop("settings")
    lines = [f"{key}: {' '.join(as_text(value).split())}" for key, value in about.items()]
    lines += ["quaternions: of R_lab_body, w first; units stand at the end of the names", "settings:"]
    lines = ["made by sphereorient", *lines, *(f"  {line}" for line in settings.splitlines())]
    # Every program reads 1 and 0.
    values = [part.values.astype(np.int8) if part.values.dtype == bool else part.values for part in parts]
    with job.path.open("w", encoding="utf-8", newline="\n") as file:
        for line in lines:
            file.write(FORMULA.sub(r"\1'\2", f"# {line}".rstrip()) + "\n")
        file.write(",".join(part.name for part in parts) + "\n")
        for first in range(0, len(job.track), ROWS):
            rows = zip(*(column[first : first + ROWS].tolist() for column in values), strict=True)
            file.writelines(",".join(map(str, row)) + "\n" for row in rows)
            job.progress(min(first + ROWS, len(job.track)), len(job.track))


def _write_parquet(job: Export) -> None:
    table = to_arrow(job.track)
    import pyarrow.parquet as arrow_parquet

    with arrow_parquet.ParquetWriter(job.path, table.schema, compression="zstd") as writer:
        for first in range(0, max(len(table), 1), ROWS):
            part = table.slice(first, ROWS)
            writer.write_table(part)
            job.progress(first + len(part), len(table))


def _write_mat(job: Export) -> None:
    """Write MATLAB 5: arrays with the frames along their first axis, structs for cameras and metadata."""
    from scipy.io import savemat

    track = job.track
    job.progress(0, len(track))  # SciPy writes in one step
    content = _mat_arrays(track)
    content["cameras"] = {name: _mat_arrays(camera) for name, camera in safe_names(track).items()}
    about = metadata(track)
    content["metadata"] = {
        **{key: about[key] for key in ("experiment", "method", "frame_rate_hz", "settings", "flags")},
        "cameras": np.array(about["cameras"], dtype=object),
        "provenance": as_text(about["provenance"]),
        "units": {with_unit(each.name, each.units): each.units for each in frame_wise(track)},
    }
    savemat(job.path, content, long_field_names=True, do_compression=True, oned_as="column")
    job.progress(len(track), len(track))


def _mat_arrays(record: Trajectory | CameraTrack) -> dict[str, Any]:
    """Return arrays by name with unit; rotations as matrices and quaternions (quat_wxyz for orientation)."""
    arrays: dict[str, Any] = {}
    for dataset in frame_wise(record):
        arrays[with_unit(dataset.name, dataset.units)] = dataset.values
        if dataset.rotation:
            arrays[dataset.name.replace("orientation", "quat_wxyz", 1)] = quaternions_wxyz(dataset.values)
    if isinstance(record, CameraTrack):
        arrays["reason"] = reasons(record)
    return arrays


def _poses(write: Callable[[Trajectory, Path, Camera | None], None]) -> Callable[[Export], None]:
    return lambda job: write(job.track, job.path, job.camera)


WRITERS: dict[str, Callable[[Export], None]] = {
    "csv": _write_csv,
    "parquet": _write_parquet,
    "mat": _write_mat,
    "fictrac": _poses(export_poses.write_fictrac),
    "tum": _poses(export_poses.write_tum),
    "vtk": _poses(export_poses.write_vtk),
    "nwb": _poses(export_poses.write_nwb),
    "netcdf": _poses(export_poses.write_netcdf),
}
