# ruff: noqa: RUF009 -- stored returns a dataclass field without a default

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import Flag, Reason, ShapeError, TrackError, refusal
from sphereorient.files.hdf5 import DAMAGE, SPHERES, UNNAMED, whole_hdf5
from sphereorient.files.provenance import package
from sphereorient.trajectory import datasets, journal
from sphereorient.trajectory.datasets import in_length, reasons_of, stored, stored_fields

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from scipy.spatial.transform import Rotation

    from sphereorient.trajectory.walk import Walk

SCHEMA = "sphereorient-track/1"
SCHEMA_MINOR = 1  # since then `score` of the precise method is evidence for the painted ball
SCHEMA_OF_SEVERAL = "sphereorient-track/2"  # with a group SPHERES/NAME for each sphere
TEXTS = ("method", "settings", "experiment")
HELD = 0.1  # of the position's stated error
AGAIN = "write the track again"
REASON = datasets.DatasetSpec("1", "why this camera has no orientation in the frame; ok where it has one")
# Rows of `plot`: label, measured field, smoothed field.
PLOTTED = (
    ("position (mm)", "position", "position_smooth"),
    ("orientation (quaternion, 1)", "orientation", "orientation_smooth"),
    ("velocity (m/s)", "", "velocity"),
    ("angular velocity, lab (rad/s)", "", "omega_lab"),
)
COLOURS = {"w": "#666666", "x": "#D55E00", "y": "#009E73", "z": "#0072B2"}  # of the axes, in every figure
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
NO_PICTURE = (Reason.MISSING, Reason.UNDECODABLE, Reason.REPEATED)  # without information on the ball


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack:
    """Results of one camera in N frames; candidates of frame k are rows offset[k] .. offset[k + 1]."""

    centre_px: Floats = stored("px", "projection of the sphere's centre, (u, v)", 2)
    centre_sigma_px: Floats = stored(
        "px", "standard deviation of centre_px in any direction, of noise and paint", since="0.3"
    )
    radius_px: Floats = stored("px", "radius of the outline")
    limb_coverage: Floats = stored("1", "share of the limb whose pixels gave the position", since="0.3")
    outline_rms_px: Floats = stored("px", "rms distance of the edge points from the fitted outline")
    orientation: Floats = stored("1", "R_lab_body of this camera's own best candidate", 3, 3)
    orientation_cov: Floats = stored("rad^2", "covariance of delta, R_true = exp([delta]x) R, lab components", 3, 3)
    score: Floats = stored("1", "agreement of the picture with the map at this orientation, 0 to 1")
    xi: Floats = stored("rad/s", "angle over time of the link that enters the frame; its variance weighs the cameras")
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
        datasets.check_shapes(self, {"frames": frames, "offsets": frames + 1, "candidates": candidates})

    def at(self, rows: NDArray[np.int64]) -> Self:
        """Return the frames of increasing `rows`, with their candidates."""
        counts = np.diff(self.candidate_offset)
        kept = np.isin(np.repeat(np.arange(len(counts)), counts), rows)
        parts = {
            name: getattr(self, name)[kept if c.rows == "candidates" else rows] for name, c in stored_fields(type(self))
        }
        parts["candidate_offset"] = np.concatenate([[0], np.cumsum(counts[rows])])
        return replace(self, **parts, reason=tuple(self.reason[k] for k in rows.tolist()))

    @classmethod
    def empty(cls, frames: int) -> Self:
        """Return an empty record of `frames` frames."""
        return cls(reason=(Reason.NOT_FOUND,) * frames, **datasets.blank_datasets(cls, frames))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """All results on one sphere in N frames; NaN if not measured; `track[10:50]` is a part. Units: s, rad, mm, m/s,
    m/s^2; with `length_unit` "radii" radii, radii/s, radii/s^2.
    """

    time: Floats = stored("s", "frame number of the experiment / frame rate; middle of the exposure")
    valid: Bools = stored("1", "orientation and position measured in this frame", dtype="bool", fill=0)
    position: Floats = stored("mm", "centre of the sphere, lab", 3)
    position_cov: Floats = stored("mm^2", "covariance of position", 3, 3)
    orientation: Floats = stored("1", "R_lab_body: columns are the body axes in the lab", 3, 3)
    orientation_cov: Floats = stored("rad^2", "covariance of delta, R_true = exp([delta]x) R, lab components", 3, 3)
    position_systematic_cov: Floats = stored(
        "mm^2",
        "covariance of the error of position that the calibration leaves, shared by all frames",
        3,
        3,
        since="0.2",
    )
    orientation_systematic_cov: Floats = stored(
        "rad^2", "covariance of delta that the calibration leaves, shared by all frames", 3, 3, since="0.2"
    )
    position_smooth: Floats = stored("mm", "the smoother's position, lab", 3)
    position_smooth_cov: Floats = stored("mm^2", "covariance of position_smooth", 3, 3)
    orientation_smooth: Floats = stored("1", "the smoother's R_lab_body", 3, 3)
    orientation_smooth_cov: Floats = stored("rad^2", "covariance of orientation_smooth, as orientation_cov", 3, 3)
    velocity: Floats = stored("m/s", "velocity of the centre, lab", 3)
    velocity_sigma: Floats = stored("m/s", "standard deviation of velocity", 3)
    acceleration: Floats = stored("m/s^2", "acceleration of the centre, lab", 3)
    acceleration_sigma: Floats = stored("m/s^2", "standard deviation of acceleration", 3)
    omega_lab: Floats = stored("rad/s", "angular velocity, dR/dt R^T = [omega_lab]x, lab components", 3)
    omega_lab_sigma: Floats = stored("rad/s", "standard deviation of omega_lab", 3)
    omega_body: Floats = stored("rad/s", "angular velocity, body components: R^T omega_lab", 3)
    omega_body_sigma: Floats = stored("rad/s", "standard deviation of omega_body", 3)
    alpha_lab: Floats = stored("rad/s^2", "angular acceleration, lab components: derivative of omega_lab", 3)
    alpha_lab_sigma: Floats = stored("rad/s^2", "standard deviation of alpha_lab", 3)
    alpha_body: Floats = stored("rad/s^2", "angular acceleration, body components: R^T alpha_lab", 3)
    alpha_body_sigma: Floats = stored("rad/s^2", "standard deviation of alpha_body", 3)
    segment: NDArray[np.int64] = stored("1", "number of the segment, -1 outside any", dtype="int64", fill=-1)
    flags: NDArray[np.uint32] = stored("1", "bit mask, named in the attribute bits", dtype="uint32", fill=0)
    confidence: Floats = stored("1", "probability of the chosen orientation among the candidates")
    margin: Floats = stored(
        "1", "negative log-likelihood of the next distinct orientation less that of the chosen one", since="0.2"
    )
    margin_angle: Floats = stored("rad", "angle between these two; NaN where no other one was looked for", since="0.2")
    identity: Floats = stored(
        "1", "probability that this is the ball of this name; NaN where it was never in doubt", of_several=True
    )
    cameras: Mapping[str, CameraTrack]
    frame_rate: float  # Hz
    method: str  # paper, precise
    settings: str  # YAML text
    experiment: str
    provenance: Mapping[str, Any]  # versions, command, sha256 of inputs; JSON types
    length_unit: str = "mm"  # or radii, of a sphere of unknown diameter
    sphere: str = UNNAMED  # name of the sphere

    def __post_init__(self) -> None:
        frames = np.size(self.time)
        datasets.check_shapes(self, {"frames": frames})
        for name, camera in self.cameras.items():
            if len(camera.reason) != frames:
                got, do = f"{len(camera.reason)} frames", "give every camera all frames of the track"
                raise ShapeError(refusal(f"Trajectory.cameras[{name!r}]", expected=f"{frames}", got=got, do=do))

    def __len__(self) -> int:
        return len(self.time)

    @property
    def believed(self) -> Bools:
        """(N, C): in which frames which cameras measured the pose."""
        return np.stack([np.array([why == Reason.OK for why in one.reason], bool) for one in self.cameras.values()], 1)

    @property
    def title(self) -> str:
        """Name of the experiment, and of the sphere among several."""
        return f"{self.experiment}, ball {self.sphere}" if self.sphere else self.experiment

    @property
    def bits(self) -> dict[str, int]:
        """The flags, by name."""
        return {str(flag.name): flag.value for flag in Flag if self.sphere or flag is not Flag.IDENTITY}

    @property
    def rate_scale(self) -> float:
        """Lengths of velocity per length of position: m per mm, or 1."""
        return 1e-3 if self.length_unit == "mm" else 1.0

    @property
    def held(self) -> bool:
        """Whether the centre is fixed: its motion over the track is less than a tenth of its stated error."""
        there = self.valid & np.isfinite(self.position).all(1)
        if there.sum() < 2:
            return False
        usual = np.median(np.sqrt(np.diagonal(self.position_cov[there], axis1=1, axis2=2)), axis=0)
        return bool((self.position[there].std(0) < HELD * usual).all())

    def __repr__(self) -> str:
        return "\n".join(["Trajectory", *(f"  {title:8} {text}" for title, text in self._facts())])

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{title}</th><td>{escape(text)}</td></tr>" for title, text in self._facts())
        return f"<table><caption>Trajectory</caption>{''.join(rows)}</table>"

    def _facts(self) -> list[tuple[str, str]]:
        counts = self.summary()
        rate = f", {self.frame_rate:g} Hz" if np.isfinite(self.frame_rate) else ""
        span = f"{self.time[0]:.6g} .. {self.time[-1]:.6g} s" if len(self) else "none"
        cameras = [f"{name} ({sum(lost.values())} frames lost)" for name, lost in counts["lost"].items()]
        return [
            ("of", self.title or "an experiment without name"),
            ("frames", f"{counts['frames']}, {counts['valid']} valid"),
            ("time", span + rate),
            ("cameras", ", ".join(cameras) or "none"),
            ("method", self.method or "none"),
        ]

    @classmethod
    def empty(cls, time: Floats, *, cameras: Sequence[str] = (), **fields: Any) -> Self:
        """Return a trajectory at times (N,), s, for the named cameras, with nothing measured.
        `fields`: frame_rate (Hz; NaN for uneven times), method, settings (YAML), experiment, provenance (JSON types).
        """
        known: dict[str, Any] = {"frame_rate": np.nan, "provenance": {}, **dict.fromkeys(TEXTS, ""), **fields}
        parts: dict[str, Any] = datasets.blank_datasets(cls, len(time)) | {"time": np.asarray(time, "float64")}
        return cls(cameras={name: CameraTrack.empty(len(time)) for name in cameras}, **parts, **known)

    def save(self, path: str | Path) -> None:
        """Write HDF5 of schema sphereorient-track/1, as `Tracks.save` for one ball."""
        Tracks.of(self).save(path)

    @classmethod
    def load(cls, path: str | Path) -> "Trajectory":
        """Read the track of one ball, as `Tracks.load`; raise TrackError also for tracks of several."""
        return one_track(Tracks.load(path), str(path))

    def __getitem__(self, frames: slice | int) -> Self:
        """Return the frames of a slice with positive step; raise TypeError or ShapeError for anything else."""
        if not isinstance(frames, slice):
            got, do = f"{frames!r:.60}", "write track[10:11] for one frame"
            raise TypeError(refusal("Trajectory[...]", expected="a slice of frames", got=got, do=do))
        if frames.step is not None and frames.step <= 0:
            do = "keep frames in order of time"
            raise ShapeError(refusal("Trajectory[...]", expected="a positive step", got=f"{frames.step}", do=do))
        return self.at(np.arange(len(self))[frames])

    def at(self, rows: NDArray[np.int64]) -> Self:
        """Return the frames of increasing `rows`."""
        parts = {name: getattr(self, name)[rows] for name, _ in stored_fields(type(self))}
        return replace(self, **parts, cameras={name: camera.at(rows) for name, camera in self.cameras.items()})

    def to_pandas(self) -> "pd.DataFrame":
        """Return a table, one row per frame, units in the column names (time_s, position_x_mm, velocity_x_m_s, ...),
        with quaternions (w >= 0), without covariances and cameras. Raises OutputError: pandas is not installed.
        """
        pandas = package("pandas", "table")
        table: dict[str, NDArray[Any]] = {"time_s": self.time}
        table |= {name: getattr(self, name) for name in ("valid", "segment", "flags", "confidence")}
        for name, c in stored_fields(self):
            if c.tail == (3,):
                unit = c.units.replace("^", "").replace("/", "_")
                table |= {f"{name}_{axis}_{unit}": getattr(self, name)[:, i] for i, axis in enumerate("xyz")}
        for name, R in (("quat", self.orientation), ("quat_smooth", self.orientation_smooth)):
            table |= {f"{name}_{axis}": part for axis, part in zip("wxyz", quaternions_wxyz(R).T, strict=True)}
        return cast("pd.DataFrame", pandas.DataFrame(table))

    @property
    def posed(self) -> Floats:
        """R_lab_body (N, 3, 3): measured, else by the smoother, else NaN."""
        known = np.isfinite(self.orientation).all(axis=(1, 2), keepdims=True)
        return np.where(known, self.orientation, self.orientation_smooth)

    def to_scipy(self) -> "Rotation":
        """Return the orientations of the valid frames as rotations of SciPy; their times are `time[valid]`."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_matrix(self.orientation[self.valid])

    def walk(self) -> "Walk":
        """Return the walk of an animal on the ball, by `posed`, with the lab as its frame; see `walk_of`."""
        from sphereorient.trajectory.walk import walk_of  # imports torch

        return walk_of(self.time, self.posed)

    def plot(self) -> "Figure":
        """Draw position, quaternion (continuous sign), velocity and omega over time: measured dots, smoothed lines."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.3, 11.0), layout="constrained")
        rows = figure.subplots(len(PLOTTED), 1, sharex=True)
        for axes, (label, measured, smoothed) in zip(rows, PLOTTED, strict=True):
            for name in filter(None, (measured, smoothed)):
                values = getattr(self, name)
                values = values if values.ndim == 2 else _continuous(quaternions_wxyz(values))
                for axis, part in zip("wxyz"[-values.shape[1] :], values.T, strict=True):
                    line = {"lw": 1.2, "label": axis} if name == smoothed else {"ls": "", "marker": ".", "ms": 3}
                    axes.plot(self.time, part, color=COLOURS[axis], **line)
            axes.set_ylabel(in_length(label, self.length_unit))
            axes.legend(loc="upper right", ncols=4, fontsize="small")
            axes.grid(alpha=0.3)
        axes.set_xlabel("time (s)")
        figure.suptitle(f"{self.title or 'trajectory'}: {len(self)} frames, {self.method}")
        return figure

    @cached_property
    def without_ball(self) -> Bools:
        """Frames without a ball in any camera that has a picture, (N,) bool."""
        if not self.cameras:
            return np.zeros(len(self), bool)
        reasons = np.array([camera.reason for camera in self.cameras.values()], object)
        none, unknown = reasons == Reason.NOT_FOUND, np.isin(reasons, NO_PICTURE)
        return np.asarray(~self.valid & none.any(0) & (none | unknown).all(0))

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `frames`, `valid`, `no_ball`, and `lost` frames, these by camera and reason."""
        lost, none = {}, self.without_ball
        for name, camera in self.cameras.items():
            reasons = (why for why, absent in zip(camera.reason, none, strict=True) if not absent)
            counts = Counter(str(why) for why in reasons if why != Reason.OK)
            lost[name] = dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))
        return {"frames": len(self), "valid": int(np.sum(self.valid)), "no_ball": int(none.sum()), "lost": lost}


class Tracks(Mapping[str, Trajectory]):
    """Trajectories of the spheres of one recording by name, with the same times; a single sphere's name is empty."""

    def __init__(self, tracks: Mapping[str, Trajectory]) -> None:
        times = [track.time for track in tracks.values()]
        if not all(np.array_equal(time, times[0]) for time in times):
            got, do = ", ".join(str(len(time)) for time in times) + " frames, of other times", "give each all frames"
            raise ShapeError(refusal("Tracks", expected="the same times of every ball", got=got, do=do))
        self._tracks = {name: replace(track, sphere=name) for name, track in tracks.items()}

    def __getitem__(self, name: str) -> Trajectory:
        return self._tracks[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tracks)

    def __len__(self) -> int:
        return len(self._tracks)

    def __repr__(self) -> str:
        return "\n".join(map(repr, self.values())) or "no tracks"

    def _repr_html_(self) -> str:
        return "".join(track._repr_html_() for track in self.values())

    @classmethod
    def of(cls, tracks: Trajectory | Mapping[str, Trajectory]) -> Self:
        """Return tracks by name, or the tracks of one trajectory."""
        return cls({tracks.sphere: tracks} if isinstance(tracks, Trajectory) else tracks)

    def save(self, path: str | Path) -> None:
        """Write HDF5, replacing an old file at the end; equal arrays give equal bytes. One ball has schema
        sphereorient-track/1, several have sphereorient-track/2: a group /spheres/NAME each, like such a file. Raises
        OutputError: the file cannot be written.
        """
        with whole_hdf5(Path(path)) as file:
            if len(self) == 1:
                write_track(next(iter(self.values())), file)
                return
            file.attrs["schema"] = SCHEMA_OF_SEVERAL
            spheres = file.create_group(SPHERES, track_order=True)
            for name, track in self.items():
                write_track(track, spheres.create_group(name))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by `save`, or the rows so far of a running or killed `live`. Raises TrackError: no HDF5
        file, another schema, or a dataset missing or of wrong shape.
        """
        with opened_track(path) as file:
            if not isinstance(file, h5py.File):
                return cls.of(Trajectory(**journal.read_journal(file, Trajectory, CameraTrack)))
            if file.attrs.get("schema") != SCHEMA_OF_SEVERAL:
                return cls.of(read_track(file))
            spheres = datasets.inside(file, SPHERES)
            if not isinstance(spheres, h5py.Group) or not len(spheres):
                raise TrackError(refusal(f"{path}: {SPHERES}", expected="groups with names", got="none", do=AGAIN))
            return cls({name: read_track(datasets.named_group(spheres, name)) for name in spheres})

    def picked(self, name: str | None) -> Self:
        """Return the sphere of this name alone; None: all. Raise TrackError for an unknown name."""
        if name is None:
            return self
        if name not in self:
            known = ", ".join(each or "one ball without name" for each in self)
            do = "leave --sphere out" if UNNAMED in self else "name one of these"
            raise TrackError(refusal("--sphere", expected=known, got=repr(name)[:60], do=do))
        return type(self)({name: self[name]})


def one_track(found: "Trajectory | Tracks", name: str = "tracks") -> Trajectory:
    """Return the track of a single ball; raise TrackError, with `name`, for tracks of several."""
    tracks = Tracks.of(found)
    if len(tracks) == 1:
        return next(iter(tracks.values()))
    got, do = ", ".join(tracks)[:200], "read all with Tracks.load(path), and pick one by its name"
    raise TrackError(refusal(name, expected="the track of one ball", got=got, do=do))


def quaternions_wxyz(R: NDArray[Any]) -> Floats:
    """Return quaternions (N, 4), w first, w >= 0, of rotations (N, 3, 3); NaN stays NaN."""
    from scipy.spatial.transform import Rotation

    quat_wxyz = np.full((len(R), 4), np.nan)
    there = np.isfinite(R).all((1, 2))
    if there.any():
        quat_wxyz[there] = Rotation.from_matrix(R[there]).as_quat(canonical=True, scalar_first=True)
    return quat_wxyz


def _continuous(quat_wxyz: Floats) -> Floats:
    """Choose the signs of quaternions (N, 4) nearest to the previous one."""
    there = np.isfinite(quat_wxyz).all(1)
    known = quat_wxyz[there]
    flips = np.cumprod(np.where((known[1:] * known[:-1]).sum(1) < 0, -1.0, 1.0))
    signed = quat_wxyz.copy()
    signed[np.flatnonzero(there)[1:]] *= flips[:, None]
    return signed


@contextmanager
def opened_track(path: str | Path) -> Iterator[h5py.File | BinaryIO]:
    """Open the file of a track, or its journal if incomplete; TrackError if it is neither, or damaged."""
    path = Path(path)
    got, do = "no file", "pass the track.h5 that `sphereorient track` wrote"
    try:
        if path.exists():
            got = "something else"
        elif journal.journal_path(path).is_file():
            path = journal.journal_path(path)
        if not path.is_file():  # opening a pipe may block
            raise FileNotFoundError(path)
        file = path.open("rb") if journal.is_journal(path) else h5py.File(path, "r")
    except (OSError, ValueError, RuntimeError) as error:
        raise TrackError(refusal(str(path), expected="an HDF5 file", got=got, do=do)) from error
    try:
        with file:
            yield file
    except DAMAGE as error:  # includes ShapeError and broken JSON
        got = f"'{' '.join(str(error).split())[:200]}'"
        raise TrackError(refusal(str(path), expected="a whole track", got=got, do=AGAIN)) from error


def read_track(group: h5py.Group) -> Trajectory:
    """Read a track written by `write_track`; unknown datasets and attributes are ignored."""
    schema, name = group.attrs.get("schema"), f"{group.file.filename}{group.name.rstrip('/')}"
    if schema != SCHEMA:
        got, do = repr(str(schema))[1:60].strip("'"), "pass a track, or update sphereorient where the track is newer"
        raise TrackError(refusal(f"{name}: schema", expected=SCHEMA, got=got, do=do))
    for attribute in (*TEXTS, "frame_rate", "provenance"):
        if attribute not in group.attrs:
            raise TrackError(refusal(f"{name}: attribute {attribute}", expected="a value", got="none", do=AGAIN))
    cameras = {}
    for camera in (every := datasets.inside(group, "cameras")) or ():
        own = datasets.named_group(every, camera)
        reason = reasons_of(datasets.read_dataset(own, "reason", "S"))
        cameras[camera] = CameraTrack(reason=reason, **datasets.read_datasets(own, CameraTrack))
    parts: dict[str, Any] = datasets.read_datasets(group, Trajectory)
    parts |= {name: str(group.attrs[name]) for name in TEXTS}
    return Trajectory(
        cameras=cameras,
        frame_rate=float(group.attrs["frame_rate"]),
        provenance=json.loads(group.attrs["provenance"]),
        length_unit=str(group.attrs.get("length_unit", "mm")),
        sphere=str(group.attrs.get("sphere", UNNAMED)),
        **parts,
    )


def write_track(track: Trajectory, group: h5py.Group) -> None:
    """Write a track into an empty group: a file, or the group of one of several balls."""
    group.attrs["schema"], group.attrs["schema_minor"] = SCHEMA, SCHEMA_MINOR
    group.attrs["provenance"] = json.dumps(track.provenance, sort_keys=True)
    for name in (*TEXTS, "frame_rate", "length_unit"):
        group.attrs[name] = getattr(track, name)
    if track.sphere:
        group.attrs["sphere"] = track.sphere
    datasets.write_datasets(track, group)
    group["flags"].attrs["bits"] = json.dumps(track.bits)
    cameras = group.create_group("cameras")
    for name in sorted(track.cameras):
        write_camera(track.cameras[name], cameras.create_group(name))


def write_camera(camera: CameraTrack, group: h5py.Group) -> None:
    """Write the datasets of one camera."""
    datasets.write_datasets(camera, group)
    # fixed length: HDF5 stores variable strings outside the dataset
    width = max([16, *map(len, camera.reason)])
    datasets.write_dataset(group, "reason", np.array([str(r) for r in camera.reason], f"S{width}"), REASON)
