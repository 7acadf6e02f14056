"""A track during its measurement, in a file beside it that only grows and is readable at any time, also after a kill.
The first line is JSON with the attributes of the track; then a row of fixed length for each frame (`row_type`). An
incomplete row at the end is ignored.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sphereorient.trajectory.datasets import blank_datasets, reasons_of, stored_fields

SCHEMA = "sphereorient-journal/1"
MARK = f'{{"schema": "{SCHEMA}"'.encode()
# Datasets of a frame that do not depend on later frames.
OF_FRAME = (
    *("time", "valid", "position", "position_cov", "orientation", "orientation_cov", "segment", "flags"),
    *("position_systematic_cov", "orientation_systematic_cov", "margin", "margin_angle"),
)
OF_CAMERA = ("centre_px", "centre_sigma_px", "radius_px", "orientation", "orientation_cov", "score")
ABOUT = ("method", "settings", "experiment", "length_unit", "provenance")


def journal_path(track: Path) -> Path:
    """Return the path of the rows of a track until it is complete."""
    return track.with_name(track.name + ".partial")


def row_type(track: type[Any], camera: type[Any], cameras: Sequence[str]) -> np.dtype[Any]:
    """Return the type of one row: datasets of a track, then those of each camera, without padding."""
    whole, own = dict(stored_fields(track)), dict(stored_fields(camera))
    of_camera = [("reason", "S16"), *((name, own[name].dtype, own[name].tail) for name in OF_CAMERA)]
    columns = [(name, whole[name].dtype, whole[name].tail) for name in OF_FRAME]
    return np.dtype([*columns, ("cameras", [(name, of_camera) for name in sorted(cameras)])])


def head(track: Any) -> bytes:
    """Return the first line of a track's journal, independent of its frames."""
    rate = track.frame_rate if math.isfinite(track.frame_rate) else None
    content = {"schema": SCHEMA, "frame_rate": rate, "cameras": sorted(track.cameras)}
    return json.dumps(content | {name: getattr(track, name) for name in ABOUT}).encode() + b"\n"


def rows(track: Any) -> bytes:
    """Return the frames of a track as rows."""
    cameras = track.cameras
    kind = row_type(type(track), type(next(iter(cameras.values()))), list(cameras))
    table = np.zeros(len(track), kind)
    for name in OF_FRAME:
        table[name] = getattr(track, name)
    for name, camera in cameras.items():
        own = table["cameras"][name]
        own["reason"] = [str(why) for why in camera.reason]
        for column in OF_CAMERA:
            own[column] = getattr(camera, column)
    return table.tobytes()


def is_journal(path: Path) -> bool:
    """Return whether a file is a journal; raise OSError if it cannot be read."""
    with path.open("rb") as file:
        return file.read(len(MARK)) == MARK


def read_journal(file: BinaryIO, track: type[Any], camera: type[Any]) -> dict[str, Any]:
    """Return the fields of the track of a journal, as far as written; other fields are blank and read-only. Raises
    LookupError, TypeError, ValueError: the first line is damaged; OSError: unreadable file.
    """
    about = json.loads(file.readline(10_000_000))
    kind = row_type(track, camera, about["cameras"])
    fields: dict[str, Any] = {name: about[name] for name in ABOUT}
    fields["frame_rate"] = math.nan if about["frame_rate"] is None else float(about["frame_rate"])
    content = file.read()
    table = np.frombuffer(content, kind, len(content) // kind.itemsize)
    found: dict[str, Any] = {}
    for name in about["cameras"]:
        own = table["cameras"][name]
        parts = _nothing(camera, len(table)) | {column: np.ascontiguousarray(own[column]) for column in OF_CAMERA}
        found[name] = camera(reason=reasons_of(own["reason"]), **parts)
    parts = _nothing(track, len(table)) | {name: np.ascontiguousarray(table[name]) for name in OF_FRAME}
    return fields | parts | {"cameras": found}


def _nothing(record: type[Any], frames: int) -> dict[str, NDArray[Any]]:
    """Return every dataset of a record with fill values, read-only, without using memory."""
    return {
        name: np.broadcast_to(one[:1], (frames + len(one) - 1, *one.shape[1:])) if len(one) else one
        for name, one in blank_datasets(record, 1).items()
    }
