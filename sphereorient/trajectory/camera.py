# ruff: noqa: RUF009 -- stored returns a dataclass field without a default

from dataclasses import dataclass, replace
from typing import Self

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import ShapeError, TrackError, refusal
from sphereorient.trajectory.datasets import (
    DatasetSpec,
    blank_datasets,
    check_shapes,
    inside,
    read_dataset,
    read_datasets,
    stored,
    stored_fields,
    write_dataset,
    write_datasets,
)
from sphereorient.trajectory.reasons import Reason

LONGEST_NAME = 100  # characters
AGAIN = "write the track again"
REASON = DatasetSpec("1", "why this camera has no orientation in the frame; ok where it has one")
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack:
    """Results of one camera in N frames; candidates of frame k are rows offset[k] .. offset[k + 1]."""

    centre_px: Floats = stored("px", "projection of the sphere's centre, (u, v)", 2)
    radius_px: Floats = stored("px", "radius of the outline")
    outline_rms_px: Floats = stored("px", "rms distance of the edge points from the fitted outline")
    orientation: Floats = stored("1", "R_lab_body of this camera's own best candidate", 3, 3)
    orientation_cov: Floats = stored("rad^2", "covariance of delta, R_true = exp([delta]x) R, lab components", 3, 3)
    score: Floats = stored("1", "agreement of the picture with the map at this orientation, 0 to 1")
    xi: Floats = stored("rad", "the paper's measure of this camera's noise; its moving variance weighs the cameras")
    reason: tuple[str, ...]  # N values of Reason; newer files may have unknown reasons
    candidate_offset: NDArray[np.int64] = stored(
        "1", "candidates of frame k are the rows offset[k] .. offset[k + 1]", dtype="int64", fill=0, rows="offsets"
    )
    candidate_orientation: Floats = stored("1", "R_lab_body of every candidate", 3, 3, rows="candidates")
    candidate_score: Floats = stored("1", "score of every candidate", rows="candidates")

    def __post_init__(self) -> None:
        offset = np.asarray(self.candidate_offset)
        if offset.size and (np.diff(offset, prepend=0) < 0).any():
            got, do = f"{offset[:5].tolist()}", "count the candidates frame by frame"
            raise ShapeError(refusal("CameraTrack.candidate_offset", expected="0 and increasing", got=got, do=do))
        candidates = int(offset[-1]) if offset.size else 0
        frames = len(self.reason)
        check_shapes(self, {"frames": frames, "offsets": frames + 1, "candidates": candidates})

    def at(self, rows: NDArray[np.int64]) -> Self:
        """Return the frames of increasing `rows`, with their candidates."""
        counts = np.diff(self.candidate_offset)
        kept = np.isin(np.repeat(np.arange(len(counts)), counts), rows)
        parts = {}
        for name, c in stored_fields(type(self)):
            parts[name] = getattr(self, name)[kept if c.rows == "candidates" else rows]
        parts["candidate_offset"] = np.concatenate([[0], np.cumsum(counts[rows])])
        return replace(self, **parts, reason=tuple(self.reason[k] for k in rows.tolist()))

    @classmethod
    def empty(cls, frames: int) -> Self:
        """Return an empty record of `frames` frames."""
        return cls(reason=(Reason.NOT_FOUND,) * frames, **blank_datasets(cls, frames))


def write_camera(camera: CameraTrack, group: h5py.Group) -> None:
    """Write the datasets of one camera."""
    write_datasets(camera, group)
    # fixed length: HDF5 stores variable strings outside the dataset
    width = max([16, *map(len, camera.reason)])
    write_dataset(group, "reason", np.array([str(r) for r in camera.reason], f"S{width}"), REASON)


def read_camera(cameras: h5py.Group, name: str) -> CameraTrack:
    """Read one camera from the group of all."""
    group = inside(cameras, name)
    if not isinstance(group, h5py.Group) or not name.isprintable() or len(name) > LONGEST_NAME:
        label = f"{cameras.file.filename}: cameras"
        raise TrackError(refusal(label, expected="groups with names", got=repr(name)[:60], do=AGAIN))
    known = {str(reason): reason for reason in Reason}
    texts = [text.decode() for text in read_dataset(group, "reason", "S").tolist()]
    return CameraTrack(reason=tuple(known.get(text, text) for text in texts), **read_datasets(group, CameraTrack))
