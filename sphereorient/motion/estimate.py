"""Positions or orientations of a track: estimation of the process, outlier rejection, smoothing of each segment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from sphereorient.motion.kalman import Bools, Floats, Prior, SmoothedStates, prior_of_band, run_filter, smooth
from sphereorient.motion.path import DELTA, MEAN, SIZE, SegmentTrack, mahalanobis2
from sphereorient.motion.settings import SmoothSettings

ITERATIONS = 8  # most Gauss-Newton steps between rejections; usually two or three suffice
SETTLED = 0.03  # of a measurement's sigma: after such a step the next one is negligible
PIECE = 200  # instants of a piece, many times the memory of the motion
FEWEST = 5  # least measurements of a piece
NEAR = 5  # frames over which a wrong measurement affects the test of others
AGAIN = 0.5  # of the limit: below it a rejected measurement is used again; less than 1 against oscillation
FAR_MOVED = 100.0  # sigmas; after a larger displacement of the reference the estimate is repeated
VALUE, SPEED, CHANGE = slice(0, 3), slice(3, 6), slice(6, 9)  # in `Estimate.covariance`
POLES = (0.02, 6.0)  # per frame, limits of the prior's band; at 6 the rates of frames are independent
UNSURE = 0.5  # prior standard deviation of the log of the scale, which fast changing rates do not determine
# Pole per frame above which frames hardly predict each other, as for a ball under an animal. There the scale is 1:
# otherwise the motion counts as error and is smoothed away.
FORGOTTEN = 1.5
SPREADS = (1e-3, 1e5)  # of the rate per frame, in sigmas of a measurement
FREE = 6  # unknowns without a prior: the start of the segment and its constant rate
FIRST_TRIES = (0.15, 0.45, 1.2)  # tried poles per frame; the search starts from the best


@dataclass(frozen=True, kw_only=True)
class ProcessPrior:
    """The prior of a track's rate and the scale of its sigmas."""

    prior: Prior  # per frame
    scale: float  # true errors of the measurements over their sigmas


@dataclass(frozen=True, kw_only=True)
class ProcessNoise:
    """The processes of positions and orientations, estimated by `smooth_motion`, reusable by other runs."""

    place: ProcessPrior | None  # None: too few frames to estimate it
    turn: ProcessPrior | None
    frame_s: float  # unit of time of `ProcessPrior`

    def at(self, frame_s: float) -> list[ProcessPrior | None]:
        """Return the processes of positions and orientations for another duration of frames."""
        k = frame_s / self.frame_s
        return [
            one and replace(one, prior=Prior(pole=one.prior.pole * k, deviation=one.prior.deviation * k))
            for one in (self.place, self.turn)
        ]


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Smooth motion of one segment at its M instants; NaN if unknown."""

    value: Floats  # (M, 3) or (M, 3, 3)
    rate: Floats  # (M, 3), per frame
    change: Floats  # (M, 3), per frame^2
    covariance: Floats  # (M, 9, 9), of value, rate, change
    rejected: Bools  # (M,), rejected measurements


def estimate(
    paths: Sequence[SegmentTrack], band: float | None, settings: SmoothSettings, known: ProcessPrior | None = None
) -> tuple[list[Estimate], float, ProcessPrior | None]:
    """Estimate the process of all segments unless `known`, then smooth each; `band` in cycles per frame.
    Return the estimates, the ratio of true errors to sigmas of the measurements, and the process.
    """
    if known is None:
        # usable pieces of the segments, an even selection if there are too many
        parts = [(path, slice(k, k + PIECE)) for path in paths for k in range(0, len(path.time), PIECE)]
        parts = [(path, part) for path, part in parts if path.used[part].sum() >= FEWEST]
        total, most = sum(len(path.time[part]) for path, part in parts), settings.learn_frames
        if total > most:
            count = max(1, round(len(parts) * most / total))
            parts = [parts[k] for k in np.linspace(0, len(parts) - 1, count).round().astype(int)]
        pieces = [path.part(part) for path, part in parts]
        if sum(int(path.used.sum()) for path in pieces) < settings.least_frames:
            return [_alone(path) for path in paths], 1.0, None
        known = _learnt(pieces, band, settings)
    whole = known.scale / np.sqrt(1 - settings.slow_share)
    return [_smoothed(path, known, settings) for path in paths], float(whole), known


def _learnt(pieces: Sequence[SegmentTrack], band: float | None, settings: SmoothSettings) -> ProcessPrior:
    scales = settings.least_scale, settings.most_scale
    learnt = estimate_process(pieces, scales, band)
    for _ in range(3):  # rounds of estimation
        before, (settled, _, moves) = pieces, zip(*(_settled(one, learnt, settings) for one in pieces), strict=True)
        pieces = settled
        judged = any((new.used != old.used).any() for new, old in zip(pieces, before, strict=True))
        if not (judged or max(moves) > FAR_MOVED):
            break
        learnt = estimate_process(pieces, scales, band, before=learnt)
    return learnt


def _settled(
    path: SegmentTrack, learnt: ProcessPrior, settings: SmoothSettings
) -> tuple[SegmentTrack, SmoothedStates, float]:
    """Return the segment about its smooth states, without outliers; the states; the largest displacement, sigmas."""
    scale, limit = learnt.scale, settings.outlier_sigma**2
    path = replace(path, covariance=path.covariance * scale**2)
    farthest, tries, judgements = 0.0, 0, 0
    wanted = np.zeros((9, SIZE))
    wanted[VALUE, DELTA] = wanted[SPEED, MEAN] = wanted[SPEED, 6:9] = np.eye(3)
    wanted[CHANGE, 9:12] = learnt.prior.pole * np.eye(3)
    while True:
        chain = path.chain(learnt.prior)
        states = smooth(chain, run_filter(chain), wanted)
        path = path.moved(states.state, learnt.prior)
        step = float(np.abs(states.state[:, DELTA]).max()) / path.sigma
        farthest, tries = max(farthest, step), tries + 1
        if step > SETTLED and tries < ITERATIONS:
            continue
        used = _judged(path, states, limit, settings.outlier_share)
        # At most 12 rounds of rejection: neighbouring outliers are found one after the other.
        if judgements == 12 or (used == path.used).all():
            return replace(path, covariance=path.covariance / scale**2), states, farthest
        path, tries, judgements = replace(path, used=used), 0, judgements + 1


def _judged(path: SegmentTrack, states: SmoothedStates, limit: float, share: float) -> Bools:
    """Return which measurements are used: outliers are dropped, and restored if they fit again."""
    out = path.seen & ~path.used
    used = path.used.copy()
    if out.any():
        off = path.away()[out]
        whole = path.covariance[out] + states.covariance[out][:, VALUE, VALUE]
        used[out] = mahalanobis2(off, whole) < AGAIN * limit
    # above the limit and above all near ones, which are tested again without them
    away = states.mahalanobis
    wrong = away > limit
    for k in range(1, min(NEAR, len(away) - 1) + 1):
        wrong[k:] &= away[k:] >= away[:-k]
        wrong[:-k] &= away[:-k] > away[k:]
    if (path.seen & ~(used & ~wrong)).sum() <= share * path.seen.sum():
        used &= ~wrong
    return used


def _smoothed(path: SegmentTrack, learnt: ProcessPrior, settings: SmoothSettings) -> Estimate:
    """Return a segment's estimate; one measurement gives no rate, two no change of it."""
    if (count := int(path.used.sum())) < 2:
        return _alone(path, learnt.scale**2 / (1 - settings.slow_share))
    settled, states, _ = _settled(path, learnt, settings)
    rate, change = settled.mean + settled.rate[:, 0], settled.rate[:, 1] * settled.pole
    covariance = states.covariance.copy()
    # slow errors pass the smoother as motion does; the estimated noise is the fast part
    slow = settings.slow_share / (1 - settings.slow_share) * learnt.scale**2
    own = np.where(path.seen[:, None, None], path.covariance, path.sigma**2 * np.eye(3))
    covariance[:, VALUE, VALUE] += slow * own
    if count < 3:
        change[:] = covariance[:, CHANGE] = covariance[:, :, CHANGE] = np.nan
    rejected = settled.seen & ~settled.used
    return Estimate(value=settled.reference, rate=rate, change=change, covariance=covariance, rejected=rejected)


def _alone(path: SegmentTrack, factor: float = 1.0) -> Estimate:
    """Return the measurements as they are, without rates, their covariances times a factor."""
    count, seen = len(path.time), path.seen
    unknown, covariance = np.full((count, 3), np.nan), np.full((count, 9, 9), np.nan)
    covariance[seen, VALUE, VALUE] = factor * path.covariance[seen]
    value = np.where(seen.reshape(-1, *(1,) * (path.value.ndim - 1)), path.value, np.nan)
    return Estimate(value=value, rate=unknown, change=unknown, covariance=covariance, rejected=np.zeros(count, bool))


def estimate_process(
    paths: Sequence[SegmentTrack], scales: tuple[float, float], band: float | None, before: ProcessPrior | None = None
) -> ProcessPrior:
    """Find the most probable prior and factor (within `scales`) on the measurements' sigmas.
    Paths have at least five measurements each. For a rate forgotten from frame to frame the factor is 1. `band`, cycles
    per frame, fixes the prior; `before` is a start.
    Source: Rasmussen and Williams 2006, section 5.4.1, by the innovations; the factor in closed form.
    """
    sigma = float(np.median([path.sigma for path in paths]))
    prior = _likeliest(paths, scales, sigma, before) if band is None else prior_of_band(band, sigma)
    if band is None and prior.pole > FORGOTTEN:
        scales = 1.0, 1.0
        prior = _likeliest(paths, scales, sigma, None)
    scale = _cost(paths, prior, scales)[1]
    return ProcessPrior(prior=Prior(pole=prior.pole, deviation=prior.deviation * scale), scale=scale)


def _likeliest(
    paths: Sequence[SegmentTrack], scales: tuple[float, float], sigma: float, before: ProcessPrior | None
) -> Prior:
    def prior_at(theta: Floats) -> Prior:
        pole, spread = np.exp(np.clip(theta, np.log([POLES[0], SPREADS[0]]), np.log([POLES[1], SPREADS[1]])))
        return Prior(pole=float(pole), deviation=float(spread * sigma))

    def cost(theta: Floats) -> float:
        return _cost(paths, prior_at(theta), scales)[0]

    if before is None:
        rates = [path.rates() for path in paths]
        usual = 1.48 * np.median(np.concatenate([np.abs(each - np.median(each, axis=0)) for each in rates]))
        spread = np.clip(usual / sigma, 10 * SPREADS[0], 0.1 * SPREADS[1])
        start, reach = min((np.log([pole, spread]) for pole in FIRST_TRIES), key=cost), 0.4
    else:
        start, reach = np.log([before.prior.pole, before.prior.deviation / before.scale / sigma]), 0.1
    simplex = start + reach * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.02, "maxfev": 60}
    found = minimize(cost, start, method="Nelder-Mead", options=options)  # type: ignore[call-overload]
    return prior_at(found.x)


def _cost(paths: Sequence[SegmentTrack], prior: Prior, scales: tuple[float, float]) -> tuple[float, float]:
    """Return the negative log-likelihood, up to a constant, and the scale; all covariances in units of scale^2."""
    found = [run_filter(path.chain(prior)) for path in paths]
    misfit, logs = sum(one.misfit for one in found), sum(one.log_determinant for one in found)
    number = max(sum(3 * int(path.used.sum()) - FREE for path in paths), 1)
    scale = float(np.clip(np.sqrt(misfit / number), *scales))
    beforehand = (np.log(scale) / UNSURE) ** 2
    return 0.5 * (logs + number * 2 * np.log(scale) + misfit / scale**2 + beforehand), scale
