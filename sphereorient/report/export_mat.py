"""A track for MATLAB and Octave."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sphereorient.report.export_columns import as_text, frame_wise, metadata, safe_names, with_unit
from sphereorient.trajectory import CameraTrack, Trajectory, quaternions_wxyz


def write_mat(track: Trajectory, path: Path, progress: Callable[[int, int], None]) -> None:
    """A MATLAB file (version 5): arrays with the frames along their first axis, structs for cameras and metadata."""
    from scipy.io import savemat

    progress(0, len(track))  # SciPy writes in one go
    content = _mat_arrays(track)
    content["cameras"] = {name: _mat_arrays(camera) for name, camera in safe_names(track).items()}
    about = metadata(track)
    units = {with_unit(each.name, each.units): each.units for each in frame_wise(track)}
    content["metadata"] = {
        **{key: about[key] for key in ("experiment", "method", "frame_rate_hz", "settings", "flags")},
        "cameras": np.array(about["cameras"], dtype=object),
        "provenance": as_text(about["provenance"]),
        "units": units,
    }
    savemat(path, content, long_field_names=True, do_compression=True, oned_as="column")
    progress(len(track), len(track))


def _mat_arrays(record: Trajectory | CameraTrack) -> dict[str, Any]:
    """Arrays by name with unit; rotations as matrices and, with quat_wxyz in place of orientation, as quaternions."""
    arrays: dict[str, Any] = {}
    for dataset in frame_wise(record):
        arrays[with_unit(dataset.name, dataset.units)] = dataset.values
        if dataset.rotation:
            arrays[dataset.name.replace("orientation", "quat_wxyz", 1)] = quaternions_wxyz(dataset.values)
    if isinstance(record, CameraTrack):
        arrays["reason"] = np.array([str(reason) for reason in record.reason], dtype=object)
    return arrays
