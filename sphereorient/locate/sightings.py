"""The sphere in a frame, and along time: outliers are replaced by a spline, short gaps interpolated."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_lsq_spline, make_smoothing_spline
from scipy.ndimage import median_filter
from torch import Tensor

from sphereorient.errors import ExperimentError, Flag, Reason, ShapeError, refusal
from sphereorient.locate.background import Background, saturated
from sphereorient.locate.outline import Blob, Floats, Levels, Mask, Outline, find_blobs, fit_outline, window_about
from sphereorient.locate.settings import LocateSettings

DEGREE = 3  # of the spline
FEWEST, BESIDE, OUTLYING = 12, 7, 5.0  # least number of places; frames of a median; deviations of outliers
HELD_EVERY = 5  # every n-th place is held out
STIFFNESSES = [10.0**k for k in range(-3, 7)]  # tried weights of the path's bend, frames^3
Found = tuple[Outline | None, Reason]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sightings:
    """Outlines of the sphere in N frames of one camera; NaN if neither found nor interpolated."""

    centre_px: Tensor  # (N, 2) float64, (u, v)
    radius_px: Tensor  # (N,) float64
    outline_rms_px: Tensor  # (N,) float64, distance of edges from the circle, NaN if not measured in the frame
    coverage: Tensor  # (N,) float64, share of directions with an edge
    covariance_px2: Tensor  # (N, 3, 3) float64, of (u, v, radius), NaN if not measured in the frame
    flags: Tensor  # (N,) int64, POSITION_INTERPOLATED and POSITION_OUTLIER_REPLACED
    reason: tuple[Reason, ...]  # N; Reason.OK if measured

    def __post_init__(self) -> None:
        parts = (self.centre_px, self.radius_px, self.outline_rms_px, self.coverage, self.covariance_px2)
        lengths = {len(part) for part in parts}
        if lengths | {len(self.flags), len(self.reason)} != {len(self.reason)}:
            got = f"parts of {sorted(lengths)}, {len(self.flags)} flags, {len(self.reason)} reasons"
            raise ShapeError(refusal("Sightings", expected="one row a frame", got=got, do="pass equal lengths"))

    def __len__(self) -> int:
        return len(self.reason)

    @property
    def placed(self) -> Tensor:
        """Frames with a centre, measured or interpolated, (N,) bool."""
        return torch.isfinite(self.radius_px)


def check_seen(sightings: Mapping[str, Sightings]) -> None:
    """Raise ExperimentError, with the frames' reasons, if no camera found the sphere in any frame."""
    if any(bool(seen.placed.any()) for seen in sightings.values()):
        return
    reasons = ", ".join(sorted({str(why) for seen in sightings.values() for why in seen.reason}))
    do = "check sphere.diameter and the cameras, or set locate.diameter_px"
    raise ExperimentError(refusal("movies", expected="the sphere in some frame", got=f"none ({reasons})", do=do))


def size_of(sightings: Sightings, size_px: int | None) -> int:
    """Return the side of the normalised disks, px: the setting, or the movie's median diameter."""
    if size_px is not None:
        return size_px
    return max(16, round(2 * float(sightings.radius_px[sightings.placed].median())))


def find_ball(
    frame: NDArray[np.generic], background: Background, diameter_px: float, settings: LocateSettings
) -> Found:
    """Return the outline in a frame (H, W) and `OK`, or None and `NOT_FOUND`, `OUTLINE`, `DARK` or `SATURATED`.
    Source: paper section III A.
    """
    difference = background.difference(frame)
    blobs = find_blobs(difference, background.noise, diameter_px, settings)
    return ball_at(blobs, difference, frame, background, diameter_px, settings)


def ball_at(
    blobs: Sequence[Blob],
    difference: Levels,
    frame: NDArray[np.generic],
    background: Background,
    diameter_px: float,
    settings: LocateSettings,
) -> Found:
    """Return the outline of a blob, best first, of a frame (H, W) and its `difference` from the background."""
    best: Outline | None = None
    likeliest = (False, 0.0)  # painted and supported ones first, then the largest coverage
    for blob in blobs:
        outline = fit_outline(difference, background.typical_noise, blob, diameter_px, settings, background.shown)
        if outline is not None:
            likely = (outline.painted and outline.coverage >= settings.coverage_min, outline.coverage)
            if best is None or likely > likeliest:
                best, likeliest = outline, likely
        # Usually the first blob; others only if its rim is incomplete.
        if best is not None and best.painted and best.coverage >= max(settings.coverage_min, 0.5):
            break
    contrast_min = settings.contrast_min * background.full_scale / 255
    if best is None or best.coverage < settings.coverage_min:
        if not blobs or blobs[0].merit <= 0:
            return None, Reason.NOT_FOUND
        around = window_about(blobs[0].u_px, blobs[0].v_px, int(0.5 * diameter_px))
        return None, Reason.DARK if np.percentile(difference[around], 90) < contrast_min else Reason.OUTLINE
    height, width = frame.shape
    u, v = min(max(round(best.u_px), 0), width - 1), min(max(round(best.v_px), 0), height - 1)
    inside = window_about(u, v, int(0.7 * best.radius_px))
    if np.percentile(difference[inside], 90) < contrast_min:
        return None, Reason.DARK
    if saturated(frame[inside], background) > settings.saturated_share:
        return None, Reason.SATURATED
    return best, Reason.OK


def sightings_of(found: Iterable[Found]) -> Sightings:
    """Collect the results of `find_ball` in consecutive frames."""
    rows = list(found)
    names = ("u_px", "v_px", "radius_px", "rms_px", "coverage")
    values = [[getattr(outline, name, torch.nan) for name in names] for outline, _ in rows]
    table = torch.tensor(values, dtype=torch.float64).reshape(-1, len(names))
    spread = [np.full((3, 3), np.nan) if outline is None else outline.spread for outline, _ in rows]
    return Sightings(
        centre_px=table[:, :2],
        radius_px=table[:, 2],
        outline_rms_px=table[:, 3],
        coverage=table[:, 4],
        covariance_px2=torch.tensor(np.array(spread).reshape(-1, 3, 3)) * table[:, 3, None, None].square(),
        flags=torch.zeros(len(rows), dtype=torch.int64),
        reason=tuple(reason for _, reason in rows),
    )


def fill_gaps(sightings: Sightings, settings: LocateSettings) -> Sightings:
    """Replace outliers by a least-squares spline and fill short gaps, with flags and without rms; longer gaps stay NaN.
    Source: paper section III A.
    """
    track = np.column_stack([sightings.centre_px.numpy(), sightings.radius_px.numpy()])
    flags = sightings.flags.clone()
    rms, covariance = sightings.outline_rms_px.clone(), sightings.covariance_px2.clone()
    for stretch in known_stretches(np.isfinite(track[:, 2]), settings.gap_frames_max):
        known = stretch[np.isfinite(track[stretch, 2])]
        spline, outlier = robust_spline(known, track[known], settings)
        track[known[outlier]] = spline[outlier]
        flags[known[outlier]] |= int(Flag.POSITION_OUTLIER_REPLACED)
        rms[known[outlier]] = covariance[known[outlier]] = torch.nan
        missing = np.setdiff1d(stretch, known)
        if len(missing):
            track[missing] = PchipInterpolator(known, track[known], axis=0)(missing)
            flags[missing] |= int(Flag.POSITION_INTERPOLATED)
    replaced = (flags & int(Flag.POSITION_OUTLIER_REPLACED)).tolist()
    reason = tuple(Reason.OUTLINE if now else why for now, why in zip(replaced, sightings.reason, strict=True))
    centre_px, radius_px = (torch.from_numpy(part.copy()) for part in (track[:, :2], track[:, 2]))
    places = replace(sightings, centre_px=centre_px, radius_px=radius_px)
    return replace(places, outline_rms_px=rms, covariance_px2=covariance, flags=flags, reason=reason)


def smoothed(sightings: Sightings, settings: LocateSettings) -> Sightings:
    """Return the outlines without outliers, smoothed, with short gaps filled, without flags. The smoothness is the one
    that predicts every fifth place best from the others.
    """
    track = np.column_stack([sightings.centre_px.numpy(), sightings.radius_px.numpy()])
    known = np.flatnonzero(np.isfinite(track[:, 2]))
    if len(known) < FEWEST:
        return sightings
    away = np.abs(track[known] - median_filter(track[known], (BESIDE, 1), mode="nearest"))
    good = known[(away <= OUTLYING * 1.4826 * np.median(away, axis=0) + 1e-9).all(1)]
    near = np.concatenate(known_stretches(np.isfinite(track[:, 2]), settings.gap_frames_max))
    smooth = np.full(track.shape, np.nan)
    smooth[near] = _likely_path(good, track[good])(near)
    centre_px, radius_px = (torch.from_numpy(part.copy()) for part in (smooth[:, :2], smooth[:, 2]))
    return replace(sightings, centre_px=centre_px, radius_px=radius_px)


def _likely_path(frame: NDArray[np.int64], value: Floats) -> Callable[..., Floats]:
    """Return the smoothing spline of values (n, D) at frames (n,) that best predicts held-out values."""
    x = frame.astype(float)

    def through(some: Mask, stiffness: float) -> Callable[..., Floats]:
        each = [make_smoothing_spline(x[some], one[some], lam=stiffness) for one in value.T]
        return lambda at: np.column_stack([one(at) for one in each])

    held = np.arange(len(frame)) % HELD_EVERY == HELD_EVERY // 2
    off = [float(np.abs(through(~held, one)(x[held]) - value[held]).sum()) for one in STIFFNESSES]
    return through(np.ones(len(frame), bool), STIFFNESSES[int(np.argmin(off))])


def known_stretches(known: Mask, gap_frames_max: int) -> list[NDArray[np.int64]]:
    """Return runs of frame numbers with gaps of at most `gap_frames_max`; the ends are known frames."""
    at = np.flatnonzero(known)
    if not len(at):
        return []
    parts = np.split(at, np.flatnonzero(np.diff(at) > gap_frames_max + 1) + 1)
    return [np.arange(part[0], part[-1] + 1) for part in parts]


def robust_spline(frame: NDArray[np.int64], value: Floats, settings: LocateSettings) -> tuple[Floats, Mask]:
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


def _spline(x: NDArray[np.int64], y: Floats, spacing: int):  # type: ignore[no-untyped-def]
    inner = np.arange(x[0] + spacing, x[-1] - spacing / 2, spacing, dtype=float)
    counts = np.histogram(x, np.concatenate([[x[0]], inner, [x[-1] + 1]]))[0]
    # Schoenberg and Whitney: each knot needs data nearby.
    inner = inner[(counts[:-1] >= DEGREE + 1) & (counts[1:] >= DEGREE + 1)]
    knots = np.concatenate([[x[0]] * (DEGREE + 1), inner, [x[-1]] * (DEGREE + 1)]).astype(float)
    return make_lsq_spline(x.astype(float), y, knots, k=DEGREE)
