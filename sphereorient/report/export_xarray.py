"""A track with named axes, for xarray."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sphereorient.report.export_columns import REASON, Dataset, as_text, frame_wise, metadata, package
from sphereorient.trajectory import Trajectory

if TYPE_CHECKING:
    import xarray as xr


def to_xarray(track: Trajectory) -> xr.Dataset:
    """Return a track as an xarray dataset: named axes, units and descriptions as attributes.

    Args:
        track: any; NaN stays NaN.

    Returns:
        Dimensions time (coordinate, s), axis (x, y, z of lab or body as the description says), axis_2 of covariances,
        body_axis of orientations (its columns), camera, image_axis (u, v); what the cameras measured by themselves as
        camera_*. The candidates stay in the file. Attributes as in the track's file, provenance as JSON.

    Raises:
        OutputError: xarray is not installed.
    """
    xarray = package("xarray", "table")
    made = {}
    for dataset in frame_wise(track):
        if dataset.name != "time":
            made[dataset.name] = (_dims(dataset.tail, dataset.rotation), dataset.values, _attributes(dataset))
    by_camera = [list(frame_wise(camera)) for camera in track.cameras.values()]
    for same in zip(*by_camera, strict=True):
        values = np.stack([each.values for each in same])
        dims = ("camera", *_dims(same[0].tail, same[0].rotation))
        made[f"camera_{same[0].name}"] = (dims, values, _attributes(same[0]))
    if track.cameras:
        reason = np.array([[str(why) for why in camera.reason] for camera in track.cameras.values()])
        made["camera_reason"] = (("camera", "time"), reason, {"units": "1", "description": REASON})
    time = next(dataset for dataset in frame_wise(track) if dataset.name == "time")
    coordinates = {
        "time": (("time",), track.time, _attributes(time)),
        "axis": list("xyz"),
        "axis_2": list("xyz"),
        "body_axis": list("xyz"),
        **({"camera": list(track.cameras), "image_axis": list("uv")} if track.cameras else {}),
    }
    about = {key: value if isinstance(value, str | float) else as_text(value) for key, value in metadata(track).items()}
    named: xr.Dataset = xarray.Dataset(made, coords=coordinates, attrs=about)
    return named


def _attributes(dataset: Dataset) -> dict[str, str]:
    return {"units": dataset.units, "description": dataset.description}


def _dims(tail: tuple[int, ...], rotation: bool) -> tuple[str, ...]:
    named = {(): (), (2,): ("image_axis",), (3,): ("axis",), (3, 3): ("axis", "body_axis" if rotation else "axis_2")}
    return ("time", *named[tail])
