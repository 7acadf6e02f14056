"""How far a track is from the truth of a synthetic experiment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.errors import TrackError, refusal
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]
RATES = ("velocity", "acceleration", "omega_lab", "omega_body", "alpha_lab", "alpha_body")


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """Errors of N frames of a track; made by `score_track`, read by demo, report and benchmarks. NaN: not measured."""

    frames: int
    valid: NDArray[np.bool_]  # (N,)
    orientation_deg: Floats  # (N,), geodesic distance to the true orientation
    camera_orientation_deg: dict[str, Floats]  # (N,) each, of each camera alone
    position_mm: Floats  # (N,), distance
    relative_rms: dict[str, float]  # of velocity, acceleration, omega, alpha: rms error over the truth's rms
    coverage: dict[str, float]  # of the same: share of the frames that have one

    def percentiles_deg(self) -> Floats:
        """Median, 95th, 99th percentile and maximum of the valid frames' orientation error."""
        return _percentiles(self.orientation_deg[self.valid])

    def percentiles_mm(self) -> Floats:
        """Median, 95th, 99th percentile and maximum of the valid frames' position error."""
        return _percentiles(self.position_mm[self.valid])


def _percentiles(values: Floats) -> Floats:
    values = values[np.isfinite(values)]
    return np.percentile(values, [50, 95, 99, 100]) if len(values) else np.full(4, np.nan)


def _angle_deg(A: Floats, B: Floats) -> Floats:
    distance = so3.geodesic_distance(torch.from_numpy(A), torch.from_numpy(B)).numpy()
    return np.asarray(np.rad2deg(distance), np.float64)


def _read_truth(path: str | Path) -> dict[str, Floats]:
    """Read the datasets of truth.h5 that a track is compared with."""
    name, do = f"truth {path}", "pass the truth.h5 of a synthetic experiment"
    try:
        with h5py.File(path) as file:
            return {key: np.asarray(file[key][()]) for key in ("time", "position", "orientation", *RATES)}
    except OSError as error:
        raise TrackError(refusal(name, expected="an HDF5 file", got=" ".join(str(error).split()), do=do)) from None
    except KeyError as error:
        got = " ".join(str(error.args[0]).split())
        raise TrackError(refusal(name, expected="time, position, orientation and rates", got=got, do=do)) from None


def score_track(track: Trajectory, truth_path: str | Path) -> Score:
    """Compare a track with the exact truth.

    Args:
        track: the track; its times pick the frames of the truth, to half a frame.
        truth_path: truth.h5 of a synthetic experiment (docs/data-format.md).

    Returns:
        The errors, frame by frame.

    Raises:
        TrackError: no truth file, or times that do not fit.
    """
    truth = _read_truth(truth_path)
    step = float(np.median(np.diff(truth["time"])))
    row = np.rint((track.time - truth["time"][0]) / step).astype(int)
    known = (row >= 0) & (row < len(truth["time"]))
    if not known.all() or np.abs(track.time - truth["time"][row]).max() > step / 2:
        got = f"{track.time[0]:.6g} .. {track.time[-1]:.6g} s"
        name = f"truth {truth_path}"
        raise TrackError(refusal(name, expected="times of the track", got=got, do="pass the truth of this experiment"))
    relative, coverage = {}, {}
    for key in RATES:
        measured, true = getattr(track, key), truth[key][row]
        have = np.isfinite(measured).all(axis=1)
        coverage[key] = float(have.mean())
        wrong, whole = (np.square(x[have]).sum() for x in (measured - true, true))
        relative[key] = float(np.sqrt(wrong / whole)) if have.any() else np.nan
    R_true = truth["orientation"][row]
    return Score(
        frames=len(track),
        valid=track.valid & np.isfinite(track.orientation).all(axis=(1, 2)) & np.isfinite(track.position).all(axis=1),
        orientation_deg=_angle_deg(track.orientation, R_true),
        camera_orientation_deg={name: _angle_deg(seen.orientation, R_true) for name, seen in track.cameras.items()},
        position_mm=np.linalg.norm(track.position - truth["position"][row], axis=1),
        relative_rms=relative,
        coverage=coverage,
    )
