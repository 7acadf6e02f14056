"""The noun that comes out: flags, reasons, and the trajectory itself (docs/data-format.md)."""

# ruff: noqa: RUF009 -- _column returns a dataclass field without a default, which is what stands there otherwise

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntFlag, StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import OutputError, ShapeError, TrackError, refusal
from sphereorient.files.hdf5 import whole_hdf5

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = "sphereorient-track/1"
LARGEST_RATIO = 1200  # by which compression shrinks a dataset at most: one that claims more is not in the file
LONGEST_NAME = 100  # of a camera, characters
# What h5py raises on damaged files, depending on the place where HDF5 notices; ShapeError and broken JSON among them.
DAMAGE = (OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError, AttributeError)
Floats = NDArray[np.float64]


class Flag(IntFlag):
    """Bits of the dataset `flags`; several may hold for one frame."""

    POSITION_INTERPOLATED = 1
    POSITION_OUTLIER_REPLACED = 2
    ONE_CAMERA = 4
    REPAIRED_FROM_OTHER_CAMERA = 8
    AMBIGUOUS = 16
    DOUBTFUL_FIT = 32
    RECOVERED = 64
    SPIKE = 128
    EXTRAPOLATED = 256


class Reason(StrEnum):
    """Why one camera has no orientation in a frame; `OK` where it has one."""

    OK = "ok"
    NOT_FOUND = "not_found"
    OUTLINE = "outline"
    DARK = "dark"
    SATURATED = "saturated"
    REPEATED = "repeated"
    RUNAWAY = "runaway"
    LOW_SCORE = "low_score"
    AMBIGUOUS = "ambiguous"
    CONTRADICTS = "contradicts"  # sees the ball, but elsewhere than the other camera: the cameras do not fit together
    UNDECODABLE = "undecodable"
    MISSING = "missing"  # this camera has no picture of the frame


@dataclass(frozen=True)
class _Column:
    """One dataset of the file: the axes after the first, the unit, what it is, the number type, the empty value."""

    key: ClassVar[str] = "column"
    units: str
    description: str
    tail: tuple[int, ...] = ()
    dtype: str = "float64"
    fill: float = np.nan
    since: str = ""  # the version that added it: files of older ones are read without it
    rows: str = "frames"  # or offsets (frames + 1), or candidates


def _column(units: str, description: str, *tail: int, **more: Any) -> Any:
    """Declare a field of a record that is a dataset of the file; the records below are the table of the format."""
    return field(metadata={_Column.key: _Column(units, description, tail, **more)})


def _columns(record: type[Any]) -> Iterator[tuple[str, _Column]]:
    """Yield field name and column of every dataset of a record, in the order of the table."""
    for entry in fields(record):
        if _Column.key in entry.metadata:
            yield entry.name, entry.metadata[_Column.key]


def _blank(record: type[Any], frames: int) -> dict[str, NDArray[Any]]:
    """Return every dataset of a record as it is before anything was measured."""
    rows = {"frames": frames, "offsets": frames + 1, "candidates": 0}
    return {name: np.full((rows[c.rows], *c.tail), c.fill, c.dtype) for name, c in _columns(record)}


def _check_shapes(record: object, rows: Mapping[str, int]) -> None:
    """Refuse a record in which a dataset has another shape than the table says."""
    for name, column in _columns(type(record)):
        expected, got = (rows[column.rows], *column.tail), np.shape(getattr(record, name))
        if got != expected:
            label = f"{type(record).__name__}.{name}"
            do = "give every dataset one row a frame"
            raise ShapeError(refusal(label, expected=f"shape {expected}", got=str(got), do=do))


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack:
    """What one camera saw by itself, N frames; the candidates of frame k are the rows offset[k] .. offset[k + 1]."""

    centre_px: Floats = _column("px", "projection of the sphere's centre, (u, v)", 2)
    radius_px: Floats = _column("px", "radius of the outline")
    outline_rms_px: Floats = _column("px", "rms distance of the edge points from the fitted outline")
    orientation: Floats = _column("1", "R_lab_body of this camera's own best candidate", 3, 3)
    orientation_cov: Floats = _column("rad^2", "covariance of delta, R_true = exp([delta]x) R, lab components", 3, 3)
    score: Floats = _column("1", "agreement of the picture with the map at this orientation, 0 to 1")
    xi: Floats = _column("rad", "the paper's measure of this camera's noise; its moving variance weighs the cameras")
    reason: tuple[str, ...]  # N values of Reason; a newer file may name reasons that Reason does not know yet
    candidate_offset: NDArray[np.int64] = _column(
        "1", "candidates of frame k are the rows offset[k] .. offset[k + 1]", dtype="int64", fill=0, rows="offsets"
    )
    candidate_orientation: Floats = _column("1", "R_lab_body of every candidate", 3, 3, rows="candidates")
    candidate_score: Floats = _column("1", "score of every candidate", rows="candidates")

    def __post_init__(self) -> None:
        """Compare the lengths of the parts."""
        offset = np.asarray(self.candidate_offset)
        if offset.size and (np.diff(offset, prepend=0) < 0).any():
            got, do = f"{offset[:5].tolist()}", "count the candidates frame by frame"
            raise ShapeError(refusal("CameraTrack.candidate_offset", expected="0 and increasing", got=got, do=do))
        candidates = int(offset[-1]) if offset.size else 0
        frames = len(self.reason)
        _check_shapes(self, {"frames": frames, "offsets": frames + 1, "candidates": candidates})

    def at(self, rows: NDArray[np.int64]) -> Self:
        """Return some of the frames, in increasing order, with their candidates."""
        counts = np.diff(self.candidate_offset)
        kept = np.isin(np.repeat(np.arange(len(counts)), counts), rows)
        parts = {}
        for name, column in _columns(type(self)):
            values = getattr(self, name)
            parts[name] = values[kept] if column.rows == "candidates" else values[rows]
        parts["candidate_offset"] = np.concatenate([[0], np.cumsum(counts[rows])])
        return replace(self, **parts, reason=tuple(self.reason[k] for k in rows.tolist()))

    @classmethod
    def empty(cls, frames: int) -> Self:
        """Return the record of a camera that found nothing in `frames` frames."""
        return cls(reason=(Reason.NOT_FOUND,) * frames, **_blank(cls, frames))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Everything that was measured on one sphere, N frames; made by pipeline, read by report, evaluate and the user.

    Lengths are mm, times s, angles rad; velocities m/s and accelerations m/s^2. What could not be measured is NaN.
    Begin with `Trajectory.empty` and put in what there is with `dataclasses.replace`.
    """

    time: Floats = _column("s", "frame number of the experiment / frame rate; middle of the exposure")
    valid: NDArray[np.bool_] = _column("1", "orientation and position measured in this frame", dtype="bool", fill=0)
    position: Floats = _column("mm", "centre of the sphere, lab", 3)
    position_cov: Floats = _column("mm^2", "covariance of position", 3, 3)
    orientation: Floats = _column("1", "R_lab_body: columns are the body axes in the lab", 3, 3)
    orientation_cov: Floats = _column("rad^2", "covariance of delta, R_true = exp([delta]x) R, lab components", 3, 3)
    position_systematic_cov: Floats = _column(
        "mm^2",
        "covariance of the error of position that the calibration leaves, shared by all frames",
        3,
        3,
        since="0.2",
    )
    orientation_systematic_cov: Floats = _column(
        "rad^2", "covariance of delta that the calibration leaves, shared by all frames", 3, 3, since="0.2"
    )
    position_smooth: Floats = _column("mm", "the smoother's position, lab", 3)
    position_smooth_cov: Floats = _column("mm^2", "covariance of position_smooth", 3, 3)
    orientation_smooth: Floats = _column("1", "the smoother's R_lab_body", 3, 3)
    orientation_smooth_cov: Floats = _column("rad^2", "covariance of orientation_smooth, as orientation_cov", 3, 3)
    velocity: Floats = _column("m/s", "velocity of the centre, lab", 3)
    velocity_sigma: Floats = _column("m/s", "standard deviation of velocity", 3)
    acceleration: Floats = _column("m/s^2", "acceleration of the centre, lab", 3)
    acceleration_sigma: Floats = _column("m/s^2", "standard deviation of acceleration", 3)
    omega_lab: Floats = _column("rad/s", "angular velocity, dR/dt R^T = [omega_lab]x, lab components", 3)
    omega_lab_sigma: Floats = _column("rad/s", "standard deviation of omega_lab", 3)
    omega_body: Floats = _column("rad/s", "angular velocity, body components: R^T omega_lab", 3)
    omega_body_sigma: Floats = _column("rad/s", "standard deviation of omega_body", 3)
    alpha_lab: Floats = _column("rad/s^2", "angular acceleration, lab components: derivative of omega_lab", 3)
    alpha_lab_sigma: Floats = _column("rad/s^2", "standard deviation of alpha_lab", 3)
    alpha_body: Floats = _column("rad/s^2", "angular acceleration, body components: R^T alpha_lab", 3)
    alpha_body_sigma: Floats = _column("rad/s^2", "standard deviation of alpha_body", 3)
    segment: NDArray[np.int64] = _column("1", "number of the segment, -1 outside any", dtype="int64", fill=-1)
    flags: NDArray[np.uint32] = _column("1", "bit mask, named in the attribute bits", dtype="uint32", fill=0)
    confidence: Floats = _column("1", "probability of the chosen orientation among the candidates")
    margin: Floats = _column(
        "1", "negative log-likelihood of the next distinct orientation less that of the chosen one", since="0.2"
    )
    margin_angle: Floats = _column("rad", "angle between these two; NaN where no other one was looked for", since="0.2")
    cameras: Mapping[str, CameraTrack]
    frame_rate: float  # Hz
    method: str  # paper, precise
    settings: str  # YAML text
    experiment: str  # the experiment's name
    provenance: Mapping[str, Any]  # versions, command, sha256 of inputs; must go into JSON

    def __post_init__(self) -> None:
        """Compare the lengths of the parts."""
        frames = np.size(self.time)
        _check_shapes(self, {"frames": frames})
        for name, camera in self.cameras.items():
            if len(camera.reason) != frames:
                got, do = f"{len(camera.reason)} frames", "give every camera all frames of the track"
                raise ShapeError(refusal(f"Trajectory.cameras[{name!r}]", expected=f"{frames}", got=got, do=do))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time)

    @classmethod
    def empty(
        cls,
        time: Floats,
        *,
        cameras: Sequence[str] = (),
        frame_rate: float = np.nan,
        method: str = "",
        settings: str = "",
        experiment: str = "",
        provenance: Mapping[str, Any] | None = None,
    ) -> Self:
        """Return a trajectory with every dataset present and nothing measured.

        Args:
            time: (N,), s, frame number of the experiment / frame rate.
            cameras: names of the cameras.
            frame_rate: Hz; NaN where the times are uneven.
            method: name of the composition, `paper` or `precise`.
            settings: YAML text of all settings.
            experiment: name of the experiment.
            provenance: versions, command, sha256 of the inputs; anything that JSON can hold.

        Returns:
            The trajectory; its NaN arrays are to be replaced with `dataclasses.replace`.
        """
        blank = _blank(cls, len(time)) | {"time": np.asarray(time, "float64")}
        return cls(
            **blank,
            cameras={name: CameraTrack.empty(len(time)) for name in cameras},
            frame_rate=frame_rate,
            method=method,
            settings=settings,
            experiment=experiment,
            provenance=dict(provenance or {}),
        )

    def save(self, path: str | Path) -> None:
        """Write the trajectory as HDF5 of schema sphereorient-track/1, whole or not at all.

        The same arrays give the same bytes in every dataset. A file of the same name is replaced only when the
        new one is complete.

        Args:
            path: the file, usually track.h5.

        Raises:
            OutputError: the folder is missing or cannot be written to.
        """
        path = Path(path)
        if not path.parent.is_dir():
            do = "create it first or choose another place"
            raise OutputError(refusal(str(path), expected=f"a folder {path.parent}", got="none", do=do))
        with whole_hdf5(path) as file:
            _write(self, file)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a trajectory that `save` wrote.

        Args:
            path: the file, usually track.h5.

        Returns:
            The trajectory; datasets and attributes that this version does not know are left out.

        Raises:
            TrackError: no such file, no HDF5 file, another schema, or a dataset is missing or has a wrong shape.
        """
        path = Path(path)
        got, do = "no file", "pass the track.h5 that `sphereorient track` wrote"
        try:
            if path.exists():
                got = "something else"
            if not path.is_file():  # a pipe would be waited for
                raise FileNotFoundError(path)
            file = h5py.File(path, "r")
        except (OSError, ValueError, RuntimeError) as error:
            raise TrackError(refusal(str(path), expected="an HDF5 file", got=got, do=do)) from error
        try:
            with file:
                return cls(**_read(file))
        except DAMAGE as error:  # ShapeError, unreadable JSON, a broken block
            got, do = f"'{' '.join(str(error).split())[:200]}'", "write the track again"
            raise TrackError(refusal(str(path), expected="a whole track", got=got, do=do)) from error

    def at(self, rows: NDArray[np.int64]) -> Self:
        """Return some of the frames, in increasing order.

        Args:
            rows: (n,), which.
        """
        parts = {name: getattr(self, name)[rows] for name, _ in _columns(type(self))}
        return replace(self, **parts, cameras={name: camera.at(rows) for name, camera in self.cameras.items()})

    def to_pandas(self) -> pd.DataFrame:
        """Return the trajectory as a table, one row a frame.

        Returns:
            Columns with their units in the name: time_s, position_x_mm, velocity_x_m_s, ..., quat_w, quat_x, quat_y,
            quat_z (of R_lab_body, w first, w >= 0), and the same of the smoother as quat_smooth_*; covariances and
            the cameras' own results stay in the file.

        Raises:
            OutputError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            do = "install it with `pip install sphereorient[table]`"
            raise OutputError(refusal("to_pandas", expected="the package pandas", got="none", do=do)) from error
        return pd.DataFrame(_table(self))

    def summary(self) -> dict[str, Any]:
        """Return the counts that a user looks at first.

        Returns:
            `frames`, `valid`, and `lost`: for each camera the frames it lost by reason, most frequent first.
        """
        lost = {}
        for name, camera in self.cameras.items():
            counts = Counter(str(reason) for reason in camera.reason if reason != Reason.OK)
            lost[name] = dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))
        return {"frames": len(self), "valid": int(np.sum(self.valid)), "lost": lost}


def _paths(record: type[Any]) -> Iterator[tuple[str, str, _Column]]:
    """Yield field name, place within the record's HDF5 group, and column."""
    for name, column in _columns(record):
        yield name, name.replace("candidate_", "candidates/"), column


def _write_dataset(group: h5py.Group, place: str, values: NDArray[Any], column: _Column) -> None:
    """Write one dataset with what it means; without times, so that equal arrays are equal bytes."""
    dataset = group.create_dataset(place, data=values, track_times=False)
    dataset.attrs["units"], dataset.attrs["description"] = column.units, column.description


_REASON = _Column("1", "why this camera has no orientation in the frame; ok where it has one")


def _write(track: Trajectory, file: h5py.File) -> None:
    """Fill an open file."""
    file.attrs["schema"] = SCHEMA
    file.attrs["provenance"] = json.dumps(track.provenance, sort_keys=True)
    for name in ("method", "settings", "experiment", "frame_rate"):
        file.attrs[name] = getattr(track, name)
    for name, place, column in _paths(Trajectory):
        _write_dataset(file, place, np.asarray(getattr(track, name), column.dtype), column)
    file["flags"].attrs["bits"] = json.dumps({flag.name: flag.value for flag in Flag})
    cameras = file.create_group("cameras")
    for name in sorted(track.cameras):
        _write_camera(track.cameras[name], cameras.create_group(name))


def _write_camera(camera: CameraTrack, group: h5py.Group) -> None:
    """Fill the group of one camera."""
    for name, place, column in _paths(CameraTrack):
        _write_dataset(group, place, np.asarray(getattr(camera, name), column.dtype), column)
    # of fixed length: HDF5 keeps strings of varying length apart from their dataset
    width = max([16, *map(len, camera.reason)])
    _write_dataset(group, "reason", np.array([str(r) for r in camera.reason], f"S{width}"), _REASON)


def _dataset(group: h5py.Group, place: str, dtype: str) -> NDArray[Any]:
    """Return a dataset's values, refused before anything is read where it lies elsewhere or claims too much."""
    dataset = _inside(group, place)
    got = ""
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        got = "none"
    elif dataset.external or dataset.is_virtual:
        got = "one that lies in other files"
    elif dataset.nbytes > LARGEST_RATIO * Path(group.file.filename).stat().st_size:
        got = f"one that claims {dataset.nbytes / 1e6:.3g} MB"
    elif not (dataset.dtype.kind == "S" if dtype == "S" else np.can_cast(dataset.dtype, dtype, "same_kind")):
        got = f"values of type {dataset.dtype}"[:100]
    if got:
        name, do = f"{group.file.filename}: {group.name.rstrip('/')}/{place}", "write the track again"
        raise TrackError(refusal(name, expected="a dataset", got=got, do=do))
    return np.asarray(dataset[()])


def _inside(group: h5py.Group, place: str) -> Any:
    """Return what lies at a place in a group; None where there is nothing, or a link, which may lead to other files."""
    here: Any = group
    for part in place.split("/"):
        if not isinstance(here, h5py.Group) or not isinstance(here.get(part, getlink=True), h5py.HardLink):
            return None
        here = here[part]
    return here


def _values(group: h5py.Group, record: type[Any]) -> dict[str, Any]:
    """Return all datasets of a record by field name."""
    known = {
        name: _dataset(group, place, c.dtype).astype(c.dtype)
        for name, place, c in _paths(record)
        if not c.since or place in group
    }
    if len(known) == len(list(_columns(record))):
        return known
    return _blank(record, len(next(iter(known.values())))) | known


def _attribute(file: h5py.File, name: str) -> Any:
    """Return an attribute of the root."""
    if name not in file.attrs:
        label, do = f"{file.filename}: attribute {name}", "write the track again"
        raise TrackError(refusal(label, expected="a value", got="none", do=do))
    return file.attrs[name]


def _read(file: h5py.File) -> dict[str, Any]:
    """Return all fields of a trajectory."""
    schema = file.attrs.get("schema")
    if schema != SCHEMA:
        do = "pass a track, or update sphereorient where the track is newer"
        raise TrackError(
            refusal(f"{file.filename}: schema", expected=SCHEMA, got=repr(str(schema))[1:60].strip("'"), do=do)
        )
    cameras = _inside(file, "cameras")
    return _values(file, Trajectory) | {
        "cameras": {name: _read_camera(cameras, name) for name in cameras or ()},
        "frame_rate": float(_attribute(file, "frame_rate")),
        "provenance": json.loads(_attribute(file, "provenance")),
        **{name: str(_attribute(file, name)) for name in ("method", "settings", "experiment")},
    }


def _read_camera(cameras: h5py.Group, name: str) -> CameraTrack:
    """Return the record of one camera."""
    group = _inside(cameras, name)
    if not isinstance(group, h5py.Group) or not name.isprintable() or len(name) > LONGEST_NAME:
        label, do = f"{cameras.file.filename}: cameras", "write the track again"
        raise TrackError(refusal(label, expected="groups with names", got=repr(name)[:60], do=do))
    known = {str(reason): reason for reason in Reason}
    texts = [text.decode() for text in _dataset(group, "reason", "S").tolist()]
    return CameraTrack(reason=tuple(known.get(text, text) for text in texts), **_values(group, CameraTrack))


def _quaternions(R: Floats) -> Floats:
    """Return (N, 4), w first, w >= 0, of rotations (N, 3, 3); NaN where one is missing."""
    from scipy.spatial.transform import Rotation

    quat_wxyz = np.full((len(R), 4), np.nan)
    there = np.isfinite(R).all((1, 2))
    if there.any():
        quat_wxyz[there] = np.roll(Rotation.from_matrix(R[there]).as_quat(canonical=True), 1, axis=1)
    return quat_wxyz


def _table(track: Trajectory) -> dict[str, NDArray[Any]]:
    """Return the columns of the table by name."""
    table: dict[str, NDArray[Any]] = {"time_s": track.time}
    table |= {name: getattr(track, name) for name in ("valid", "segment", "flags", "confidence")}
    for name, column in _columns(Trajectory):
        if column.tail == (3,):
            unit = column.units.replace("^", "").replace("/", "_")
            values = getattr(track, name)
            table |= {f"{name}_{axis}_{unit}": values[:, i] for i, axis in enumerate("xyz")}
    for name, R in (("quat", track.orientation), ("quat_smooth", track.orientation_smooth)):
        table |= {f"{name}_{axis}": values for axis, values in zip("wxyz", _quaternions(R).T, strict=True)}
    return table
