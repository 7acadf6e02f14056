"""Outliers of outlines replaced by a spline, short gaps interpolated; both are flagged."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_lsq_spline

from sphereorient.locate.settings import LocateSettings
from sphereorient.locate.sightings import Sightings
from sphereorient.trajectory import Flag, Reason

DEGREE = 3


def fill_gaps(sightings: Sightings, settings: LocateSettings) -> Sightings:
    """Replace outliers by a least-squares spline and fill short gaps, with flags and without rms; longer gaps stay NaN.

    Source: paper section III A.
    """
    track = np.column_stack([sightings.centre_px.numpy(), sightings.radius_px.numpy()])
    flags = sightings.flags.clone()
    rms = sightings.outline_rms_px.clone()
    for stretch in known_stretches(np.isfinite(track[:, 2]), settings.gap_frames_max):
        known = stretch[np.isfinite(track[stretch, 2])]
        spline, outlier = robust_spline(known, track[known], settings)
        track[known[outlier]] = spline[outlier]
        flags[known[outlier]] |= int(Flag.POSITION_OUTLIER_REPLACED)
        rms[known[outlier]] = torch.nan
        missing = np.setdiff1d(stretch, known)
        if len(missing):
            track[missing] = PchipInterpolator(known, track[known], axis=0)(missing)
            flags[missing] |= int(Flag.POSITION_INTERPOLATED)
    reason = tuple(
        Reason.OUTLINE if flags[k] & int(Flag.POSITION_OUTLIER_REPLACED) else reason
        for k, reason in enumerate(sightings.reason)
    )
    return replace(
        sightings,
        centre_px=torch.from_numpy(track[:, :2].copy()),
        radius_px=torch.from_numpy(track[:, 2].copy()),
        outline_rms_px=rms,
        flags=flags,
        reason=reason,
    )


def known_stretches(known: NDArray[np.bool_], gap_frames_max: int) -> list[NDArray[np.int64]]:
    """Return runs of frame numbers with gaps of at most `gap_frames_max`; the ends are known frames."""
    at = np.flatnonzero(known)
    if not len(at):
        return []
    parts = np.split(at, np.flatnonzero(np.diff(at) > gap_frames_max + 1) + 1)
    return [np.arange(part[0], part[-1] + 1) for part in parts]


def robust_spline(
    frame: NDArray[np.int64], value: NDArray[np.float64], settings: LocateSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return a robust cubic spline (n, D) of values (n, D), px, at frames (n,), and the outliers (n,) bool."""
    outlier = np.zeros(len(frame), bool)
    fitted = value.copy()
    for _ in range(5):
        good = ~outlier
        if good.sum() < 4 * (DEGREE + 1):  # too few to separate outliers from motion
            return value.copy(), np.zeros(len(frame), bool)
        fitted = _spline(frame[good], value[good], settings.spline_knot_frames)(frame)
        deviation = np.abs(fitted - value)
        sigma = 1.4826 * np.median(deviation[good], axis=0)
        now = (deviation > np.maximum(settings.outlier_factor * sigma, settings.outlier_px)).any(axis=1)
        if (now == outlier).all():
            break
        outlier = now
    return fitted, outlier


def _spline(x: NDArray[np.int64], y: NDArray[np.float64], spacing: int):  # type: ignore[no-untyped-def]
    inner = np.arange(x[0] + spacing, x[-1] - spacing / 2, spacing, dtype=float)
    counts = np.histogram(x, np.concatenate([[x[0]], inner, [x[-1] + 1]]))[0]
    # Schoenberg and Whitney: each knot needs data nearby.
    inner = inner[(counts[:-1] >= DEGREE + 1) & (counts[1:] >= DEGREE + 1)]
    knots = np.concatenate([[x[0]] * (DEGREE + 1), inner, [x[-1]] * (DEGREE + 1)]).astype(float)
    return make_lsq_spline(x.astype(float), y, knots, k=DEGREE)
