"""Smoothed position and orientation of the precise track, their derivatives, and sigmas."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.motion.estimate import CHANGE, SPEED, VALUE, Estimate, ProcessNoise, ProcessPrior, estimate
from sphereorient.motion.kalman import Bools, Floats
from sphereorient.motion.measure import M_PER_MM, Motion
from sphereorient.motion.path import RotationTrack, SegmentTrack, mahalanobis2, rotation_of
from sphereorient.motion.settings import SmoothSettings

Rows = NDArray[np.int64]

LONGEST_STEP = 1.5  # typical steps; longer ones are bridged by instants in between
MOST_BETWEEN = 300  # instants that bridge one long step
LOST_RAD = 0.5  # an orientation with a larger sigma is discarded
LAGS = 3  # frames after which a remaining error is one that lasts
CLIP = 4.0  # sigmas, so that a wrong frame does not count as an error that lasts
AS_MANY = 20  # pairs of frames with the weight of the assumed share
MOST_LASTING = 0.9  # largest share of the variance that lasts: some noise is left
ON_PATH = 4.0  # sigmas (of three axes) within which a measured position agrees with the smoothed path


@dataclass(frozen=True, kw_only=True, eq=False)
class Smoothed(Motion):
    """Motion of N frames by the smoother, float64; covariances and sigmas include the bias of smoothing."""

    R_given_path: Tensor  # (N, 3, 3), each frame's own orientation, given the smoothed path of positions
    cov_given_path_rad2: Tensor  # (N, 3, 3), its covariance, with `orientation_scale` and the path's error
    extrapolated: Tensor  # (N,) bool, frames of a segment without any own measurement
    rejected: Tensor  # (N,) bool, frames with a rejected measurement
    position_scale: float  # true errors of the measured positions over their sigmas, with slow errors
    orientation_scale: float  # the same for orientations
    process: ProcessNoise


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredPoses:
    """Measured poses of N frames, the input of `smooth_motion`."""

    time_s: Tensor  # (N,), increasing within a segment, not necessarily even
    position_lab_mm: Tensor  # (N, 3), NaN where not measured
    position_cov_mm2: Tensor  # (N, 3, 3)
    R_lab_body: Tensor  # (N, 3, 3), NaN where not measured
    orientation_cov_rad2: Tensor  # (N, 3, 3), of delta in R_true = exp([delta]x) R_lab_body, lab components
    segment: Tensor  # (N,) int64, number of the segment, -1 outside any
    coupling: Tensor | None = None  # (N, 3, 3), rad mm, covariance of delta (rows) with the position; None: none

    def __post_init__(self) -> None:
        shapes = [self.time_s.shape, self.segment.shape]
        for name, part in vars(self).items():
            if part is not None and name not in ("time_s", "segment"):
                tail = (3,) if name == "position_lab_mm" else (3, 3)
                check_tail(name, part, *tail)
                shapes.append(part.shape[: -len(tail)])
        if self.time_s.dim() != 1 or len(set(shapes)) > 1:
            got, do = ", ".join(str(tuple(shape)) for shape in shapes), "give all the same frames"
            raise ShapeError(refusal("smooth_motion", expected="N frames in each", got=got, do=do))


def off_middle(motion: Motion, exposure_s: float) -> tuple[Tensor, Tensor]:
    """Return the deviation of poses in pictures from those in the middle of the exposure: displacements (..., N, 3),
    mm, and rotations (..., N, 3), rad, lab; 0 for unknown accelerations. A picture shows the mean over the exposure,
    shifted by a steady acceleration times the squared exposure over 24.
    """
    share = exposure_s**2 / 24
    return 1e3 * share * motion.acceleration_m_s2.nan_to_num(), share * motion.alpha_lab_rad_s2.nan_to_num()


def in_middle(smoothed: Smoothed, exposure_s: float) -> tuple[Smoothed, Tensor]:
    """Return smoothed poses in the middle of the exposure, and the subtracted displacement, (..., N, 3), mm."""
    move_mm, turn = off_middle(smoothed, exposure_s)
    back = so3.exp(-turn)
    middle = replace(
        smoothed,
        position_lab_mm=smoothed.position_lab_mm - move_mm,
        R_lab_body=back @ smoothed.R_lab_body,
        R_given_path=back @ smoothed.R_given_path,
    )
    return middle, move_mm


def smooth_motion(measured: MeasuredPoses, settings: SmoothSettings, known: ProcessNoise | None = None) -> Smoothed:
    """Smooth a track, segment by segment, and take its derivatives; the result is on the CPU.
    Velocity and omega_lab are a constant plus a stationary random process, estimated from the whole track unless
    `known`, with one factor on the sigmas. Orientations are smoothed conditionally on the smoothed positions, as their
    errors are correlated (`coupling`). There is no lag; ends are included, gaps inside a segment filled, outliers
    rejected. A segment of one measured frame has no derivatives, of two no accelerations; a track too short for the
    estimation has no derivatives. Raises ShapeError (times that do not increase).
    Source: Gaussian-process smoother: Sarkka and Solin 2019, Applied Stochastic Differential Equations, chapter 12; on
    SO(3): Barfoot 2017, State Estimation for Robotics, chapters 7 and 8.
    """
    given = {name: part.detach().cpu().numpy() for name, part in vars(measured).items() if part is not None}
    numbers, coupling = given.pop("segment"), given.pop("coupling", None)
    t, X, X_cov, R, R_cov = (part.astype(np.float64) for part in given.values())
    segments, frame_s = _segments(t, numbers)
    seen_X = np.isfinite(X).all(1) & np.isfinite(X_cov).all((1, 2))
    seen_R = np.isfinite(R).all((1, 2)) & np.isfinite(R_cov).all((1, 2))
    square = ("position_cov_mm2", "orientation_cov_rad2", "R_lab_body")
    out = {one.name: np.full_like(R if one.name in square else X, np.nan) for one in fields(Motion)}
    rejected, by_path = np.zeros(len(t), dtype=bool), np.zeros_like(R)
    prior = known.at(frame_s) if known else (None, None)
    bands = [hz and hz * frame_s for hz in (settings.position_band_hz, settings.orientation_band_hz)]
    found, position_scale, place = _estimates(SegmentTrack, (X, X_cov, seen_X), segments, bands[0], settings, prior[0])
    for rows, at in found:
        _put_places(out, rows, at, frame_s)
        rejected[rows] |= at.rejected
    if coupling is not None:
        off, path_cov = out["position_lab_mm"] - X, out["position_cov_mm2"]
        posed = np.flatnonzero(seen_X & seen_R & ~rejected & np.isfinite(off).all(1))
        posed = posed[mahalanobis2(off[posed], X_cov[posed]) < ON_PATH**2]
        # A shift of paint in the picture is a rotation or a displacement of the sphere. Only the limb separates them,
        # and the path determines the displacement better than the limb of one frame.
        gain = coupling[posed] @ np.linalg.inv(X_cov[posed])
        R[posed] = rotation_of((gain @ off[posed, :, None])[..., 0]) @ R[posed]
        R_cov[posed] -= gain @ coupling[posed].mT
        by_path[posed] = gain @ path_cov[posed] @ gain.mT
    poses = R, R_cov, seen_R
    found, orientation_scale, turn = _estimates(RotationTrack, poses, segments, bands[1], settings, prior[1])
    for rows, at in found:
        _put_turns(out, rows, at, frame_s)
        rejected[rows] |= at.rejected
    # The path's error lasts: it is common to neighbours and frames between them.
    shared = np.abs(by_path).sum((1, 2)) > 0
    usual = by_path[shared].mean(0) if shared.any() else np.zeros((3, 3))
    out["orientation_cov_rad2"] += np.where(shared[:, None, None], by_path, usual)
    out |= {"R_given_path": R, "cov_given_path_rad2": R_cov * orientation_scale**2 + by_path}
    marks = {"extrapolated": (numbers >= 0) & ~(seen_X & seen_R), "rejected": rejected}
    return Smoothed(
        **{name: torch.from_numpy(value) for name, value in (out | marks).items()},
        position_scale=position_scale,
        orientation_scale=orientation_scale,
        process=ProcessNoise(place=place, turn=turn, frame_s=frame_s),
    )


def _segments(time_s: Floats, numbers: Rows) -> tuple[list[tuple[Rows, Floats]], float]:
    """Return rows and times, frames, of each segment, and the usual duration of a frame, s."""
    steps = np.diff(time_s)[(numbers[1:] == numbers[:-1]) & (numbers[1:] >= 0)]
    frame_s = float(np.median(steps)) if len(steps) else 1.0
    rows = [np.flatnonzero(numbers == n) for n in np.unique(numbers[numbers >= 0])]
    if any((np.diff(time_s[k]) <= 0).any() for k in rows):
        do = "sort the frames"
        raise ShapeError(refusal("time_s", expected="times that increase within a segment", got="others", do=do))
    return [(k, time_s[k] / frame_s) for k in rows], frame_s


def _estimates(
    kind: type[SegmentTrack],
    poses: tuple[Floats, Floats, Bools],
    segments: Sequence[tuple[Rows, Floats]],
    band: float | None,
    settings: SmoothSettings,
    known: ProcessPrior | None,
) -> tuple[list[tuple[Rows, Estimate]], float, ProcessPrior | None]:
    """Return rows and estimate of each segment, the scale of the sigmas and the process, from positions or
    orientations: values, covariances, and whether measured, (N, ...) each; `band` in cycles per frame.
    """
    values, covariance, seen = poses
    instants = [_Instants.of(rows, time, seen[rows]) for rows, time in segments if seen[rows].any()]
    paths = [kind.of(at.time, at.spread(values), at.spread(covariance), at.used) for at in instants]
    estimates, scale, process = estimate(paths, band, settings, known)
    return [(at.rows, at.take(found)) for at, found in zip(instants, estimates, strict=True)], scale, process


def lasting_share(apart: Tensor, covariance: Tensor, segment: Tensor, assumed: float) -> float:
    """Return the share of the variance of cameras' disagreements that lasts over frames, at least the assumed one.
    `apart` (N, P, 3): rotations between orientations by P pairs of cameras, covariance (N, P, 3, 3); NaN: missing.
    """
    there = torch.isfinite(apart).all(-1) & torch.isfinite(covariance).all((-1, -2)) & (segment >= 0)[:, None]
    unit = torch.eye(3, dtype=covariance.dtype)
    # A picture with few used pixels may have no full covariance.
    factor, failed = torch.linalg.cholesky_ex(torch.where(there[..., None, None], covariance, unit))
    there = there & (failed == 0)
    factor = torch.where(there[..., None, None], factor, unit)
    z = torch.linalg.solve(factor, apart.nan_to_num()[..., None])[..., 0].clamp(-CLIP, CLIP)
    shared, both = z.new_zeros(()), 0
    for lag in range(1, LAGS + 1):
        pair = there[lag:] & there[:-lag] & (segment[lag:] == segment[:-lag])[:, None]
        shared = shared + (z[lag:] * z[:-lag]).sum(-1)[pair].sum()
        both += int(pair.sum())
    variance = z[there].square().sum(-1).mean() if both else z.new_ones(())
    found = float(shared / variance) + LAGS * AS_MANY * assumed
    return min(max(found / (both + LAGS * AS_MANY), assumed), MOST_LASTING)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Instants:
    """Rows of one segment, and its instants: its frames, and others inside long steps."""

    rows: Rows  # (n,), of the track
    frames: Rows  # (n,), which of the instants are frames
    time: Floats  # (M,), frames
    used: Bools  # (M,), instants with a measurement

    @classmethod
    def of(cls, rows: Rows, time: Floats, seen: Bools) -> Self:
        """Return the instants of a segment's frames, times (n,) in frames."""
        more = (np.ceil(np.diff(time) / LONGEST_STEP) - 1).clip(0, MOST_BETWEEN).astype(np.int64)
        frames = np.arange(len(time)) + np.concatenate([[0], np.cumsum(more)])
        instants = np.interp(np.arange(frames[-1] + 1), frames, time)
        used = np.zeros(len(instants), dtype=bool)
        used[frames] = seen
        return cls(rows=rows, frames=frames, time=instants, used=used)

    def spread(self, values: Floats) -> Floats:
        """Return the values of the track at the instants, 0 or a unit matrix if not measured."""
        neutral = np.zeros(3) if values.ndim == 2 else np.eye(3)
        out = np.broadcast_to(neutral, (len(self.time), *neutral.shape)).copy()
        out[self.used] = values[self.rows][self.used[self.frames]]
        return out

    def take(self, found: Estimate) -> Estimate:
        return Estimate(**{entry.name: getattr(found, entry.name)[self.frames] for entry in fields(Estimate)})


def _sigma(covariance: Floats) -> Floats:
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def _put_places(out: dict[str, Floats], rows: Rows, at: Estimate, frame_s: float) -> None:
    """Write the positions of one segment; mm per frame become m/s."""
    out["position_lab_mm"][rows] = at.value
    out["position_cov_mm2"][rows] = at.covariance[:, VALUE, VALUE]
    of_rates = (("velocity", "m_s", 1, SPEED, at.rate), ("acceleration", "m_s2", 2, CHANGE, at.change))
    for name, unit, power, part, values in of_rates:
        scale = M_PER_MM / frame_s**power
        out[f"{name}_{unit}"][rows] = values * scale
        out[f"{name}_sigma_{unit}"][rows] = _sigma(at.covariance[:, part, part]) * scale


def _put_turns(out: dict[str, Floats], rows: Rows, at: Estimate, frame_s: float) -> None:
    """Write the orientations of one segment; rad per frame become rad/s, in the lab and in the body."""
    R, rate, change, C = (x.copy() for x in (at.value, at.rate, at.change, at.covariance))
    lost = _sigma(C[:, VALUE, VALUE]).max(1) > LOST_RAD
    for x in (R, rate, change, C):
        x[lost] = np.nan
    out["R_lab_body"][rows] = R
    out["orientation_cov_rad2"][rows] = C[:, VALUE, VALUE]
    for name, unit, power, part, values in (("omega", "rad_s", 1, SPEED, rate), ("alpha", "rad_s2", 2, CHANGE, change)):
        scale = 1.0 / frame_s**power
        # in the body an orientation error delta rotates the vector too: R_true' x = R' (x + x cross delta)
        lever = np.cross(values[:, None, :], np.eye(3)).mT
        mixed = lever @ C[:, VALUE, part]
        whole = C[:, part, part] + lever @ C[:, VALUE, VALUE] @ lever.mT + mixed + mixed.mT
        out[f"{name}_lab_{unit}"][rows] = values * scale
        out[f"{name}_lab_sigma_{unit}"][rows] = _sigma(C[:, part, part]) * scale
        out[f"{name}_body_{unit}"][rows] = (R.mT @ values[..., None])[..., 0] * scale
        out[f"{name}_body_sigma_{unit}"][rows] = _sigma(R.mT @ whole @ R) * scale
