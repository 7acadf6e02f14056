"""A track for programs that read poses: FicTrac's table, TUM's, VTK for ParaView, NWB, netCDF (docs/export.md)."""

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.cameras import Camera
from sphereorient.errors import OutputError, refusal
from sphereorient.report.columns import package, to_xarray
from sphereorient.trajectory import Trajectory, quaternions_wxyz
from sphereorient.trajectory.walk import fictrac_rows

Floats = NDArray[np.float64]
TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")  # of VTK's poly data


def fictrac_table(track: Trajectory, camera: Camera) -> Floats:
    """Return the 25 columns of FicTrac's table, (N, 25); the lab is the animal's frame, x ahead, y right, z down.
    Column 5, an error of its own, is the root mean square of the stated errors, rad. NaN where there is no pose.
    """
    R, ms, walk = track.posed, 1e3 * track.time, track.walk()
    count = np.arange(len(R))
    begin = np.maximum.accumulate(np.where(walk.start, count, 0))
    step_s = np.diff(track.time, prepend=np.nan)
    ahead, right = walk.forward_rad_s * step_s, walk.side_rad_s * step_s
    stretch = np.where(np.isfinite(walk.heading_rad), 0.0, np.nan)
    return fictrac_rows(
        camera.R_cam_lab.numpy(),
        R @ R[begin].transpose(0, 2, 1),
        ahead,
        right,
        walk.start,
        frame=count + 1,
        turn_lab=walk.turn_rad,
        error=np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2)),
        path=walk.path,
        heading=walk.heading_rad,
        sums=np.stack([_since(steps, begin) + stretch for steps in (ahead, right)], axis=1),
        time_ms=ms,
        sequence=count - begin + 1,
        step_ms=np.diff(ms, prepend=np.nan),
    )


def _since(steps: Floats, begin: NDArray[np.int64]) -> Floats:
    """Return the sum of steps (N,) since the frames `begin`, these not included."""
    total = np.nancumsum(steps)
    return np.asarray(total - total[begin])


def write_fictrac(track: Trajectory, path: Path, camera: Camera | None) -> None:
    """Write FicTrac's table of a ball in its place."""
    if camera is None:
        do = "add --experiment experiment.yaml: the table has the camera's axes"
        raise OutputError(refusal("--to fictrac", expected="the experiment of the track", got="none", do=do))
    np.savetxt(path, fictrac_table(track, camera), fmt="%.14g", delimiter=", ")


def write_tum(track: Trajectory, path: Path, camera: Camera | None) -> None:
    """Write time, position and quaternion x y z w of each valid frame, as evo and rpg_trajectory_evaluation read it."""
    w, xyz = np.split(quaternions_wxyz(track.orientation[track.valid]), [1], axis=1)
    table = np.column_stack([track.time[track.valid], track.position[track.valid], xyz, w])
    header = f"time_s x_{track.length_unit} y z qx qy qz qw (R_lab_body); made by sphereorient"
    np.savetxt(path, table, fmt="%.17g", header=header)


def write_vtk(track: Trajectory, path: Path, camera: Camera | None) -> None:
    """Write VTKHDF, a time series for ParaView: the ball's centre, a point in each valid frame, with its vectors.
    Source: the file format of VTK 9.3, transient poly data.
    """
    some = track.valid
    count = int(some.sum())
    R, time, position = track.orientation[some], track.time[some], track.position[some]
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
        kind = np.bytes_("PolyData")
        root.attrs.create("Type", kind, dtype=h5py.string_dtype("ascii", len(kind)))
        root["NumberOfPoints"] = np.ones(count, np.int64)
        root["Points"] = position
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = count
        steps["Values"] = time
        steps["PartOffsets"], steps["NumberOfParts"] = frame, np.ones(count, np.int64)
        steps["PointOffsets"] = frame
        # Each part has one vertex, and nothing else.
        vertex = np.stack([frame, zeros, zeros, zeros], axis=1)
        steps["CellOffsets"], steps["ConnectivityIdOffsets"] = vertex, vertex
        for topology in TOPOLOGIES:
            group, one = root.create_group(topology), int(topology == "Vertices")
            group["NumberOfCells"] = group["NumberOfConnectivityIds"] = np.full(count, one, np.int64)
            group["Offsets"] = np.tile([0, 1], count) if one else np.zeros(count, np.int64)
            group["Connectivity"] = np.zeros(count * one, np.int64)
        data, offsets = root.create_group("PointData"), steps.create_group("PointDataOffsets")
        for name, values in parts.items():
            data[name], offsets[name] = values, frame


def write_nwb(track: Trajectory, path: Path, camera: Camera | None) -> None:
    """Write Neurodata Without Borders: rotation, angular velocity, position and the walk as time series; SI units."""
    pynwb = package("pynwb", "nwb")
    from datetime import UTC, datetime

    walk = track.walk()
    about = f"{track.title}: {track.method} method of sphereorient"
    # The recording's date is not in a track: the epoch says so.
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


def write_netcdf(track: Trajectory, path: Path, camera: Camera | None) -> None:
    """Write netCDF 3, all arrays with named axes and units."""
    data = to_xarray(track)
    data = data.assign({name: data[name].astype("int32") for name in ("flags", "segment", "valid")})
    data.to_netcdf(path, engine="scipy")
