"""One kind of track, positions or orientations: estimate its process, reject outliers, smooth every segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sphereorient.motion.kalman import SmoothedStates, run_filter, smooth
from sphereorient.motion.learn import ProcessPrior, estimate_process
from sphereorient.motion.path import DELTA, MEAN, SIZE, SegmentTrack
from sphereorient.motion.settings import SmoothSettings

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

ITERATIONS = 8  # of Gauss and Newton at most between two rejections; two or three do
SETTLED = 0.03  # of a measurement's sigma: convergence is quadratic, so the next step is negligible
PIECE = 200  # instants of a piece, many times the memory of the motion
FEWEST = 5  # measurements of a piece
NEAR = 5  # frames over which a wrong measurement makes others look wrong
ROUNDS = 3  # of estimation
JUDGEMENTS = 12  # rounds of rejection; outliers near each other are found one after the other
AGAIN = 0.5  # of the limit, below which a measurement is used again; below 1 to avoid oscillation
FAR_MOVED = 100.0  # sigmas; after a larger move of the reference the estimate is repeated
VALUE, SPEED, CHANGE = slice(0, 3), slice(3, 6), slice(6, 9)  # in `Estimate.covariance`


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Smooth motion of one segment at its M instants; NaN where it is unknown."""

    value: Floats  # (M, 3) or (M, 3, 3)
    rate: Floats  # (M, 3), per frame
    change: Floats  # (M, 3), per frame^2
    covariance: Floats  # (M, 9, 9), of value, rate, change
    rejected: Bools  # (M,), measurements that were rejected


def estimate(
    paths: Sequence[SegmentTrack], band: float | None, settings: SmoothSettings, known: ProcessPrior | None = None
) -> tuple[list[Estimate], float, ProcessPrior | None]:
    """Estimate the process from all segments of one kind, then smooth each by itself.

    Args:
        paths: one for each segment.
        band: cycles per frame; None estimates it.
        settings: limits.
        known: the process of another track, or of this one; None estimates it.

    Returns:
        The estimates, the ratio of true errors to sigmas of the measurements, slow errors included, and the process.
    """
    if known is None:
        pieces = _pieces(paths, settings.learn_frames)
        if sum(int(path.used.sum()) for path in pieces) < settings.least_frames:
            return [_alone(path) for path in paths], 1.0, None
        known = _learnt(pieces, band, settings)
    whole = known.scale / np.sqrt(1 - settings.slow_share)
    return [_smoothed(path, known, settings) for path in paths], float(whole), known


def _pieces(paths: Sequence[SegmentTrack], most: int) -> list[SegmentTrack]:
    """Return pieces of the segments for the estimation, distributed evenly where there are too many."""
    starts = [(path, k) for path in paths for k in range(0, len(path.time), PIECE)]
    total = sum(len(path.time) for path in paths)
    if total > most:
        count = max(1, round(len(starts) * most / total))
        starts = [starts[k] for k in np.linspace(0, len(starts) - 1, count).round().astype(int)]
    pieces = [path.part(slice(k, k + PIECE)) for path, k in starts]
    return [piece for piece in pieces if piece.used.sum() >= FEWEST]


def _learnt(pieces: Sequence[SegmentTrack], band: float | None, settings: SmoothSettings) -> ProcessPrior:
    """Estimate the process, reject outliers, and estimate it again without them."""
    scales = settings.least_scale, settings.most_scale
    learnt = estimate_process(pieces, scales, band)
    for _ in range(ROUNDS):
        settled = [_settled(piece, learnt, settings) for piece in pieces]
        moved = any(farthest > FAR_MOVED for _, _, farthest in settled)
        judged = any((new.used != old.used).any() for (new, _, _), old in zip(settled, pieces, strict=True))
        pieces = [new for new, _, _ in settled]
        if not (moved or judged):
            break
        learnt = estimate_process(pieces, scales, band, before=learnt)
    return learnt


def _settled(
    path: SegmentTrack, learnt: ProcessPrior, settings: SmoothSettings
) -> tuple[SegmentTrack, SmoothedStates, float]:
    """Return the segment about its smooth states, outliers rejected; the states; the largest move, in sigmas."""
    scale, limit = learnt.scale, settings.outlier_sigma**2
    path = replace(path, covariance=path.covariance * scale**2)
    farthest, tries, judgements = 0.0, 0, 0
    while True:
        chain = path.chain(learnt.prior)
        states = smooth(chain, run_filter(chain), _wanted(learnt.prior.pole))
        path = path.moved(states.state, learnt.prior)
        step = float(np.abs(states.state[:, DELTA]).max()) / path.sigma
        farthest, tries = max(farthest, step), tries + 1
        if step > SETTLED and tries < ITERATIONS:
            continue
        used = _judged(path, states, limit, settings.outlier_share)
        if judgements == JUDGEMENTS or (used == path.used).all():
            return replace(path, covariance=path.covariance / scale**2), states, farthest
        path, tries, judgements = replace(path, used=used), 0, judgements + 1


def _judged(path: SegmentTrack, states: SmoothedStates, limit: float, share: float) -> Bools:
    """Return which measurements are used: outliers no longer, and those that fit again."""
    out = path.seen & ~path.used
    used = path.used.copy()
    if out.any():
        off = path.away()[out]
        whole = path.covariance[out] + states.covariance[out][:, VALUE, VALUE]
        mahalanobis = np.einsum("ni,nij,nj->n", off, np.linalg.inv(whole), off)
        used[out] = mahalanobis < AGAIN * limit
    wrong = _stand_out(states.mahalanobis, limit)
    if (path.seen & ~(used & ~wrong)).sum() <= share * path.seen.sum():
        used &= ~wrong
    return used


def _stand_out(mahalanobis: Floats, limit: float) -> Bools:
    """Return the frames beyond the limit and beyond all near them; those near are judged again without them."""
    wrong = mahalanobis > limit
    for k in range(1, min(NEAR, len(mahalanobis) - 1) + 1):
        wrong[k:] &= mahalanobis[k:] >= mahalanobis[:-k]
        wrong[:-k] &= mahalanobis[:-k] > mahalanobis[k:]
    return wrong


def _wanted(pole: float) -> Floats:
    """Return the rows that take value, rate and its change from a state."""
    view = np.eye(3)
    wanted = np.zeros((9, SIZE))
    wanted[VALUE, DELTA] = view
    wanted[SPEED, MEAN] = wanted[SPEED, 6:9] = view
    wanted[CHANGE, 9:12] = pole * view
    return wanted


def _smoothed(path: SegmentTrack, learnt: ProcessPrior, settings: SmoothSettings) -> Estimate:
    """Return a segment's estimate; one measurement has no rate, two have no change of it."""
    count = int(path.used.sum())
    if count < 2:
        return _alone(path)
    settled, states, _ = _settled(path, learnt, settings)
    rate, change = settled.mean + settled.rate[:, 0], settled.rate[:, 1] * settled.pole
    covariance = states.covariance.copy()
    # slow errors pass the smoother like motion; the estimated noise is the fast rest
    slow = settings.slow_share / (1 - settings.slow_share) * learnt.scale**2
    own = np.where(path.seen[:, None, None], path.covariance, path.sigma**2 * np.eye(3))
    covariance[:, VALUE, VALUE] += slow * own
    if count < 3:
        change = np.full_like(change, np.nan)
        covariance[:, CHANGE] = covariance[:, :, CHANGE] = np.nan
    return Estimate(
        value=settled.reference, rate=rate, change=change, covariance=covariance, rejected=settled.seen & ~settled.used
    )


def _alone(path: SegmentTrack) -> Estimate:
    """Return the measurements as they are, without derivatives."""
    unknown = np.full((len(path.time), 3), np.nan)
    covariance = np.full((len(path.time), 9, 9), np.nan)
    covariance[path.seen, VALUE, VALUE] = path.covariance[path.seen]
    value = np.full_like(path.value, np.nan)
    value[path.seen] = path.value[path.seen]
    none = np.zeros(len(path.time), dtype=bool)
    return Estimate(value=value, rate=unknown, change=unknown, covariance=covariance, rejected=none)
