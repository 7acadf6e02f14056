"""A track for other programs: tables, MATLAB, FicTrac's table, TUM's poses, VTK for ParaView, NWB, netCDF."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import OutputError, refusal
from sphereorient.files.provenance import package
from sphereorient.files.whole_file import put_aside
from sphereorient.report import columns as table
from sphereorient.report.frame_warnings import frame_numbers
from sphereorient.trajectory import CameraTrack, Trajectory, quaternions_wxyz
from sphereorient.trajectory.walk import FicTracAxes, fictrac_rows, walk_of

ROWS = 50_000  # written at once
Floats = NDArray[np.float64]
Advance = Callable[[int, int], None]


def export_track(
    track: Trajectory,
    path: Path,
    to: str | None = None,
    progress: Advance = lambda done, total: None,
    axes: FicTracAxes | None = None,
) -> None:
    """Write a track for other programs, whole or not at all; NaN stays NaN.
    `to` is a key of `FORMATS`; None: by the suffix. `axes`: of FicTrac's table, see `fictrac_axes`. Raises
    OutputError: unknown format, missing package, or a file that cannot be written.
    """
    write, *_ = FORMATS[format_of(path, to)]
    with put_aside(path) as aside:
        write(track, aside, progress, axes)


def format_of(path: Path, to: str | None) -> str:
    """Return the format, from `to`, or from the suffix if None; OutputError if unknown or contradictory."""
    suffixes = {suffix: name for name, (_, *own) in FORMATS.items() for suffix in own}
    by_name, known = suffixes.get(path.suffix.lower()), ", ".join(FORMATS)
    if to is not None and to not in FORMATS:
        do = "choose one of these with --to"
        raise OutputError(refusal("--to", expected=f"one of {known}", got=repr(to)[:60], do=do))
    if to is None and by_name is None:
        do = f"add --to with one of {known}, or end the name in one of these"
        got = f"'{path.suffix}'"
        raise OutputError(refusal(f"--out {path}", expected=" ".join(suffixes), got=got, do=do))
    if to is not None and by_name not in (None, to):
        do = "make --to and the suffix agree"
        raise OutputError(refusal(f"--out {path}", expected=f"a name for {to}", got=f"'{path.suffix}'", do=do))
    return to or str(by_name)


def _write_csv(track: Trajectory, path: Path, progress: Advance, _: object) -> None:
    parts, about = list(table.columns(track)), table.metadata(track)
    settings = about.pop("settings")
    lines = [f"{key}: {' '.join(table.as_text(value).split())}" for key, value in about.items()]
    lines += ["quaternions: of R_lab_body, w first; units stand at the end of the names", "settings:"]
    lines = ["made by sphereorient", *lines, *(f"  {line}" for line in settings.splitlines())]
    # 1 and 0, which every program reads.
    values = [part.values.astype(np.int8) if part.values.dtype == bool else part.values for part in parts]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for line in lines:
            file.write(table.FORMULA.sub(r"\1'\2", f"# {line}".rstrip()) + "\n")
        file.write(",".join(part.name for part in parts) + "\n")
        for first in range(0, len(track), ROWS):
            rows = zip(*(column[first : first + ROWS].tolist() for column in values), strict=True)
            file.writelines(",".join(map(str, row)) + "\n" for row in rows)
            progress(min(first + ROWS, len(track)), len(track))


def _write_parquet(track: Trajectory, path: Path, progress: Advance, _: object) -> None:
    content = table.to_arrow(track)
    import pyarrow.parquet as arrow_parquet

    with arrow_parquet.ParquetWriter(path, content.schema, compression="zstd") as writer:
        for first in range(0, max(len(content), 1), ROWS):
            part = content.slice(first, ROWS)
            writer.write_table(part)
            progress(first + len(part), len(content))


def _write_mat(track: Trajectory, path: Path, *_: object) -> None:
    """Write MATLAB 5: arrays with the frames along their first axis, structs for cameras and metadata."""
    from scipy.io import savemat

    content = _mat_arrays(track)
    seen = table.safe_names(track).items()
    content["cameras"] = {name: _mat_arrays(camera) | {"reason": table.reasons(camera)} for name, camera in seen}
    about = table.metadata(track)
    content["metadata"] = {
        **{key: about[key] for key in ("experiment", "method", "frame_rate_hz", "settings", "flags")},
        "cameras": np.array(about["cameras"], dtype=object),
        "provenance": table.as_text(about["provenance"]),
        "units": {table.with_unit(each.name, each.units): each.units for each in table.frame_wise(track)},
    }
    savemat(path, content, long_field_names=True, do_compression=True, oned_as="column")


def _mat_arrays(record: Trajectory | CameraTrack) -> dict[str, Any]:
    arrays: dict[str, Any] = {}
    for dataset in table.frame_wise(record):
        arrays[table.with_unit(dataset.name, dataset.units)] = dataset.values
        if dataset.rotation:
            arrays[dataset.name.replace("orientation", "quat_wxyz", 1)] = quaternions_wxyz(dataset.values)
    return arrays


def fictrac_table(track: Trajectory, axes: FicTracAxes) -> Floats:
    """Return the 25 columns of FicTrac's table, (N, 25); its lab is the animal's frame, x ahead, y right, z down.
    Column 5 (FicTrac's error) is the root mean square of the stated errors, rad. NaN without a pose.
    """
    R, ms = axes.R_own_lab @ track.posed, 1e3 * track.time
    walk = walk_of(track.time, R)
    count, step_s = np.arange(len(R)), np.diff(track.time, prepend=np.nan)
    begin = np.maximum.accumulate(np.where(walk.start, count, 0))
    ahead, right = walk.forward_rad_s * step_s, walk.side_rad_s * step_s
    stretch = np.where(np.isfinite(walk.heading_rad), 0.0, np.nan)
    total = np.nancumsum(np.stack([ahead, right], axis=1), axis=0)
    return fictrac_rows(
        axes.R_cam_own,
        R @ R[begin].transpose(0, 2, 1),
        ahead,
        right,
        walk.start,
        frame=frame_numbers(track),
        turn_lab=walk.turn_rad,
        error=np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2)),
        path=walk.path,
        heading=walk.heading_rad,
        sums=total - total[begin] + stretch[:, None],
        time_ms=ms,
        sequence=count - begin,
        step_ms=np.diff(ms, prepend=np.nan),
    )


def _write_fictrac(track: Trajectory, path: Path, _: object, axes: FicTracAxes | None) -> None:
    if axes is None:
        do = "add --experiment experiment.yaml, for the camera's axes"
        raise OutputError(refusal("--to fictrac", expected="the experiment of the track", got="none", do=do))
    np.savetxt(path, fictrac_table(track, axes), fmt="%.14g", delimiter=", ")


def _write_tum(track: Trajectory, path: Path, *_: object) -> None:
    """Write time, position and quaternion x y z w of each valid frame, as evo and rpg_trajectory_evaluation read it."""
    w, xyz = np.split(quaternions_wxyz(track.orientation[track.valid]), [1], axis=1)
    rows = np.column_stack([track.time[track.valid], track.position[track.valid], xyz, w])
    header = f"time_s x_{track.length_unit} y z qx qy qz qw (R_lab_body); made by sphereorient"
    np.savetxt(path, rows, fmt="%.17g", header=header)


def _write_vtk(track: Trajectory, path: Path, *_: object) -> None:
    """Write VTKHDF, a time series for ParaView: the ball's centre, a point in each valid frame, with its vectors.
    Source: the file format of VTK 9.3, transient poly data.
    """
    some = track.valid
    count, R = int(some.sum()), track.orientation[some]
    parts = {
        **{f"body_{axis}": R[:, :, k] for k, axis in enumerate("xyz")},
        "quaternion_wxyz": quaternions_wxyz(R),
        **{name: getattr(track, name)[some] for name in ("velocity", "acceleration", "omega_lab", "alpha_lab")},
        "orientation_sigma_rad": np.sqrt(np.trace(track.orientation_cov[some], axis1=1, axis2=2) / 3),
        "frame": np.flatnonzero(some),
        "flags": track.flags[some].astype(np.int64),
    }
    frame, zeros = np.arange(count), np.zeros(count, np.int64)
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array([2, 0])
        root.attrs.create("Type", np.bytes_("PolyData"), dtype=h5py.string_dtype("ascii", 8))
        root["NumberOfPoints"] = np.ones(count, np.int64)
        root["Points"] = track.position[some]
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = count
        steps["Values"] = track.time[some]
        steps["PartOffsets"], steps["NumberOfParts"] = frame, np.ones(count, np.int64)
        steps["PointOffsets"] = frame
        # Each part has one vertex only.
        vertex = np.stack([frame, zeros, zeros, zeros], axis=1)
        steps["CellOffsets"], steps["ConnectivityIdOffsets"] = vertex, vertex
        for topology in ("Vertices", "Lines", "Polygons", "Strips"):
            group, one = root.create_group(topology), int(topology == "Vertices")
            group["NumberOfCells"] = group["NumberOfConnectivityIds"] = np.full(count, one, np.int64)
            group["Offsets"] = np.tile([0, 1], count) if one else np.zeros(count, np.int64)
            group["Connectivity"] = np.zeros(count * one, np.int64)
        data, offsets = root.create_group("PointData"), steps.create_group("PointDataOffsets")
        for name, values in parts.items():
            data[name], offsets[name] = values, frame


def _write_nwb(track: Trajectory, path: Path, *_: object) -> None:
    """Write Neurodata Without Borders: rotation, angular velocity, position and the walk as time series; SI units."""
    pynwb = package("pynwb", "nwb")
    from datetime import UTC, datetime

    walk = track.walk()
    about = f"{track.title}: {track.method} method of sphereorient"
    # A track lacks the recording's date: the epoch stands for it.
    begin = datetime(1970, 1, 1, tzinfo=UTC)
    file = pynwb.NWBFile(session_description=about, identifier=track.title, session_start_time=begin)
    module = file.create_processing_module(name="behavior", description="pose of the ball; frames without one are NaN")
    length, unit = (1.0, "radii") if track.length_unit == "radii" else (1e-3, "m")
    series = {
        "orientation_wxyz": (quaternions_wxyz(track.orientation), "1", "quaternion of R_lab_body, w first"),
        "omega_lab": (track.omega_lab, "rad/s", "angular velocity, lab"),
        "position": (length * track.position, unit, "centre of the ball, lab"),
        "velocity": (track.velocity, "radii/s" if unit == "radii" else "m/s", "velocity of the centre, lab"),
        "walk_forward": (walk.forward_rad_s, "radii/s", "of an animal that walks on the ball, ahead (lab x)"),
        "walk_side": (walk.side_rad_s, "radii/s", "of the animal, to the right (lab y)"),
        "walk_turn": (walk.turn_rad_s, "rad/s", "of the animal, to the right"),
        "walk_heading": (walk.heading_rad, "rad", "direction that the animal faces, since the segment began"),
        "walk_path": (walk.path, "radii", "place on the plane on which the animal walks"),
    }
    for name, (values, units, description) in series.items():
        module.add(pynwb.TimeSeries(name=name, data=values, unit=units, timestamps=track.time, description=description))
    with pynwb.NWBHDF5IO(str(path), "w") as io:
        io.write(file)


def _write_netcdf(track: Trajectory, path: Path, *_: object) -> None:
    """Write netCDF 3, all arrays with named axes and units."""
    data = table.to_xarray(track)
    data = data.assign({name: data[name].astype("int32") for name in ("flags", "segment", "valid")})
    data.to_netcdf(path, engine="scipy")


FORMATS: dict[str, tuple[Any, ...]] = {  # writer (of track, path, progress, axes), then suffixes of files
    "csv": (_write_csv, ".csv"),
    "parquet": (_write_parquet, ".parquet", ".pq"),
    "mat": (_write_mat, ".mat"),
    "fictrac": (_write_fictrac, ".dat"),
    "tum": (_write_tum, ".tum"),
    "vtk": (_write_vtk, ".vtkhdf"),
    "nwb": (_write_nwb, ".nwb"),
    "netcdf": (_write_netcdf, ".nc"),
}
