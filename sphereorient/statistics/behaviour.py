"""Behaviour of an animal on a ball: gain, drift, heading and path of a track against truth or another tracker."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import ShapeError, refusal
from sphereorient.statistics.bootstrap import Floats, Interval, Rows, bootstrap, segment_sums
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.rotations import nearest_rotations, rotation_vectors
from sphereorient.trajectory.walk import arcs, walk_of

Mask = NDArray[np.bool_]
ABOUT = ("x", "y", "z", "along the rotation")  # the gains
PER_BLOCK = 10  # least frames; a block should be longer than the correlation of errors
FEWEST_BLOCKS, GAIN_BLOCKS, DRIFT_BLOCKS = 8, 40, 30
GAP = 1.5  # usual times between frames
ONE_AXIS = 1e-3  # share of the squared rotations about the second axis, below which lab axes cannot be aligned
CORRELATIONS = np.append(np.linspace(0.0, 0.95, 20), [0.98, 0.995, 0.999])  # of neighbouring blocks


@dataclass(frozen=True, kw_only=True, eq=False)
class Behaviour:
    """Gain, drift and walk of a track against a reference. NaN: unknown, by `reason`. Axes: lab x, y, z; gains have a
    fourth entry, all axes together.
    """

    frames: int  # with an orientation in both
    pairs: int  # of neighbouring frames with an orientation in both
    gain: Interval  # (4,), 95 %
    gain_bounds: Floats  # (2, 4), for a reference with errors: regression on it, inverse of its regression
    gain_smooth: Interval | None  # (4,), of the smoothed orientations; None: there are none
    drift_deg_min: Floats  # (3,), degrees a minute
    drift_sigma_deg_min: Floats  # (3,), its standard error
    apart_deg: float  # angle between the lab axes of the two, by the rotations
    heading_rad: float  # heading at the end less the reference's; NaN, as the next two, if the ball moves
    length_ratio: float  # length of the path over that of the reference
    end_share: float  # distance between the ends of the paths over the reference's length
    reason: str

    def columns(self) -> dict[str, Any]:
        """Return a row for each gain, by names of columns with their units, for tables."""
        unknown = Interval(**dict.fromkeys(("value", "low", "high", "error"), np.full(4, np.nan)))
        drift, sigma = (np.append(part, np.nan) for part in (self.drift_deg_min, self.drift_sigma_deg_min))
        return {
            "about": list(ABOUT),
            "gain": self.gain,
            "gain_smooth": unknown if self.gain_smooth is None else self.gain_smooth,
            "drift_deg_min": drift,
            "drift_sigma_deg_min": sigma,
            "heading_rad": self.heading_rad,
            "length_ratio": self.length_ratio,
            "end_share": self.end_share,
            "reason": self.reason,
        }

    def numbers(self) -> dict[str, Any]:
        """Return all values as numbers, lists and texts, for JSON."""

        def listed(of: Interval) -> dict[str, Any]:
            names = {"value": of.value, "low": of.low, "high": of.high, "sigma": of.error}
            return {name: part.tolist() for name, part in names.items()}

        plain = {name: part.tolist() if isinstance(part, np.ndarray) else part for name, part in vars(self).items()}
        smooth = None if self.gain_smooth is None else listed(self.gain_smooth)
        return {"about": list(ABOUT), **plain, "gain": listed(self.gain), "gain_smooth": smooth}


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """Orientations to compare a track of N frames with, at its times; NaN: none in this frame."""

    R_lab_body: Floats  # (N, 3, 3)
    start: Mask | None = None  # (N,), frames in which another tracker restarted; None: never
    exact: bool = True  # the truth; else by another tracker
    held: bool = False  # whether its ball is known to stay in its place


def behaviour_of(track: Trajectory, reference: Reference, align: bool = False) -> Behaviour:
    """Compare the orientations of a track, measured and smoothed, with a reference's. A constant rotation of the body
    axes is removed, with `align` also one of the lab axes: the axes are those of an `exact` reference, else of the
    track. A gain is the regression through zero of the track's rotations on those of an exact reference, else the
    geometric mean of the two regressions. A walk needs a fixed ball. Raises ShapeError: not the same number of frames.
    Source: docs/accuracy.md, Behaviour.
    """
    frames, time_s = len(track), track.time
    begins = np.zeros(frames, bool) if reference.start is None else reference.start
    if not frames == len(reference.R_lab_body) == len(begins):
        got, do = f"{len(reference.R_lab_body)} and {len(begins)}", "give the reference at the times of the track"
        raise ShapeError(refusal("reference", expected=f"{frames} orientations and starts", got=got, do=do))
    R, R_true = track.orientation, reference.R_lab_body
    known: Mask = np.asarray(np.isfinite(R + R_true).all(axis=(1, 2)))
    step_s = np.diff(time_s)
    usual_s = float(np.median(step_s)) if frames > 1 else np.inf
    linked = known[1:] & known[:-1] & ~begins[1:] & (step_s <= GAP * usual_s)
    ours, theirs, smooth = (_turns(of)[linked] for of in (R, R_true, track.orientation_smooth))
    A, second = _lab_axes(ours, theirs)
    sure = second > ONE_AXIS
    reason = _why_not(int(linked.sum()), sure or not align)
    left = A if align and sure else np.eye(3)
    of_track, of_reference = (left.T, np.eye(3)) if reference.exact else (np.eye(3), left)
    R, R_true = of_track @ R, of_reference @ R_true
    ours, theirs, smooth = ours @ of_track.T, theirs @ of_reference.T, smooth @ of_track.T
    gain, bounds = _gain(ours, theirs, ours, reference.exact, reason)
    there = np.isfinite(smooth).all(1)
    again = reason or _why_not(int(there.sum()), True)
    gain_smooth = _gain(ours[there], theirs[there], smooth[there], reference.exact, again)[0]
    drift, sigma = _drift(time_s[known], R[known], R_true[known], np.cumsum(begins)[known], reason)
    walk = (
        _walk(time_s, R, R_true, known & ~begins)
        if (track.held or reference.held) and (sure or not align)
        else (np.nan,) * 3
    )
    return Behaviour(
        frames=int(known.sum()),
        pairs=int(linked.sum()),
        gain=gain,
        gain_bounds=bounds,
        gain_smooth=gain_smooth if there.any() else None,
        drift_deg_min=drift,
        drift_sigma_deg_min=sigma,
        apart_deg=float(np.rad2deg(np.linalg.norm(rotation_vectors(A[None])))) if sure else np.nan,
        heading_rad=walk[0],
        length_ratio=walk[1],
        end_share=walk[2],
        reason=reason,
    )


def _turns(R: Floats) -> Floats:
    """Return the rotation vectors (N - 1, 3), rad, lab, from each frame (N, 3, 3) to the next."""
    return rotation_vectors(R[1:] @ R[:-1].mT)


def _why_not(pairs: int, sure: bool) -> str:
    if pairs < FEWEST_BLOCKS * PER_BLOCK:
        return f"{pairs} pairs of neighbouring frames in both, at least {FEWEST_BLOCKS * PER_BLOCK} needed"
    return "" if sure else "the ball rotates about one axis only: the lab axes cannot be aligned"


def _lab_axes(ours: Floats, theirs: Floats) -> tuple[Floats, float]:
    """Return the rotation A from the reference's rotations (P, 3) to the track's by least squares, and the share of the
    second axis in their squares. Rotations have neither drift nor body axes.
    Source: Kabsch 1976, Acta Cryst. A32, 922.
    """
    U, size, Vt = np.linalg.svd(ours.T @ theirs)
    A = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return A, float(size[1] / size[0]) if size[0] > 0 else 0.0


def _gain(ours: Floats, theirs: Floats, of: Floats, exact: bool, reason: str) -> tuple[Interval, Floats]:
    """Return the gains (4,) of rotations `of` (P, 3), the track's or smoothed, with intervals from blocks, and the two
    regressions (2, 4) of the track's. Smoothing changes only the product with the reference.
    """
    if reason:
        unknown = np.full(4, np.nan)
        return Interval(value=unknown, low=unknown, high=unknown, error=unknown), np.full((2, 4), np.nan)
    products = np.stack([ours * theirs, theirs**2, ours**2, of * theirs], axis=1)
    products = np.concatenate([products, products.sum(2, keepdims=True)], axis=2)  # (P, 4, 4)
    blocks = min(len(ours) // PER_BLOCK, GAIN_BLOCKS)
    sums = segment_sums(products, np.arange(len(ours)) * blocks // len(ours), blocks)

    @np.errstate(all="ignore")
    def gain(totals: Floats) -> Floats:
        ab, bb, aa, sb = np.moveaxis(totals, -2, 0)
        return np.asarray(sb / np.where(bb > 0, bb if exact else np.abs(ab) * np.sqrt(bb / aa), np.nan), np.float64)

    ab, bb, aa, _ = sums.sum(0)
    with np.errstate(all="ignore"):
        return bootstrap(sums, gain, BootstrapSettings()), np.stack([ab / bb, aa / ab])


def _drift(time_s: Floats, R: Floats, R_reference: Floats, stretch: Rows, reason: str) -> tuple[Floats, Floats]:
    """Return the drift (3,) of orientations (K, 3, 3), degrees a minute, and its standard error. Errors are modelled as
    d t + c + R b: the drift, and constants in the lab and in the body, for each `stretch` (K,) of the reference.
    """
    if reason:
        return np.full(3, np.nan), np.full(3, np.nan)
    first, of = np.unique(stretch, return_index=True, return_inverse=True)[1:]
    error = _errors(R, R_reference, first, of)[..., None]
    along, lab = (time_s - time_s.mean())[:, None, None] / np.ptp(time_s), np.broadcast_to(np.eye(3), R.shape)
    both = np.concatenate([lab, R], axis=2)
    # b = 0 with the weight of one frame: for a ball that does not rotate, c and b are the same.
    square = segment_sums(both.mT @ both, of, len(first)) + np.diag([0.0] * 3 + [1.0] * 3)

    def constants(vectors: Floats) -> Floats:
        return np.asarray(
            both @ np.linalg.solve(square, segment_sums(both.mT @ vectors, of, len(first)))[of], np.float64
        )

    rest = along * (along * lab - constants(along * lab))
    inverse = np.linalg.inv(rest.sum(0))
    drift = inverse @ (along * (error - constants(error))).sum(0)
    slope, sigma = _slope(time_s, (error - constants(error - along * drift))[..., 0])
    # If the ball rotates little about an axis, a drift about it may be a constant in the body.
    worse = np.sqrt(np.maximum(inverse.diagonal() * np.square(along).sum(), 1.0))
    return np.rad2deg(slope) * 60, np.rad2deg(sigma * worse) * 60


def _errors(R: Floats, R_reference: Floats, first: Rows, of: Rows) -> Floats:
    """Return the rotation vectors (K, 3), rad, lab, from the reference (K, 3, 3), in the body axes of R by the first
    frames of each stretch, to R; they may exceed half a turn. `first` (S,): where a stretch begins; `of` (K,).
    """
    early = np.arange(len(R)) - first[of] < PER_BLOCK
    body = nearest_rotations(segment_sums((R_reference.mT @ R)[early], of[early], len(first)))
    E = R @ (R_reference @ body[of]).mT
    error = rotation_vectors(E)
    # The branch of the rotation vector nearest to the sum of the changes, which itself accumulates noise.
    change = np.concatenate([error[:1], _turns(E)])
    change[first] = error[first]
    rough = np.cumsum(change, axis=0)
    rough -= (rough - change)[first][of]
    angle = np.linalg.norm(error, axis=1, keepdims=True)
    axis = error / np.where(angle > 0, angle, 1.0)
    along = (rough * axis).sum(1, keepdims=True)
    return np.asarray((angle + 2 * np.pi * np.round((along - angle) / (2 * np.pi))) * axis, np.float64)


def _slope(time_s: Floats, error: Floats) -> tuple[Floats, Floats]:
    """Return slope (3,) and standard error of errors (K, 3) over time, by least squares on block means with errors
    correlated as rho^distance, rho by the restricted likelihood: from independent blocks to nearly a random walk.
    Source: Patterson and Thompson 1971, Biometrika 58, 545.
    """
    blocks = min(len(time_s) // PER_BLOCK, DRIFT_BLOCKS)
    of = np.arange(len(time_s)) * blocks // len(time_s)
    means = segment_sums(np.column_stack([time_s, error]), of, blocks) / np.bincount(of)[:, None]
    usual_s = np.diff(means[:, 0]).mean()
    at, y = (means[:, 0] - means[:, 0].mean()) / usual_s, means[:, 1:]
    X, freedom = np.stack([np.ones(blocks), at], axis=1), blocks - 2
    V = CORRELATIONS[:, None, None] ** np.abs(at[:, None] - at)  # (C, M, M)
    VX = np.linalg.solve(V, np.broadcast_to(X, (len(V), blocks, 2)))
    inverse = np.linalg.inv(X.T @ VX)
    fitted = inverse @ (VX.mT @ y)  # (C, 2, 3)
    rest = y - X @ fitted
    square = np.maximum((rest * np.linalg.solve(V, rest)).sum(1) / freedom, np.finfo(np.float64).tiny)  # (C, 3)
    size = np.linalg.slogdet(V)[1] - np.linalg.slogdet(inverse)[1]
    best = (size[:, None] + freedom * np.log(square)).argmin(0), np.arange(3)
    slope, sigma = fitted[:, 1][best], np.sqrt(square * inverse[:, 1, 1, None])[best]
    return slope / usual_s, sigma / usual_s


def _walk(time_s: Floats, R: Floats, R_reference: Floats, use: Mask) -> tuple[float, float, float]:
    """Return difference of headings, rad, ratio of lengths, and end distance over length, summed over stretches."""
    masked = [np.where(use[:, None, None], one, np.nan) for one in (R, R_reference)]
    ours, theirs = (walk_of(time_s, one) for one in masked)
    turns = [arcs(one.turn_rad) for one in (ours, theirs)]
    about, length = (
        [float(np.nansum(part)) for part in parts]
        for parts in ([turn[2] for turn in turns], [np.hypot(turn[0], turn[1]) for turn in turns])
    )
    last = use & ~np.append(use[1:], False)
    apart = float(np.linalg.norm(ours.path[last] - theirs.path[last], axis=1).sum())
    if not length[1] > 0:
        return np.nan, np.nan, np.nan
    return about[0] - about[1], length[0] / length[1], apart / length[1]
