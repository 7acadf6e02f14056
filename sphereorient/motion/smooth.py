"""Motion from the precise track: smoothed place and orientation, their derivatives, with honest sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from torch import Tensor

from sphereorient.motion.chain import Chain, Solution, solve
from sphereorient.motion.settings import SmoothSettings
from sphereorient.motion.turning import AXES, STATES, Moving, Turning, skew

Floats = NDArray[np.float64]
Segment = Moving | Turning
S = TypeVar("S", Moving, Turning)

LEARN_FRAMES = 400  # frames of the longest segment from which the noise is learnt
ROUNDS = 2  # of learning, weighing outliers, and learning again
FAR = 16.0  # squared distance in sigmas from where on a measurement pulls no harder: a wrong frame bends nothing
LEAST_FRAMES = 5  # measured frames below which a segment has no motion: as many as the states have derivatives
BANDS = (0.004, 0.3)  # cycles per frame between which the band is looked for
STEPS = 4  # of Gauss and Newton on a segment of orientations; places need one


@dataclass(frozen=True, kw_only=True, eq=False)
class Smoothed:
    """Smoothed motion of N frames; made by `smooth_motion`, read by the pipeline. NaN where there is none."""

    position_lab_mm: Tensor  # (N, 3)
    position_cov_mm2: Tensor  # (N, 3, 3)
    velocity_m_s: Tensor  # (N, 3)
    velocity_sigma_m_s: Tensor
    acceleration_m_s2: Tensor
    acceleration_sigma_m_s2: Tensor
    R_lab_body: Tensor  # (N, 3, 3)
    orientation_cov_rad2: Tensor  # (N, 3, 3), of delta in R_true = exp([delta]x) R_lab_body
    omega_lab_rad_s: Tensor  # (N, 3)
    omega_lab_sigma_rad_s: Tensor
    omega_body_rad_s: Tensor
    omega_body_sigma_rad_s: Tensor
    alpha_lab_rad_s2: Tensor
    alpha_lab_sigma_rad_s2: Tensor
    alpha_body_rad_s2: Tensor
    alpha_body_sigma_rad_s2: Tensor
    extrapolated: Tensor  # (N,) bool, frames that have no measurement of their own
    position_scale: float  # true errors of the measured positions over their sigmas, as far as the motion tells
    orientation_scale: float  # the same of the orientations


def smooth_motion(
    time_s: Tensor,
    position_lab_mm: Tensor,
    position_cov_mm2: Tensor,
    R_lab_body: Tensor,
    orientation_cov_rad2: Tensor,
    segment: Tensor,
    settings: SmoothSettings,
) -> Smoothed:
    """Smooth a track, segment by segment.

    The motion's fifth derivative is white noise, whose strength is learnt from the track by maximum likelihood,
    together with one factor on the measurements' sigmas; orientation is exact on SO(3), whatever the turn between
    frames. Frames without a measurement inside a segment are filled and marked.

    Args:
        time_s: (N,), increasing, need not be even.
        position_lab_mm: (N, 3), NaN where not measured.
        position_cov_mm2: (N, 3, 3).
        R_lab_body: (N, 3, 3), NaN where not measured.
        orientation_cov_rad2: (N, 3, 3).
        segment: (N,) int64, -1 outside any.
        settings: of the smoother.

    Source: Gaussian-process regression as a smoother, Sarkka and Solin 2019, chapter 12; on SO(3) Barfoot 2017,
    chapter 7 (Gauss and Newton on the whole segment); Magnus 1954 for turns whose axis moves.
    """
    t = time_s.detach().cpu().double().numpy()
    frame_s = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    numbers = segment.cpu().numpy()
    parts = (position_lab_mm, position_cov_mm2, R_lab_body, orientation_cov_rad2)
    X, X_cov, R, R_cov = (part.detach().cpu().double().numpy() for part in parts)
    rows = [np.flatnonzero(numbers == n) for n in np.unique(numbers[numbers >= 0])]
    places = [Moving.of(t[k] / frame_s, X[k], X_cov[k]) for k in rows]
    turns = [Turning.of(t[k] / frame_s, R[k], R_cov[k]) for k in rows]
    out = _blank(len(t))
    moving = _learnt(places, settings.position_band_hz, frame_s)
    turning = _learnt(turns, settings.orientation_band_hz, frame_s)
    for k, place, turn in zip(rows, places, turns, strict=True):
        if place.measured.sum() >= LEAST_FRAMES:
            _put_places(out, k, *_settled(place, moving), frame_s)
        if turn.measured.sum() >= LEAST_FRAMES:
            _put_turns(out, k, *_settled(turn, turning), frame_s)
    measured = np.isfinite(X).all(1) & np.isfinite(R).all((1, 2))
    extrapolated = torch.from_numpy((numbers >= 0) & ~measured)
    tensors = {name: torch.from_numpy(value) for name, value in out.items()}
    return Smoothed(
        **tensors, extrapolated=extrapolated, position_scale=moving.whole_scale, orientation_scale=turning.whole_scale
    )


@dataclass(frozen=True, kw_only=True)
class _Noise:
    """What was learnt of one kind of track."""

    band: float  # rad per frame up to which the motion is followed
    variance: float  # of the measurements for which that holds, before `scale`
    scale: float  # errors of the measurements, as they surprise, over their sigmas
    kinship: float = 1.0  # true errors over those, see `_kinship`

    @property
    def whole_scale(self) -> float:
        """True errors of the measurements over their sigmas."""
        return self.scale * self.kinship


def _learnt(tracks: Sequence[S], band_hz: float | None, frame_s: float) -> _Noise:
    """Learn band and scale from the longest segment."""
    tracks = [track for track in tracks if track.measured.sum() > 2 * LEAST_FRAMES]
    if not tracks:
        return _Noise(band=2 * np.pi * 0.05, variance=1.0, scale=1.0)
    sample = max(tracks, key=lambda track: int(track.measured.sum())).part(LEARN_FRAMES)
    variance = float(np.nanmedian(sample.variance))
    noise = _Noise(band=2 * np.pi * (band_hz * frame_s if band_hz else 0.05), variance=variance, scale=1.0)
    looseness = np.ones(len(sample.time))
    track = sample.start()
    for _ in range(ROUNDS):
        track, _ = _fitted(track, noise, looseness)
        if band_hz is None:
            noise = replace(noise, band=_likeliest_band(track, noise, looseness))
        track, _ = _fitted(track, noise, looseness)
        noise = replace(noise, scale=_surprise(track, noise, looseness)[1])
        looseness = np.maximum(1.0, np.nan_to_num(track.misfit()) / (FAR * noise.scale**2))
    return replace(noise, kinship=_kinship(track, noise, looseness))


def _kinship(track: Segment, noise: _Noise, looseness: Floats) -> float:
    """Return by how much errors exceed those of independent ones that surprise as much.

    Neighbouring frames look alike, and so do their errors: a part of them passes for motion. It shows in the
    innovations, which would be white otherwise; a mean of errors with this correlation is so much worse.
    """
    innovation = solve(_chain(track, noise, looseness)).innovation[track.measured][STATES:]
    size = float((innovation**2).sum())
    correlation = float((innovation[1:] * innovation[:-1]).sum()) / size if size > 0 else 0.0
    correlation = min(max(correlation, 0.0), 0.8)
    return float(np.sqrt((1 + correlation) / (1 - correlation)))


def _likeliest_band(track: Segment, noise: _Noise, looseness: Floats) -> float:
    """Return the band, rad per frame, under which the measurements surprise least."""
    found = minimize_scalar(
        lambda log_band: _surprise(track, replace(noise, band=float(np.exp(log_band))), looseness)[0],
        bounds=(float(np.log(2 * np.pi * BANDS[0])), float(np.log(2 * np.pi * BANDS[1]))),
        method="bounded",
        options={"xatol": 0.03},
    )
    return float(np.exp(found.x))


def _surprise(track: Segment, noise: _Noise, looseness: Floats) -> tuple[float, float]:
    """Return the negative log-likelihood of a band, the scale at its best, and that scale."""
    solution = solve(_chain(track, noise, looseness))
    told = np.flatnonzero(track.measured)[STATES:]  # the first few only say where the motion begins
    surprise, log_determinant = (solution.innovation[told] ** 2).sum(1), solution.log_determinant[told]
    freedom = AXES * len(told)
    scale2 = max(float(surprise.sum()) / freedom, 1e-12)
    return 0.5 * (freedom * float(np.log(scale2)) + float(log_determinant.sum())), float(np.sqrt(scale2))


def _chain(track: Segment, noise: _Noise, looseness: Floats) -> Chain:
    """Return the linear problem with time in units of the band, where all derivatives are of one size."""
    return track.timed(noise.band).chain(noise.variance * noise.band, looseness)


def _fitted(track: S, noise: _Noise, looseness: Floats) -> tuple[S, Solution]:
    """Gauss and Newton from the present states, in the track's own unit of time."""
    for _ in range(STEPS if isinstance(track, Turning) else 1):
        solution = solve(_chain(track, noise, looseness))
        track = track.timed(noise.band).moved(solution.state).timed(1.0 / noise.band)
    unit = np.repeat(noise.band ** np.arange(STATES), AXES)
    return track, replace(solution, covariance=solution.covariance * unit[:, None] * unit)


def _settled(track: S, noise: _Noise) -> tuple[S, Floats]:
    """Return a segment's states and their covariances (N, D, D), measurements far off held back."""
    looseness = np.ones(len(track.time))
    track = track.start()
    for _ in range(ROUNDS):
        track, solution = _fitted(track, noise, looseness)
        looseness = np.maximum(1.0, np.nan_to_num(track.misfit()) / (FAR * noise.scale**2))
    return track, solution.covariance * noise.whole_scale**2


def _blank(frames: int) -> dict[str, Floats]:
    """Every dataset before anything is known."""
    out = {}
    for entry in fields(Smoothed):
        if entry.name.endswith("_scale") or entry.name == "extrapolated":
            continue
        square = entry.name in ("position_cov_mm2", "orientation_cov_rad2", "R_lab_body")
        out[entry.name] = np.full((frames, 3, 3) if square else (frames, 3), np.nan)
    return out


def _sigma(covariance: Floats) -> Floats:
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def _put_places(
    out: dict[str, Floats], rows: NDArray[np.int64], track: Moving, covariance: Floats, frame_s: float
) -> None:
    """Write one segment's places; mm per frame become m/s."""
    first, second = 1e-3 / frame_s, 1e-3 / frame_s**2
    out["position_lab_mm"][rows] = track.state[:, :3]
    out["position_cov_mm2"][rows] = covariance[:, :3, :3]
    out["velocity_m_s"][rows] = track.state[:, 3:6] * first
    out["velocity_sigma_m_s"][rows] = _sigma(covariance[:, 3:6, 3:6]) * first
    out["acceleration_m_s2"][rows] = track.state[:, 6:9] * second
    out["acceleration_sigma_m_s2"][rows] = _sigma(covariance[:, 6:9, 6:9]) * second


def _put_turns(
    out: dict[str, Floats], rows: NDArray[np.int64], track: Turning, covariance: Floats, frame_s: float
) -> None:
    """Write one segment's orientations, turns per frame become rad/s, in the lab and in the body."""
    to_body = track.R.swapaxes(1, 2)
    out["R_lab_body"][rows] = track.R
    out["orientation_cov_rad2"][rows] = covariance[:, :3, :3]
    for name, unit, at in (("omega", "rad_s", 3), ("alpha", "rad_s2", 6)):
        value, part = track.rates[:, at - 3 : at] / frame_s ** (at // 3), covariance[:, at : at + 3, at : at + 3]
        scale = 1.0 / frame_s ** (at // 3)
        # In the body, an error of the orientation turns the vector as well.
        mixed = np.concatenate([skew(value / scale), np.tile(np.eye(3), (len(rows), 1, 1))], axis=2)
        pick = np.r_[0:3, at : at + 3]
        both = mixed @ covariance[:, pick][:, :, pick] @ mixed.swapaxes(1, 2)
        out[f"{name}_lab_{unit}"][rows] = value
        out[f"{name}_lab_sigma_{unit}"][rows] = _sigma(part) * scale
        out[f"{name}_body_{unit}"][rows] = (to_body @ value[..., None])[..., 0]
        out[f"{name}_body_sigma_{unit}"][rows] = _sigma(to_body @ both @ track.R) * scale
