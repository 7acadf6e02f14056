"""Errors of a track, or of another program's orientations, against the exact truth of a synthetic experiment."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from sphereorient.errors import BenchError, TrackError, refusal
from sphereorient.files.hdf5 import UNNAMED, ball_groups
from sphereorient.statistics.behaviour import Behaviour, Reference, behaviour_of
from sphereorient.statistics.segments import TRANSLATION
from sphereorient.trajectory import Tracks, Trajectory
from sphereorient.trajectory.datasets import nearest_rows
from sphereorient.trajectory.rotations import distance_deg, nearest_rotations, rotation_vectors, rotations
from sphereorient.trajectory.walk import FICTRAC

Floats = NDArray[np.float64]
Frames = NDArray[np.int64]
RATES = ("velocity", "acceleration", "omega_lab", "omega_body", "alpha_lab", "alpha_body")
ALIGNMENTS = ("none", "body", "both")
AXES = 3
ITERATIONS, CONVERGED = 5000, 1e-12  # of the alignment
STILL_MM = 1e-6  # a true position that moves less is fixed
FICTRAC_COLUMNS = 23  # at least
DO = "pass the truth.h5 of this synthetic experiment"


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """Errors of N frames of a track; made by `score_track`, read by report and benchmarks. NaN: not measured."""

    frames: int
    valid: NDArray[np.bool_]  # (N,)
    orientation_deg: Floats  # (N,), geodesic distance to the true orientation
    camera_orientation_deg: dict[str, Floats]  # (N,) each, of each camera alone
    position_mm: Floats  # (N,), distance
    orientation_sigmas: Floats  # (N,), the same error over its stated covariance (Mahalanobis distance)
    position_sigmas: Floats  # (N,)
    relative_rms: dict[str, float]  # of velocity, acceleration, omega, alpha: rms error over the truth's rms
    coverage: dict[str, float]  # of the same: share of the frames with a value

    def percentiles_deg(self) -> Floats:
        """Median, 95th, 99th percentile and maximum of the valid frames' orientation error."""
        return _percentiles(self.orientation_deg[self.valid])

    def percentiles_mm(self) -> Floats:
        """Median, 95th, 99th percentile and maximum of the valid frames' position error."""
        return _percentiles(self.position_mm[self.valid])

    def over_stated(self) -> tuple[float, float]:
        """Return the rms over valid frames and axes of orientation's and position's errors over their stated sigmas."""
        return _rms_per_axis(self.orientation_sigmas[self.valid]), _rms_per_axis(self.position_sigmas[self.valid])

    def inside(self, share: float = 0.95) -> tuple[int, int]:
        """Return the valid frames with the true orientation in the stated region, and those that state one."""
        stated = self.orientation_sigmas[self.valid & np.isfinite(self.orientation_sigmas)]
        return int((stated**2 <= chi2.ppf(share, AXES)).sum()), len(stated)


def _rms_per_axis(sigmas: Floats) -> float:
    known = sigmas[np.isfinite(sigmas)]
    return float(np.sqrt(np.mean(known**2) / AXES)) if len(known) else np.nan


def _percentiles(values: Floats) -> Floats:
    values = values[np.isfinite(values)]
    return np.percentile(values, [50, 95, 99, 100]) if len(values) else np.full(4, np.nan)


def score_track(track: Trajectory, truth_path: str | Path, align: str = "none") -> Score:
    """Compare a track with the truth (docs/data-format.md) by time to half a frame; raise TrackError on a mismatch.
    `align`: "none", or "body": first rotate the body axes of the truth to those of the track, by a constant rotation.
    Lengths of a track in radii are not compared.
    """
    truth = _read_truth(truth_path, "position", sphere=track.sphere, also=RATES)
    row = _rows(truth["time"], track.time, truth_path)
    if align == "body" and (known := np.isfinite(track.orientation).all((1, 2))).any():
        turn = _alignment(track.orientation[known], truth["orientation"][row][known], align)[1].T
        truth["orientation"] = truth["orientation"] @ turn
        truth |= {key: truth[key] @ turn for key in RATES if key in truth and key.endswith("_body")}
    relative, coverage = {}, {}
    known_mm = track.length_unit == "mm"
    for key in (rate for rate in RATES if rate in truth and (known_mm or rate not in TRANSLATION)):
        measured, true = getattr(track, key), truth[key][row]
        have = np.isfinite(measured).all(axis=1)
        coverage[key] = float(have.mean())
        wrong, whole = (np.square(x[have]).sum() for x in (measured - true, true))
        relative[key] = float(np.sqrt(wrong / whole)) if have.any() else np.nan
    R_true = truth["orientation"][row]
    off_mm = truth["position"][row] - (track.position if known_mm else np.nan)
    off_rad = rotation_vectors(R_true @ track.orientation.transpose(0, 2, 1))
    return Score(
        frames=len(track),
        valid=track.valid & np.isfinite(track.orientation).all(axis=(1, 2)) & np.isfinite(track.position).all(axis=1),
        orientation_deg=distance_deg(track.orientation, R_true),
        camera_orientation_deg={name: distance_deg(seen.orientation, R_true) for name, seen in track.cameras.items()},
        position_mm=np.linalg.norm(off_mm, axis=1),
        orientation_sigmas=mahalanobis(off_rad, track.orientation_cov),
        position_sigmas=mahalanobis(off_mm, track.position_cov),
        relative_rms=relative,
        coverage=coverage,
    )


def named_as_true(tracks: Tracks, truth_path: str | Path, alike: Sequence[str]) -> Tracks:
    """Return the tracks with the names of spheres that look alike permuted for the least sum of median position errors.
    Raises TrackError: a name without a track.
    """
    for name in alike:
        tracks.picked(name)
    names, away_mm = list(tracks), _distances(tracks, truth_path)
    cost = np.zeros((len(alike), len(alike)))
    for k, name in enumerate(alike):
        if len(away_mm[name]):
            cost[k] = np.median(away_mm[name], axis=0)[[names.index(other) for other in alike]]
    rows, columns = (index.tolist() for index in linear_sum_assignment(cost))
    of_true = {alike[j]: alike[k] for k, j in zip(rows, columns, strict=True)}
    return Tracks({name: tracks[of_true.get(name, name)] for name in names})


def given_to_others(tracks: Tracks, truth_path: str | Path) -> dict[str, tuple[int, int]]:
    """Return for each sphere the valid frames nearest to the truth of another one, and the number of such changes."""
    found = {}
    for k, (name, away_mm) in enumerate(_distances(tracks, truth_path).items()):
        nearest = away_mm.argmin(axis=1)
        found[name] = int((nearest != k).sum()), int((nearest[1:] != nearest[:-1]).sum())
    return found


def _distances(tracks: Tracks, truth_path: str | Path) -> dict[str, Floats]:
    """Return the distances (V, K) of each sphere's positions in its valid frames to the true ones of all K, mm."""
    truths = {name: _read_truth(truth_path, "position", sphere=name) for name in tracks}
    found = {}
    for name, track in tracks.items():
        some = track.valid & np.isfinite(track.position).all(1)
        at = _rows(truths[name]["time"], track.time[some], truth_path)
        away = [np.linalg.norm(truth["position"][at] - track.position[some], axis=1) for truth in truths.values()]
        found[name] = np.stack(away, axis=1)
    return found


def true_positions(truth_path: str | Path, names: Iterable[str]) -> dict[str, Floats]:
    """Return the positions (N, 3), lab, mm, of the spheres of a truth."""
    return {name: _read_truth(truth_path, "position", sphere=name)["position"] for name in names}


def mahalanobis(error: Floats, covariance: Floats) -> Floats:
    """Return the lengths (N,) of errors (N, 3) over their covariances (N, 3, 3); NaN where either is unknown."""
    found = np.full(len(error), np.nan)
    known = np.isfinite(error).all(1) & np.isfinite(covariance).all((1, 2))
    whitened = np.linalg.solve(covariance[known], error[known][..., None])[..., 0]
    found[known] = np.sqrt(np.maximum((whitened * error[known]).sum(1), 0.0))
    return found


def true_orientations(path: Path, time_s: Floats, sphere: str = UNNAMED) -> Floats:
    """Return R_lab_body (N, 3, 3) of truth.h5 at times (N,), s, to half a frame; raise TrackError without a match."""
    truth = _read_truth(path, sphere=sphere)
    return truth["orientation"][_rows(truth["time"], time_s, path)]


def orientations_at(path: Path, frame: Frames) -> Floats:
    """Return R_lab_body (N, 3, 3) of truth.h5 in frames (N,), from 0; raise TrackError if there are too few."""
    return _truth_at(path, frame)[1]


def _truth_at(path: Path, frame: Frames) -> tuple[Floats, Floats]:
    """Return times (N,), s, and orientations as `orientations_at`."""
    truth = _read_truth(path)
    count = len(truth["time"])
    if len(frame) and (frame.min() < 0 or frame.max() >= count):
        expected, got = f"frames 0 .. {count - 1}", f"{frame.min()} .. {frame.max()}"
        raise TrackError(refusal(f"truth {path}", expected=expected, got=got, do=DO))
    return truth["time"][frame], truth["orientation"][frame]


def _read_truth(path: str | Path, *names: str, sphere: str = UNNAMED, also: Sequence[str] = ()) -> dict[str, Floats]:
    """Read datasets of a sphere's truth; `also`: if the file has them."""
    try:
        with h5py.File(path) as file:
            schema = str(file.attrs.get("schema", ""))  # old files have none
            if "spheres" in file and not sphere and not schema.startswith("sphereorient-track"):
                got, do = f"that of {', '.join(file['spheres'])}"[:200], "score the track of all of them"
                raise TrackError(refusal(f"truth {path}", expected="the truth of one ball", got=got, do=do))
            there = ball_groups(file)[sphere]
            wanted = ("time", "orientation", *names, *(key for key in also if key in there))
            truth = {key: np.asarray(there[key][()], np.float64) for key in wanted}
    except (OSError, KeyError) as error:
        got, expected = " ".join(str(error).split()), "time, position and orientation"
        raise TrackError(refusal(f"truth {path}", expected=expected, got=got, do=DO)) from None
    if schema.startswith("sphereorient-track"):
        raise TrackError(refusal(f"truth {path}", expected="the exact truth", got="a track", do=DO))
    if not len(truth["time"]) or truth["orientation"].shape != (len(truth["time"]), 3, 3):
        got = str(truth["orientation"].shape)
        raise TrackError(refusal(f"truth {path}", expected="one orientation a frame", got=got, do=DO))
    return truth


def reference_of(path: Path, track: Trajectory) -> Reference:
    """Read the reference of a track: truth.h5 or another track.h5, by time, or FicTrac's .dat, by the frame number.
    Raise TrackError (of another kind, or no time in common) or BenchError (no FicTrac file).
    """
    R, start, held = np.full((len(track), 3, 3), np.nan), np.zeros(len(track), bool), True  # for FicTrac always
    if path.suffix.lower() == ".dat":
        frame, orientation, begins = read_fictrac(path)
        row, there = nearest_rows(frame.astype(np.float64), track.time * track.frame_rate)
        R[there] = orientation[row[there]]
        start[there] = np.diff(np.cumsum(begins)[row[there]], prepend=0) > 0  # also starts between these rows
    elif not _is_track(path):
        truth = _read_truth(path, "position", sphere=track.sphere)
        held = bool(np.ptp(truth["position"], axis=0).max() < STILL_MM)
        return Reference(R_lab_body=truth["orientation"][_rows(truth["time"], track.time, path)], held=held)
    else:
        tracks = Tracks.load(path)
        other = next(iter((tracks if len(tracks) == 1 else tracks.picked(track.sphere)).values()))
        row, there = nearest_rows(other.time, track.time)
        R[there], held = other.orientation[row[there]], other.held
    if not np.isfinite(R).any():
        do = "pass a result on the same movie, and frame_rate in experiment.yaml for FicTrac's"
        raise TrackError(refusal(f"reference {path}", expected="frames of the track", got="none of them", do=do))
    return Reference(R_lab_body=R, start=start, exact=False, held=held)


def against(reference: Reference, track: Trajectory, align: str = "none") -> tuple[Floats, Behaviour]:
    """Return errors of orientation (N,), degrees, as `aligned_errors_deg` between new starts of the reference, and
    behaviour of a track.
    """
    begins = np.flatnonzero(np.zeros(len(track), bool) if reference.start is None else reference.start)
    parts = zip(np.split(track.orientation, begins), np.split(reference.R_lab_body, begins), strict=True)
    errors_deg = np.concatenate([aligned_errors_deg(R, R_true, align) for R, R_true in parts])
    return errors_deg, behaviour_of(track, reference, align == "both")


def another_result(path: Path, truth_path: Path) -> Trajectory:
    """Return the orientations of a FicTrac .dat (fixed ball) as a track at the times of a truth. Raises TrackError: the
    truth has too few frames; BenchError: another file.
    """
    frame, R, _ = read_fictrac(path)
    time_s, _ = _truth_at(truth_path, frame)
    still, cov = np.zeros((len(frame), 3)), np.tile(np.eye(3), (len(frame), 1, 1))
    empty = Trajectory.empty(time_s)
    return replace(empty, orientation=R, position=still, position_cov=cov, valid=np.ones(len(frame), bool))


def _is_track(path: Path) -> bool:
    try:
        with h5py.File(path) as file:
            return str(file.attrs.get("schema", "")).startswith("sphereorient-track")
    except OSError:  # the reader reports it
        return False


def _rows(known_s: Floats, time_s: Floats, path: str | Path) -> Frames:
    """Return the rows of the truth at the nearest times; refuse times more than half a frame away."""
    row, there = nearest_rows(known_s, time_s)
    if not there.all():
        got = f"{time_s[0]:.6g} .. {time_s[-1]:.6g} s"
        raise TrackError(refusal(f"truth {path}", expected="times of the track", got=got, do=DO))
    return row


def read_fictrac(path: Path) -> tuple[Frames, Floats, NDArray[np.bool_]]:
    """Read frames (N,), from 0, orientations (N, 3, 3), body to camera axes, and restarts of the sequence counter (N,)
    of a FicTrac 2 .dat file. Orientations are relative to the first frame: align with "both". Raises BenchError.
    """
    do = "pass FicTrac's .dat file"
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        got = "no file" if isinstance(error, FileNotFoundError) else "something else"
        raise BenchError(refusal(str(path), expected="lines of numbers between commas", got=got, do=do)) from None
    if rows.shape[0] == 0 or rows.shape[1] < FICTRAC_COLUMNS:
        got = f"{rows.shape[0]} lines of {rows.shape[1]}"
        raise BenchError(refusal(str(path), expected=f"at least {FICTRAC_COLUMNS} columns", got=got, do=do))
    sequence = rows[:, FICTRAC["sequence"]].ravel()
    begins = np.append(False, np.diff(sequence) < (1 if sequence.any() else 0))  # 0: no counter
    return rows[:, 0].astype(np.int64), rotations(rows[:, FICTRAC["rotation_cam"]]), begins


def aligned_errors_deg(R: Floats, R_true: Floats, align: str = "none") -> Floats:
    """Return geodesic distances (N,), degrees, of R (N, 3, 3) from the truth; NaN: not measured. `align`: "none";
    "body" fits B in R B (any body axes); "both" fits A and B in A R B (any lab too). BenchError: another word.
    """
    if align not in ALIGNMENTS:
        raise BenchError(refusal("--align", expected="none, body or both", got=repr(align)[:40], do="choose one"))
    known = np.isfinite(R + R_true).all((1, 2))
    out = np.full(len(R), np.nan)
    if known.any():
        measured, true = R[known], R_true[known]
        left, right = _alignment(measured, true, align)
        out[known] = distance_deg(left @ measured @ right, true)
    return out


def _alignment(measured: Floats, true: Floats, align: str) -> tuple[Floats, Floats]:
    """Return A and B with the least squared chords, fitted in turn from the first frame's B."""
    left = right = np.eye(3)
    if align == "none":
        return left, right
    right, products = measured[0].T @ true[0], np.einsum("nim,njl->ijlm", true, measured)
    for _ in range(ITERATIONS if align == "both" else 1):  # short tracks about one axis converge slowly
        if align == "both":
            left = nearest_rotations(np.einsum("ijlm,lm->ij", products, right))
        before, right = right, nearest_rotations(np.einsum("ijlm,ij->lm", products, left))
        if np.abs(right - before).max() < CONVERGED:
            break
    return left, right
