"""The exact orientations of a synthetic experiment at a track's times."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import TrackError, refusal

Floats = NDArray[np.float64]
DO = "pass the truth.h5 of this experiment"


def true_orientations(path: Path, time_s: Floats) -> Floats:
    """Return R_lab_body (N, 3, 3) of truth.h5 at times (N,), to half a frame.

    Raises:
        TrackError: no truth, or times that do not fit.
    """
    time, R = _read(path)
    after = np.clip(np.searchsorted(time, time_s), 0, len(time) - 1)
    before = np.maximum(after - 1, 0)
    row = np.where(np.abs(time[before] - time_s) < np.abs(time[after] - time_s), before, after)
    step = float(np.median(np.diff(time))) if len(time) > 1 else np.inf
    if len(time_s) and np.abs(time[row] - time_s).max() > step / 2:
        got = f"{time_s[0]:.6g} .. {time_s[-1]:.6g} s"
        raise TrackError(refusal(f"truth {path}", expected="times of the track", got=got, do=DO))
    return R[row]


def orientations_at(path: Path, frame: NDArray[np.int64]) -> Floats:
    """Return R_lab_body (N, 3, 3) of truth.h5 in frames (N,), counted from its first.

    Raises:
        TrackError: no truth, or not of so many frames.
    """
    time, R = _read(path)
    if len(frame) and (frame.min() < 0 or frame.max() >= len(time)):
        expected, got = f"frames 0 .. {len(time) - 1}", f"{frame.min()} .. {frame.max()}"
        raise TrackError(refusal(f"truth {path}", expected=expected, got=got, do=DO))
    return R[frame]


def _read(path: Path) -> tuple[Floats, Floats]:
    try:
        with h5py.File(path) as file:
            time, R = (np.asarray(file[key][()], np.float64) for key in ("time", "orientation"))
    except (OSError, KeyError) as error:
        got = " ".join(str(error).split())
        raise TrackError(refusal(f"truth {path}", expected="time and orientation", got=got, do=DO)) from None
    if not len(time) or R.shape != (len(time), 3, 3):
        raise TrackError(refusal(f"truth {path}", expected="one orientation a frame", got=str(R.shape), do=DO))
    return time, R
